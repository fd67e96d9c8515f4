"""Why a file is missing: the folder is a run, or a run that has lost some of its files."""

from pathlib import Path

from stitch.reading.json_object import read_json_object

# What every run of one session holds.
_DOCUMENTS = ("model.toml", "result.json", "ledger.json")
_SESSION = "session.toml"
_RUN, _MODEL = "stitch-run/", "stitch-model/"


def reason_missing(file: Path) -> str | None:
    """What to say in place of "not found", where the folder tells what it is; None where it does not."""
    folder = file.parent
    if file.name == _SESSION and _is_run(folder):
        sessions = ", ".join(_sessions_of_run(folder))
        return f"{folder}: is a run{f' of {sessions}' * bool(sessions)}, not a session; to fix: name the session"
    if file.name not in _DOCUMENTS or (folder / _SESSION).exists() or not _is_run(folder):
        return None
    # The folder of a rig has a model for all its runs, and no result of its own.
    if file.name != "model.toml" and any(folder.glob("*/result.json")):
        return None
    return f"{folder}: damaged, its {file.name} is missing; to fix: `stitch run` the session again into another folder"


def _is_run(folder: Path) -> bool:
    if _session_of_result(folder / "result.json") is not None:
        return True
    model = folder / "model.toml"
    return model.is_file() and _MODEL in model.read_text(encoding="utf-8", errors="replace")


def _sessions_of_run(folder: Path) -> list[str]:
    """The session of a run, or those of a rig."""
    files = (folder / "result.json", *sorted(folder.glob("*/result.json")))
    return [*dict.fromkeys(session for file in files if (session := _session_of_result(file)))]


def _session_of_result(file: Path) -> str | None:
    """Where the session of a result lies, empty where it does not say; None for a file that is no result."""
    document = read_json_object(file)
    return str(document.get("session") or "") if str(document.get("format")).startswith(_RUN) else None
