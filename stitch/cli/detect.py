"""`stitch detect SESSION`: boards and balls in the scans become labelled points, points.csv."""

import json
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from stitch.cli.options import Json
from stitch.cli.streams import emit
from stitch.detection.board import parse_board
from stitch.errors import InputError
from stitch.intake.targets_in_scans import TargetsFound, targets_in
from stitch.reading.session_folder import load_session
from stitch.system.whole_file import whole
from stitch.writing.session_files import write_table

# Larger balls fit on no table.
_LARGEST_MM = 2000.0


def detect(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.")],
    board: Annotated[
        list[str] | None,
        typer.Option(
            "--board",
            metavar="BOARD",
            help="charuco:11x8:20:15:DICT_4X4_50 (squares; sides of square and marker, mm), checkerboard:9x6:25 "
            "(squares; side), apriltag:36h11:40; may be repeated.",
        ),
    ] = None,
    ball: Annotated[
        list[str] | None,
        typer.Option("--ball", metavar="RADIUS", help="Radius of balls, mm, or any; may be repeated."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find boards and balls in the scans of a session and write them as labelled points beside them."""
    boards = [parse_board(text) for text in board or ()]
    balls = None if not ball else _radii(ball)
    if not boards and balls is None:
        raise InputError("stitch detect: nothing to look for; to fix: state --board or --ball")
    file = session / "points.csv"
    if file.exists() or file.is_symlink():
        raise InputError(f"{file}: exists already; to fix: remove it, or give it another name")
    loaded = load_session(session)
    found = targets_in(loaded, boards, balls)
    with whole(file) as scratch:
        write_table(scratch, _columns(found))
    for note in found.notes:
        print(f"{note}.", file=sys.stderr)
    if as_json:
        emit(json.dumps(_document(session, found), indent=1))
    showing = sum(bool(s.targets) for s in found.sightings)
    print(f"{file}: {len(found.seen)} targets in {showing} of {len(found.views)} views", file=sys.stderr)
    print(f"next: stitch run {session}", file=sys.stderr)


def _radii(stated: list[str]) -> list[float]:
    """Radii in mm; none for balls of any radius."""
    if stated == ["any"]:
        return []
    try:
        radii = [float(text) for text in stated]
    except ValueError:
        radii = [0.0]
    if not all(0 < radius < _LARGEST_MM for radius in radii):
        raise InputError(f"--ball {' --ball '.join(stated)}: to fix: state radii in mm, above 0, or any alone")
    return radii


def _columns(found: TargetsFound) -> dict[str, list[object]]:
    rows = [
        (view, name, *point, sigma)
        for view, sighting in zip(found.views, found.sightings, strict=True)
        for name, point, sigma in zip(sighting.targets, sighting.points.tolist(), sighting.sigma.tolist(), strict=True)
    ]
    return {
        name: list(cells)
        for name, cells in zip(("view", "target", *"xyz", "sigma"), zip(*rows, strict=True), strict=True)
    }


def _document(session: Path, found: TargetsFound) -> dict[str, object]:
    sigma = np.concatenate([s.sigma for s in found.sightings])
    return {
        "session": str(session),
        "views": {view: len(s.targets) for view, s in zip(found.views, found.sightings, strict=True)},
        "targets": found.seen,
        "median_sigma": float(np.median(sigma)),
        "notes": list(found.notes),
    }
