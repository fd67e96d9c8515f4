"""The text of a file that may be anything: missing, a pipe, a folder, without end, or no text at all."""

import codecs
from contextlib import suppress
from pathlib import Path

from stitch.errors import InputError
from stitch.reading.missing import reason_missing
from stitch.reading.rights import readable

# Tables and descriptions are far smaller; a larger one is another file.
LARGEST_MB = 200
# How the small file begins that Git LFS leaves in place of a large one.
_POINTER = b"version https://git-lfs"
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@readable()
def require_file(file: Path, hint: str) -> None:
    """Refuse what cannot be read to its end: a pipe, a device, a folder.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: no such file, none of this kind, one that may not be read, or that Git LFS has not fetched.
    """
    if file.is_file():
        _require_no_pointer(file)
        return
    if file.is_dir():
        raise InputError(f"{file}: is a folder; to fix: {hint}")
    if file.exists():
        raise InputError(f"{file}: is a pipe or a device; to fix: put a file there")
    if file.is_symlink():
        raise InputError(f"{file}: is a link to {file.readlink()}, which does not exist; to fix: {hint}")
    raise InputError(reason_missing(file) or f"{file}: not found; {hint}")


def _require_no_pointer(file: Path) -> None:
    with file.open("rb") as stream:
        if stream.read(len(_POINTER)) == _POINTER:
            raise InputError(f"{file}: Git LFS has left a pointer in place of the file; to fix: git lfs pull")


def read_text(file: Path, hint: str, largest_mb: float = LARGEST_MB) -> str:
    """The text of a file, with or without the mark of UTF-8 (BOM) in front.

    Raises:
        InputError: no such file, too large, or not UTF-8.
    """
    _require_size(file, hint, largest_mb)
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(not_utf8(file, "UTF-8")) from None


def not_utf8(file: Path, save_as: str) -> str:
    """What to say of a file that is not UTF-8: where its first byte stands that is none.

    Args:
        save_as: the kind to save it as.
    """
    told = file.read_bytes()
    mend = f"to fix: save it as {save_as}"
    if told.startswith(_UTF16):
        return f"{file} line 1: is UTF-16 text, not UTF-8; {mend}"
    try:
        told.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        start = error.start + len(codecs.BOM_UTF8) * told.startswith(codecs.BOM_UTF8)
        line = told.count(b"\n", 0, start) + 1
        return f"{file} line {line}: not UTF-8 text, byte 0x{told[start]:02x} is the first that is none; {mend}"
    return f"{file}: not UTF-8 text; {mend}"


def read_any_text(file: Path, hint: str, largest_mb: float = LARGEST_MB) -> str:
    """The text of a file that another program wrote: UTF-8, UTF-16 with its mark, else Windows' Western European.

    Spreadsheets write the last two; of a wrong guess only letters in names suffer, digits are the same in all.

    Raises:
        InputError: no such file, too large, or no text.
    """
    _require_size(file, hint, largest_mb)
    told = file.read_bytes()
    marked = told.startswith(_UTF16)
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            text = told.decode(encoding)
            if "\0" not in text:
                return text
    raise InputError(f"{file}: is no text; to fix: save it as UTF-8")


def _require_size(file: Path, hint: str, largest_mb: float) -> None:
    require_file(file, hint)
    size = file.stat().st_size / 1e6
    if size > largest_mb:
        raise InputError(f"{file}: has {size:,.0f} MB, more than {largest_mb:g}; to fix: name the right file")


def reason_of(error: Exception) -> str:
    """What a library says of bytes that it cannot read, on one line.

    A mesh that is no mesh may be text in an encoding for which the library lacks a package: that helps nobody.
    """
    if isinstance(error, ImportError):
        return "its bytes are not what its name says"
    return shortened(" ".join(str(error).split()) or type(error).__name__)


def shortened(value: object, most: int = 80) -> str:
    """`repr` of a value for a message, cut where it is long."""
    try:
        told = repr(value)
    except ValueError:  # an integer of thousands of digits
        told = "a number of thousands of digits"
    return told if len(told) <= most else f"{told[: most // 2]}…{told[-most // 4 :]}"
