"""JSON without NaN, written whole or not at all, and what in a run folder is the run's and may be replaced.

Everything else there is a person's own.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stitch.errors import InputError
from stitch.session.reading.text_files import read_json_object
from stitch.system.files import Ours, whole_file

# Of result.json.
FORMAT = "stitch-run/1"
# Normals of the scans, for commands that read the run again.
SCANS = ".scans.npz"
# Every file that a command writes into a run folder. What is not listed here is never removed.
FILES = {
    *("model.toml", "result.json", "ledger.json", "stitched.ply", "mesh.ply", "residuals.parquet", "recording.rrd"),
    *("report.html", "report.pdf", "two-runs.html", "two-runs.pdf", "features.json", "features.csv", "features.html"),
    *("compare.json", "witness.json", "witness.png", "diagnosis.json", "diagnosis.rrd", "robot.toml", "robot.urdf"),
    "model_effects.py",
    SCANS,
}
# Earlier fits of the run, by what they were made of.
FITS = ".fits"
# "suspects" is what "candidates" was called once.
_PICTURES = {
    *("budget", "candidates", "suspects", "added_variable", "shape", "aliases", "views", "joint_courses"),
    *("time_course", "field_map", "compare"),
}


def is_run_file(path: Path) -> Ours:
    """Return a function that says of a path, relative to the run folder `path`, whether stitch writes such a file."""
    inner = set(_inner_runs(path))

    def is_ours(inside: Path) -> bool:
        """Return whether a file, by its path relative to the folder, is one that a command writes."""
        # The folder of several sessions holds a run folder for each.
        if inside.parts[0] in inner:
            inside = inside.relative_to(inside.parts[0])
        match inside.parts:
            case (name,):
                # .NAME.new is a file that was being written when the process ended.
                return name in FILES or (name.startswith(".") and name.endswith(".new") and name[1:-4] in FILES)
            case (folder, *_) if folder == FITS:
                return True
            case ("pictures", _):
                return inside.stem in _PICTURES and inside.suffix in (".png", ".svg")
        return False

    return is_ours


def sessions_in(path: Path) -> list[str] | None:
    """Return paths of the sessions of which a folder holds the run, as its results state them; None: it is no run."""
    if not path.is_dir() or (path / "session.toml").exists() or not (path / "model.toml").is_file():
        return None
    folders = (path, *(path / name for name in _inner_runs(path)))
    sessions = [_session_path(folder / "result.json") for folder in folders]
    return [session for session in sessions if session is not None] or None


def require_free(path: Path, sessions: Sequence[Path], force: bool) -> None:
    """Refuse a path for the run folder of `sessions` where something would be lost.

    Args:
        force: allow the run of other sessions to be replaced.

    Raises:
        InputError: `path` lies in a session, holds one, holds the present folder, is no run, or is one of other
            sessions and not to be replaced by `force`.
    """
    target, here = path.resolve(), Path.cwd()
    if target in (here, *here.parents):
        raise InputError(
            f"{path}: one stands in this folder, and a run replaces it",
            fix_cli="name another with -o",
            fix_python="name another folder",
        )
    read = [session.resolve() for session in sessions]
    for folder in (target, *target.parents):
        if folder in read or (folder / "session.toml").is_file():
            raise InputError(f"{path}: lies in the session {folder}, which is only read; name another folder with -o")
    for session in read:
        if target in session.parents:
            raise InputError(f"{path}: the session {session} lies in it; name another folder with -o")
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if (before := sessions_in(target)) is None:
        raise InputError(
            f"{path}: exists and is not a run folder", fix_cli="name another with -o", fix_python="name another folder"
        )
    if not force and {str(Path(s).resolve()) for s in before} != {str(s) for s in read}:
        raise InputError(
            f"{path}: holds the run of {', '.join(before)}",
            fix_cli="name another with -o, or replace it with --force",
            fix_python="name another folder, or pass force=True",
        )


def runs_of_rig(path: Path) -> list[str]:
    """Return names of the runs in the folder of a rig, which has no result of its own."""
    return [] if (path / "result.json").exists() else _inner_runs(path)


def _inner_runs(path: Path) -> list[str]:
    """Return names of the run folders inside a folder of several runs; empty for any other folder.

    Such a folder belongs to several sessions (model.toml, but no result.json), or to one run of several scanners, whose
    result.json lists them.
    """
    if not path.is_dir() or not (path / "model.toml").is_file():
        return []
    if (path / "result.json").exists() and "scanners" not in read_json_object(path / "result.json"):
        return []
    return sorted(file.parent.name for file in path.glob("*/result.json") if _session_path(file) is not None)


def _session_path(file: Path) -> str | None:
    """Return the path of the session that a result.json states; None where the file is no result of stitch."""
    document = read_json_object(file)
    session = document.get("session") if document.get("format") == FORMAT else None
    return session if isinstance(session, str) and "\0" not in session else None


def write_json(document: Any, path: Path) -> None:
    """Write JSON whole or not at all; what is not known is null."""
    with whole_file(path) as file:
        file.write_text(to_json(document) + "\n", encoding="utf-8")


def to_json(document: Any) -> str:
    """Return JSON text; JSON has no NaN and no infinity: what is not known is null."""
    return json.dumps(without_nan(document), indent=1, allow_nan=False)


def without_nan(value: Any) -> Any:
    """Return a value of JSON, numbers in it that are not finite replaced by None; lists and tables at any depth."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
