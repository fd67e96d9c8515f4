"""The text of a file that may be anything: missing, a pipe, a folder, without end, or no text at all."""

from pathlib import Path

from stitch.errors import InputError

# Tables and descriptions are far smaller; a larger one is another file.
LARGEST_MB = 200


def require_file(file: Path, hint: str) -> None:
    """Refuse what cannot be read to its end: a pipe, a device, a folder.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: no such file, or none of this kind.
    """
    if file.is_file():
        return
    if file.is_dir():
        raise InputError(f"{file}: is a folder; to fix: {hint}")
    if file.exists():
        raise InputError(f"{file}: is a pipe or a device; to fix: put a file there")
    if file.is_symlink():
        raise InputError(f"{file}: is a link to {file.readlink()}, which does not exist; to fix: {hint}")
    raise InputError(f"{file}: not found; {hint}")


def read_text(file: Path, hint: str, largest_mb: float = LARGEST_MB) -> str:
    """The text of a file, with or without the mark of UTF-8 (BOM) in front.

    Raises:
        InputError: no such file, too large, or not UTF-8.
    """
    require_file(file, hint)
    size = file.stat().st_size / 1e6
    if size > largest_mb:
        raise InputError(f"{file}: has {size:,.0f} MB, more than {largest_mb:g}; to fix: name the right file")
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not UTF-8 text ({error.reason}); to fix: save it as UTF-8") from None


def shortened(value: object, most: int = 80) -> str:
    """`repr` of a value for a message, cut where it is long."""
    try:
        told = repr(value)
    except ValueError:  # an integer of thousands of digits
        told = "a number of thousands of digits"
    return told if len(told) <= most else f"{told[: most // 2]}…{told[-most // 4 :]}"
