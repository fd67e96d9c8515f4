"""Tables of other programs: text in any encoding, sheets of workbooks; arrays and sheets too large for memory.

How large the arrays of MATLAB and NumPy and the sheets of a workbook are is asked before a library makes room for them.
"""

import csv
import io
import re
import struct
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path

from stitch.errors import InputError
from stitch.session.reading.text_files import LARGEST_MB, UTF16, reason_of, require_file, require_size
from stitch.system.packages import import_extra

WORKBOOKS = (".xlsx", ".xlsm", ".xls", ".xlsb", ".ods")
# Poses of a million views.
_MOST_BYTES = 200_000_000
_MAT_HEADER, _MAT_PACKED = 128, 15
# A sheet is read as a rectangle up to its last filled cell; 20 columns for a million rows.
_MOST_CELLS = 20_000_000
_FILLED_CELL = re.compile(rb"<(?:\w+:)?c\s(?:[^>]*?\s)?r=[\"']([A-Z]{1,3})(\d{1,7})[\"'][^>]*(?<!/)>")


def read_any_text(file: Path, hint: str, largest_mb: float = LARGEST_MB) -> str:
    """Return the text of a file of another program, in UTF-8, UTF-16 with its byte order mark, or else Windows-1252.

    Spreadsheets write the last two. A wrong guess changes only letters in names: digits are the same in all.

    Args:
        hint: what to do where there is no such file.
        largest_mb: MB; larger files are refused.

    Raises:
        InputError: no such file, too large, or no text.
    """
    require_size(file, hint, largest_mb)
    content = file.read_bytes()
    marked = content.startswith(UTF16)
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            if "\0" not in text:
                return text
    raise InputError(f"{file}: is no text; to fix: save it as UTF-8")


def workbook_sheets(file: Path) -> dict[str, str]:
    """Return sheet name -> its content as CSV, of the sheets of a workbook that are not empty.

    Raises:
        InputError: no such file, no workbook, one that is too large, or the package that reads them is missing.
    """
    require_file(file, "name a workbook")
    require_workbook_room(file)
    calamine = import_extra("python_calamine", file, "formats")
    try:
        book = calamine.CalamineWorkbook.from_path(str(file))
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except (calamine.CalamineError, OSError, ValueError) as error:
        raise InputError(f"{file}: no readable workbook ({reason_of(error)}); to fix: save its sheets as CSV") from None
    texts = {}
    for name, rows in sheets.items():
        if rows:
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows(rows)
            texts[name] = text.getvalue()
    return texts


def require_array_room(path: Path) -> None:
    """Refuse a .mat or .npz whose arrays are larger than any table of poses, before memory is allocated for them.

    Other files, and damaged ones, are left to their reader.

    Raises:
        InputError: names the bytes that are announced.
    """
    count = {".mat": _mat_bytes, ".npz": _zip_bytes}.get(path.suffix.lower())
    if count is not None and (announced := count(path)) > _MOST_BYTES:
        raise InputError(f"{path}: {announced} bytes of arrays announced; to fix: save the poses alone")


def require_workbook_room(path: Path) -> None:
    """Refuse a workbook whose sheets are larger than any table of poses, before memory is allocated for them.

    One number in the last cell of an empty sheet makes 17 billion cells: a reader would be ended by the system. What
    is no ZIP archive is left to its reader.

    Raises:
        InputError: names the bytes, or the cells, that are announced.
    """
    if (unpacked := _zip_bytes(path)) > _MOST_BYTES:
        raise InputError(f"{path}: {unpacked} bytes of sheets announced; to fix: save the poses alone, as CSV")
    # A damaged archive is left to its reader too.
    with suppress(zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, zlib.error, EOFError):
        with zipfile.ZipFile(path) as archive:
            sheets = [name for name in archive.namelist() if name.startswith("xl/worksheets/")]
            cells = max((_cells(archive.read(name)) for name in sheets), default=0)
        if cells > _MOST_CELLS:
            raise InputError(f"{path}: {cells} cells up to the last filled one; to fix: save the poses alone, as CSV")


def _cells(sheet: bytes) -> int:
    """Return the number of cells from A1 to the last filled row and column of a sheet, bytes of Office Open XML."""
    letters = set[bytes]()
    rows = 0
    for cell in _FILLED_CELL.finditer(sheet):
        letters.add(cell[1])
        rows = max(rows, int(cell[2]))
    return rows * max((_column(name) for name in letters), default=0)


def _column(letters: bytes) -> int:
    """The number of a column: A is 1, AA is 27."""
    return sum((letter - ord("A") + 1) * 26**place for place, letter in enumerate(reversed(letters)))


def _mat_bytes(path: Path) -> int:
    """Return the bytes that the elements of a MAT-file of version 5 unpack to; 0 for any other file.

    Each element begins with a tag of type and size. A compressed one holds another such tag, of its unpacked data.
    """
    total, size = 0, path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_MAT_HEADER)  # its last two bytes tell the byte order
        order = ">" if head[126:] == b"MI" else "<"
        if head[126:] not in (b"MI", b"IM"):
            return 0
        while len(tag := stream.read(8)) == 8:
            kind, count = struct.unpack(f"{order}II", tag)
            after = stream.tell() + count
            if kind == _MAT_PACKED:
                try:
                    _, unpacked = struct.unpack(f"{order}II", zlib.decompressobj().decompress(stream.read(64), 8))
                except (zlib.error, struct.error):
                    return total
                total += unpacked
            stream.seek(min(after, size))
    return max(total, size)


def _zip_bytes(path: Path) -> int:
    """Return how many bytes the files of a ZIP archive unpack to, as it says; 0 where it is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, OSError):
        return 0
