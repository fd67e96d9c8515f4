"""`stitch watch CELL`: what moves in a cell, since when, until when the calibration in use holds."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json, Tolerance, require_tolerance
from stitch.errors import InputError


def watch(
    cells: Annotated[list[Path], typer.Argument(metavar="CELL...", help="Folder of a cell; after --add, its runs.")],
    add: Annotated[bool, typer.Option("--add", help="CELL RUN...: append runs to the history of the cell.")] = False,
    at: Annotated[str, typer.Option("--at", metavar="TIME", help="With --add RUN: when it was measured.")] = "",
    in_use: Annotated[
        Path | None,
        typer.Option("--in-use", metavar="RUN", help="Run whose calibration the cell uses from now on."),
    ] = None,
    tolerance: Tolerance = None,
    page: Annotated[bool, typer.Option("--page/--no-page", help="Write watch.html and watch.prom.")] = True,
    dfq: Annotated[Path | None, typer.Option("--dfq", metavar="FILE", help="Also write the history as Q-DAS.")] = None,
    as_json: Json = False,
) -> None:
    """Watch a cell from day to day: what drifts, since when, beside which channel; exit code 3 if something does.

    \b
    Examples:
      stitch watch cell-7 --add runs/monday-1 runs/monday-2
      stitch watch cell-7 --tolerance 0.1
      stitch watch cell-7 cell-8 cell-9
    """
    require_tolerance(tolerance)
    runs = cells[1:] if add else []
    folders = cells[:1] if add else cells
    _require_sense(add, runs, at, in_use, dfq, folders)
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.watched_cells import run_watch

    run_watch(folders, runs, add=add, at=at, in_use=in_use, tolerance=tolerance, page=page, dfq=dfq, as_json=as_json)


def _require_sense(
    add: bool, runs: list[Path], at: str, in_use: Path | None, dfq: Path | None, folders: list[Path]
) -> None:
    """Refuse options that do not go together."""
    if add and not runs:
        raise InputError("--add: no runs; to fix: name the cell first, then its runs: stitch watch CELL --add RUN")
    if at and len(runs) != 1:
        raise InputError("--at: says when one run was measured; to fix: name one RUN with --add")
    if len(folders) > 1 and (in_use is not None or dfq is not None):
        raise InputError("--in-use and --dfq: belong to one cell; to fix: name one")
    if dfq is not None and (dfq.suffix.lower() != ".dfq" or not dfq.parent.is_dir()):
        raise InputError(f"--dfq {dfq}: to fix: name a file that ends in .dfq, in a folder that exists")
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(f"two cells are named {max(names, key=names.count)!r}; to fix: name each once")
