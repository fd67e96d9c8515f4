"""`stitch demo`: a blade cell with a hand-eye that is a little wrong, stitched end to end."""

import shutil
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from data_synth.cell import Cell, measure
from data_synth.scanner import AreaScanner
from data_synth.shapes import blade
from data_synth.write import write_session
from stitch import frames
from stitch.errors import InputError

_VIEWS = 18
# The coarse hand-eye of the demo: a good guess, wrong by 2° and 8 mm.
_COARSE_ERROR = np.array([0.02, -0.025, 0.015, 4.0, -5.0, 4.5])


def demo(
    folder: Annotated[Path, typer.Argument(help="Where session and run are written.")] = Path("runs/demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another cell.")] = 0,
) -> None:
    """Scan a synthetic blade with a wrong hand-eye and stitch it."""
    from stitch.cli.run import run

    session = folder / "blade"
    if folder.exists() and not (folder / "blade.truth.json").is_file():
        raise InputError(f"{folder}: exists and is not a demo; name another folder")
    shutil.rmtree(folder, ignore_errors=True)
    print(f"Scanning a blade from {_VIEWS} poses → {session}", file=sys.stderr)
    cell = Cell(scanner=AreaScanner(200, 200))
    measured = measure(blade.build(), cell, _VIEWS, seed)
    write_session(session, "blade", cell, measured, measured.T_mount @ frames.exp(_COARSE_ERROR))
    run([session], output=folder / "run", hand_eye=None, effects="", recording=True, mesh=False, as_json=False)
    _score(folder / "run", measured.T_mount, np.mean([c.mean(axis=0) for c in measured.clouds], axis=0))


def _score(run: Path, T_true: np.ndarray, part: np.ndarray) -> None:
    """Compare with the truth, which the run never saw."""
    from stitch.model import read_model

    model = read_model(run)
    errors = [
        np.linalg.norm(frames.transform(T, part[None]) - frames.transform(T_true, part[None]))
        for T in (model.T_mount_coarse, model.T_mount)
    ]
    print(
        f"True error of the hand-eye at the part: {errors[0] * 1e3:.0f} µm given, {errors[1] * 1e3:.1f} µm corrected.",
        file=sys.stderr,
    )
