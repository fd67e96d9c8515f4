"""`stitch demo`: a blade cell with a hand-eye that is a little wrong and an effect that nobody told it of."""

import shutil
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from data_synth.commands import make, truth_path
from data_synth.write import write_session, write_truth
from stitch.errors import InputError

# What the demo may hide: each is visible on a blade that is turned and tilted in front of a scanner.
HIDDEN = ("joint_compliance", "joint_offset", "mount_warmup", "backlash", "range_scale", "lens_distortion")


def demo(
    folder: Annotated[Path, typer.Argument(help="Where session and run are written.")] = Path("runs/demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another cell and another hidden effect.")] = 0,
) -> None:
    """Scan a synthetic blade in a cell with a hidden effect, stitch it, and compare with the truth."""
    from stitch.cli.run import run

    session = folder / "blade"
    if folder.exists() and not truth_path(session).is_file():
        raise InputError(f"{folder}: exists and is not a demo; name another folder")
    shutil.rmtree(folder, ignore_errors=True)
    hidden = str(np.random.default_rng(seed).choice(HIDDEN))
    measured = make("blade", {hidden: 2.0}, seed)
    print(f"Scanning a blade from {len(measured.clouds)} poses, with one effect hidden → {session}", file=sys.stderr)
    write_session(session, measured, "blade")
    write_truth(truth_path(session), measured, seed)
    run([session], output=folder / "run", recording=False)
