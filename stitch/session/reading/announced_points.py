"""How many points a scan's header announces, asked before a library makes room for them: LAS, E57, EXR, HDF5; and how
large the arrays of MATLAB and NumPy and the sheets of a workbook are that are to hold poses.

Layouts: LAS 1.4 R15 (ASPRS), tables 3 and 4; ASTM E2807, clause 6; OpenEXR, "The OpenEXR file layout".
"""

import re
import struct
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path

from stitch.errors import InputError

# No scan of one view has more.
MOST_POINTS = 200_000_000
# Deflate packs 1032 bytes into one at most.
_POINTS_A_BYTE = 1000
_LAS_HEADER = 375
_LAS_VERSION = 24
_LAS_RECORD = 105  # length of a record and, in versions before 1.4, their number
_LAS_COUNT_14 = 247
_E57_HEADER = 48
_E57_XML = 24  # where the XML stands, how long it is, and the size of a page
_E57_CHECKSUM = 4  # bytes at the end of a page
# The description stands before the pixels; texts in it are short.
_EXR_HEADER = 1 << 20
# Poses of a million views.
_MOST_BYTES = 200_000_000
_MAT_HEADER, _MAT_PACKED = 128, 15
# A sheet is read as a rectangle up to its last filled cell; 20 columns for a million rows.
_MOST_CELLS = 20_000_000
_FILLED_CELL = re.compile(rb"<(?:\w+:)?c\s(?:[^>]*?\s)?r=[\"']([A-Z]{1,3})(\d{1,7})[\"'][^>]*(?<!/)>")
_EXR_WINDOW = b"dataWindow\0box2i\0" + struct.pack("<I", 16)


def require_room(path: Path, points: int) -> None:
    """Refuse a file whose header announces more points than its bytes can hold, compressed or not.

    Asked before a library allocates memory for them.

    Args:
        points: number that the header announces.

    Raises:
        InputError: names that number.
    """
    size = path.stat().st_size
    if points > min(MOST_POINTS, _POINTS_A_BYTE * size):
        raise InputError(f"{path}: {points} points announced in {size} bytes; export it again, a file a view")


def require_las_room(path: Path) -> None:
    """Refuse a LAS or LAZ whose header announces more points than it can hold; see `require_room`."""
    with path.open("rb") as stream:
        head = stream.read(_LAS_HEADER)
    if len(head) < _LAS_RECORD + 6 or head[:4] != b"LASF":
        return
    length, points = struct.unpack_from("<HI", head, _LAS_RECORD)
    if tuple(head[_LAS_VERSION : _LAS_VERSION + 2]) >= (1, 4) and len(head) >= _LAS_COUNT_14 + 8:
        points = max(points, *struct.unpack_from("<Q", head, _LAS_COUNT_14))
    require_room(path, points)
    size = path.stat().st_size
    if path.suffix.lower() == ".las" and points * max(length, 1) > size:
        raise InputError(f"{path}: {points} points announced in {size} bytes; export it again")


def require_e57_room(path: Path) -> None:
    """Refuse an E57 one of whose scans announces more points than it can hold; see `require_room`.

    The XML that describes the scans lies in pages of the file, each of which ends with a checksum.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_E57_HEADER)
        if len(head) < _E57_HEADER or head[:8] != b"ASTM-E57":
            return
        start, length, page = struct.unpack_from("<QQQ", head, _E57_XML)
        if start + length > size or page <= _E57_CHECKSUM:
            raise InputError(f"{path}: {length} bytes of description announced in {size}; export it again")
        stream.seek(start)
        raw = stream.read()
    first = page - start % page
    pages = [raw[:first], *(raw[i : i + page] for i in range(first, len(raw), page))]
    text = b"".join(piece[:-_E57_CHECKSUM] for piece in pages)[:length]
    counts = re.findall(rb'recordCount\s*=\s*["\']\s*([^"\']*)', text)
    # XML entities could hide a number, or unpack to a text of any length: files with entities are refused.
    if b"<!" in text.replace(b"<!--", b"").replace(b"<![CDATA[", b"") or not all(count.isdigit() for count in counts):
        raise InputError(f"{path}: its description has entities, or a number of points that is none; export it again")
    require_room(path, max(map(int, counts), default=0))


def require_exr_room(path: Path) -> None:
    """Refuse an OpenEXR image of more pixels than it can hold; see `require_room`."""
    with path.open("rb") as stream:
        head = stream.read(_EXR_HEADER)
    windows = [found.end() for found in re.finditer(re.escape(_EXR_WINDOW), head) if found.end() <= len(head) - 16]
    for at in windows:
        left, top, right, bottom = struct.unpack_from("<4i", head, at)
        require_room(path, max(right - left + 1, 0) * max(bottom - top + 1, 0))
    if not windows:
        raise InputError(f"{path}: has no dataWindow where the description of an OpenEXR stands; export it again")


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
