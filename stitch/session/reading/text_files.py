"""The text of a file that may be anything: missing, a pipe, a folder, without end, or no text at all.

What it holds as TOML, JSON or sheets; names that people write there; and values for messages.
"""

import codecs
import json
import tomllib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stitch.errors import InputError, did_you_mean

# Tables and descriptions are far smaller; a larger one is another file.
LARGEST_MB = 200
# A description written by hand; the model of a run with thousands of targets is smaller too.
_LARGEST_TOML_MB = 20
# How the small file begins that Git LFS leaves in place of a large one.
_POINTER = b"version https://git-lfs"
UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# What every run of one session holds.
_DOCUMENTS = ("model.toml", "result.json", "ledger.json")
_SESSION = "session.toml"
_RUN = "stitch-run/"
_MODEL = "stitch-model/"
_LONGEST = 200  # characters of an id; a folder's name may have 255 bytes, and scratch folders lengthen it
_RESERVED = "/\\"


def read_text(file: Path, hint: str, largest_mb: float = LARGEST_MB) -> str:
    """Return the text of a file in UTF-8, without the byte order mark that may be in front.

    Args:
        hint: what to do where there is no such file.
        largest_mb: MB; larger files are refused.

    Raises:
        InputError: no such file, too large, or not UTF-8.
    """
    require_size(file, hint, largest_mb)
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(not_utf8(file, "UTF-8")) from None


def require_size(file: Path, hint: str, largest_mb: float) -> None:
    """Refuse a file that cannot be read, or that is larger than so many MB.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: as `require_file`, or the file is too large.
    """
    require_file(file, hint)
    size = file.stat().st_size / 1e6
    if size > largest_mb:
        raise InputError(f"{file}: has {size:,.0f} MB, more than {largest_mb:g}; to fix: name the right file")


@contextmanager
def readable() -> Iterator[None]:
    """Turn a PermissionError in the block, or in the function that this decorates, into an InputError.

    Raises:
        InputError: names the file, and how to fix it.
    """
    try:
        yield
    except PermissionError as error:
        raise InputError(
            f"{error.filename or 'a file'}: may not be read; to fix: change its rights, or name another"
        ) from None


@readable()
def require_file(file: Path, hint: str) -> None:
    """Refuse what cannot be read to its end: a pipe, a device, a folder.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: no such file, none of this kind, one that may not be read, or that Git LFS has not fetched.
    """
    if file.is_file():
        with file.open("rb") as stream:
            if stream.read(len(_POINTER)) == _POINTER:
                raise InputError(f"{file}: Git LFS has left a pointer in place of the file; to fix: git lfs pull")
        return
    if file.is_dir():
        raise InputError(f"{file}: is a folder; to fix: {hint}")
    if file.exists():
        raise InputError(f"{file}: is a pipe or a device; to fix: put a file there")
    if file.is_symlink():
        raise InputError(f"{file}: is a link to {file.readlink()}, which does not exist; to fix: {hint}")
    raise InputError(_run_not_session(file) or _damaged_run(file) or f"{file}: not found; {hint}")


def _run_not_session(file: Path) -> str | None:
    """Return the message for a missing session.toml in the folder of a run; None for any other missing file."""
    folder = file.parent
    if file.name != _SESSION or not _is_run(folder):
        return None
    # The session of a run, or those of a rig.
    results = (folder / "result.json", *sorted(folder.glob("*/result.json")))
    sessions = [session for result in results if (session := _session_of_result(result))]
    of = f" of {', '.join(dict.fromkeys(sessions))}" if sessions else ""
    return f"{folder}: is a run{of}, not a session; to fix: name the session"


def _damaged_run(file: Path) -> str | None:
    """Return the message for a missing file that every run has, in the folder of one; None for any other file."""
    folder = file.parent
    if file.name not in _DOCUMENTS or (folder / _SESSION).exists() or not _is_run(folder):
        return None
    # The folder of a rig has a model for all its runs, and no result of its own.
    if file.name != "model.toml" and any(folder.glob("*/result.json")):
        return None
    return f"{folder}: damaged, its {file.name} is missing; to fix: `stitch run` the session again into another folder"


def _is_run(folder: Path) -> bool:
    """Return True if a folder holds a result.json or a model.toml of ours."""
    if _session_of_result(folder / "result.json") is not None:
        return True
    model = folder / "model.toml"
    return model.is_file() and _MODEL in model.read_text(encoding="utf-8", errors="replace")


def _session_of_result(file: Path) -> str | None:
    """Return where the session of a result lies, empty where it does not say; None for a file that is no result."""
    document = read_json_object(file)
    return str(document.get("session") or "") if str(document.get("format")).startswith(_RUN) else None


def not_utf8(file: Path, save_as: str) -> str:
    """Return the message for a file that is not UTF-8, with the line of its first byte that is none.

    Args:
        save_as: format to save it as, for the message.
    """
    content = file.read_bytes()
    mend = f"to fix: save it as {save_as}"
    if content.startswith(UTF16):
        return f"{file} line 1: is UTF-16 text, not UTF-8; {mend}"
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        start = error.start + len(codecs.BOM_UTF8) * content.startswith(codecs.BOM_UTF8)
        line = content.count(b"\n", 0, start) + 1
        return f"{file} line {line}: not UTF-8 text, byte 0x{content[start]:02x} is the first that is none; {mend}"
    return f"{file}: not UTF-8 text; {mend}"


def read_toml(file: Path, hint: str) -> dict[str, Any]:
    """Return the document of a TOML file.

    Args:
        hint: what to do where there is no such file.

    Raises:
        InputError: the file is missing, no file, or not TOML.
    """
    text = read_text(file, hint, _LARGEST_TOML_MB)
    try:
        return tomllib.loads(text)
    except ValueError as error:  # wrong TOML, and integers of thousands of digits
        raise InputError(f"{file}: not valid TOML: {error}; to fix: correct it there") from None
    except RecursionError:
        raise InputError(f"{file}: not valid TOML: nested too deeply; to fix: write plain tables and lists") from None


def require_known_keys(where: Path | str, table: Any, known: Collection[str], name: str = "") -> None:
    """Refuse a table with a key that is not known: a misspelt alpha_deg would silently count as 0.

    Args:
        where: file, and place in it, for the message.
        known: keys, at best in the order in which people write them.
        name: of the table, which stands before its keys in the message; empty: it has none.

    Raises:
        InputError: names the key, and the known one that is most like it.
    """
    if not isinstance(table, dict):
        what = f"{name} = {shortened(table)}" if name else shortened(table)
        raise InputError(f"{where}: {what} is not a table; write {{ {', '.join(k + ' = …' for k in known)} }}")
    for key in map(str, table):
        if key not in known:
            hint = did_you_mean(key, known) or f"; known are {', '.join(known)}"
            raise InputError(f"{where}: unknown key {shortened(f'{name}.{key}' if name else key)}{hint}")


def table_choice(where: Path | str, table: dict[str, Any], key: str, allowed: tuple[str, ...]) -> str:
    """Return the word at `key`, one of those allowed.

    Args:
        where: file, and place in it, for the message.

    Raises:
        InputError: another one, or none.
    """
    value = table.get(key)
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{where}: {key} is {shortened(value)}; use {' or '.join(repr(a) for a in allowed)}")
    return str(value)


def optional_text(file: Path, table: dict[str, Any], name: str, key: str) -> str | None:
    """Return the text at `key` of the table that is called `name`, or None where it is absent.

    Raises:
        InputError: something else than text.
    """
    value = table.get(key)
    if value is not None and not isinstance(value, str):
        place = f"{name}.{key}" if name else key
        raise InputError(f"{file}: {place} is {shortened(value)}; write a name in quotes")
    return value


def read_json_object(file: Path) -> dict[str, Any]:
    """Return the object in a JSON file; {} where the file is missing, damaged, or holds no object."""
    if not file.is_file():
        return {}
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def require_name(where: str, name: str, what: str) -> str:
    """Return a name of a view, target or column as it is, if it can be printed on a line.

    Args:
        where: file and line, for the message.
        what: it is the name of, for the message.

    Raises:
        InputError: too long, or with characters that cannot be printed.
    """
    if len(name) > _LONGEST:
        raise InputError(
            f"{where}: {what} {shortened(name)} has {len(name)} characters; to fix: use at most {_LONGEST}"
        )
    hidden = next((c for c in name if not c.isprintable()), None)
    if hidden is not None:
        raise InputError(f"{where}: {what} {shortened(name)} holds the character {hidden!r}; to fix: leave it out")
    return name


def require_folder_name(where: str, name: str) -> str:
    """Return a name as it is, if a folder can have it: a session's name becomes that of its run's folder.

    Args:
        where: file, for the message.

    Raises:
        InputError: empty, a path, hidden, or longer than a file system allows.
    """
    require_name(where, name, "name")
    if not name.strip() or name != name.strip() or name.startswith(".") or any(c in _RESERVED for c in name):
        raise InputError(
            f"{where}: name {shortened(name)} cannot name a folder; to fix: write letters, digits, spaces or - _ +, "
            "without a path"
        )
    if len(name.encode("utf-8", "replace")) > _LONGEST:
        raise InputError(f"{where}: name {shortened(name)} is too long for a folder; to fix: shorten it")
    return name


def reason_of(error: Exception) -> str:
    """Return the message of a library's error at bytes that it cannot read, on one line and shortened.

    An ImportError says only that the bytes look like another format, for which a package is missing: it is replaced.
    """
    if isinstance(error, ImportError):
        return "its bytes are not what its name says"
    return shortened(" ".join(str(error).split()) or type(error).__name__)


def shortened(value: object, most: int = 80) -> str:
    """Return `repr` of a value for a message, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-most // 4 :]}"
