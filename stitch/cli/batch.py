"""`stitch batch SESSION…`: many sessions, each a run of its own."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from stitch.cli.options import Force, Json
from stitch.cli.progress import Tee
from stitch.cli.run import recordings
from stitch.cli.streams import emit
from stitch.errors import InputError, NoResultError, StitchError
from stitch.pipeline import run
from stitch.reading.session_folder import load_session
from stitch.reading.session_toml import document, name_of
from stitch.system.console import console
from stitch.system.steps import steps
from stitch.units import MICROMETRES, length_text
from stitch.writing import run_folder
from stitch.writing.json_file import to_json


def batch(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where the runs go.")] = Path("runs"),
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[str, typer.Option("--scheduler", metavar="tcp://…", help="A Dask scheduler instead.")] = "",
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Run many sessions; one that fails does not stop the others.

    \b
    Examples:
      stitch batch blade-17 blade-18 blade-19 -o runs --workers 2
    """
    folders = [output / _name(path) for path in sessions]
    if len(set(folders)) < len(folders):
        twice = max(folders, key=folders.count).name
        raise InputError(f"two of the sessions are named {twice!r}; run them with -o of their own")
    rows = list(steps("sessions", _map(sessions, folders, force, workers, scheduler), len(sessions)))
    if as_json:
        emit(to_json(rows))
    else:
        _show(rows)
    failed = [row for row in rows if row["error"]]
    if failed:
        refused = all(row["bad_input"] for row in failed)
        kind = InputError if refused else NoResultError
        raise kind(f"{len(failed)} of {len(rows)} sessions have no result; their lines say why")


def _name(session: Path) -> str:
    """What the session is called; a session that cannot be read is refused when it is its turn."""
    try:
        file = session / "session.toml"
        return name_of(file, document(file))
    except InputError:
        return session.resolve().name


def stitch_one(session: Path, folder: Path, force: bool = False) -> dict[str, Any]:
    """Run one session into its folder; what goes wrong becomes part of the answer."""
    try:
        loaded = load_session(session)
        with run_folder.new_folder(folder, [session], force) as scratch:
            result = run(loaded, recorder=Tee(recordings(scratch)))
            run_folder.write_with_page(result, scratch)
    except Exception as error:  # whatever befalls one session, the others go on
        kind = "" if isinstance(error, StitchError) else f"{type(error).__name__}: "
        told = f"{kind}{' '.join(str(error).split())}"
        return {"session": str(session), "run": None, "error": told, "bad_input": isinstance(error, InputError)}
    um = MICROMETRES[result.session.length_unit]
    return {
        "session": str(session),
        "run": str(folder),
        "error": None,
        "bad_input": False,
        "residual_um": result.residual_rms * um,
        "registered_um": result.stages[2].rms * um,
        "noise_floor_um": result.noise_floor * um,
        "seconds": sum(s.seconds for s in result.stages),
    }


def _map(
    sessions: list[Path], folders: list[Path], force: bool, workers: int, scheduler: str
) -> Iterator[dict[str, Any]]:
    one = partial(stitch_one, force=force)
    if scheduler:
        try:
            client = import_module("distributed").Client(scheduler, timeout=10)
        except ModuleNotFoundError:
            raise InputError("--scheduler needs the package distributed: pip install distributed") from None
        except OSError as error:
            raise InputError(f"--scheduler {scheduler}: no answer ({error})") from None
        absolute = [[p.resolve() for p in paths] for paths in (sessions, folders)]
        yield from client.gather(client.map(one, *absolute))
    elif workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            yield from pool.map(one, sessions, folders)
    else:
        yield from map(one, sessions, folders)


def _show(rows: list[dict[str, Any]]) -> None:
    terminal, table = console(), Table()
    for heading in ("session", "one hand-eye", "registered", "noise", "seconds"):
        table.add_column(heading, justify="left" if heading == "session" else "right")
    for row in rows:
        keys = ("residual_um", "registered_um", "noise_floor_um")
        told = ["–"] * 3 if row["error"] else [length_text(row[key] / 1e3, "mm", zeros=True) for key in keys]
        table.add_row(Path(row["session"]).name, *told, "–" if row["error"] else f"{row['seconds']:.1f}")
    terminal.print(table)
    for row in rows:
        if row["error"]:
            terminal.print(f"{row['session']}: {row['error']}", soft_wrap=True)
