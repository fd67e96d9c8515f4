"""Names that people give to sessions, views and targets: as ids in tables, and as folders."""

from stitch.errors import InputError
from stitch.reading.text_file import shortened

_LONGEST = 200  # characters of an id; a folder's name may have 255 bytes, and scratch folders lengthen it
_RESERVED = "/\\"


def require_name(where: str, name: str, what: str) -> str:
    """An id that can be printed on a line.

    Raises:
        InputError: too long, or with characters that nobody sees.
    """
    if len(name) > _LONGEST:
        raise InputError(
            f"{where}: {what} {shortened(name)} has {len(name)} characters; to fix: use at most {_LONGEST}"
        )
    hidden = next((c for c in name if not c.isprintable()), None)
    if hidden is not None:
        raise InputError(f"{where}: {what} {shortened(name)} holds the character {hidden!r}; to fix: leave it out")
    return name


def require_folder_name(where: str, name: str, what: str) -> str:
    """A name under which a folder can be made: that of a session is one of its run.

    Raises:
        InputError: empty, a path, hidden, or longer than a file system allows.
    """
    require_name(where, name, what)
    if not name.strip() or name != name.strip() or name.startswith(".") or any(c in _RESERVED for c in name):
        raise InputError(
            f"{where}: {what} {shortened(name)} cannot name a folder; to fix: write letters, digits, spaces or - _ +, "
            "without a path"
        )
    if len(name.encode("utf-8", "replace")) > _LONGEST:
        raise InputError(f"{where}: {what} {shortened(name)} is too long for a folder; to fix: shorten it")
    return name
