"""`stitch demo`: a blade cell with a hand-eye that is a little wrong and an effect that nobody told it of."""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError

# What the demo may hide: each is visible on a blade that is turned and tilted in front of a scanner.
HIDDEN = ("joint_compliance", "joint_offset", "backlash", "range_scale", "lens_distortion", "part_slip")


def demo(
    folder: Annotated[Path, typer.Argument(help="Where session and run are written.")] = Path("runs/demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another cell and another hidden effect.")] = 0,
) -> None:
    """Scan a blade in a cell with a hidden effect, stitch it, find the effect, add it, and watch the error fall.

    \b
    Examples:
      stitch demo
      stitch demo elsewhere --seed 4
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    import numpy as np

    from data_synth.commands import reveal
    from data_synth.made_session import make, truth_path
    from data_synth.write import write_session, write_truth
    from stitch.cli.change import AT_MOST, add_diagnosed
    from stitch.cli.diagnose import run_diagnose
    from stitch.cli.run import RunOptions, run_sessions

    session = folder / "blade"
    if folder.exists() and not truth_path(session).is_file():
        raise InputError(f"{folder}: exists and is not a demo; name another folder")
    shutil.rmtree(folder, ignore_errors=True)
    hidden = str(np.random.default_rng(seed).choice(HIDDEN))
    measured = make("blade", {hidden: 2.0}, seed)
    _say(f"Scanned a blade from {len(measured.clouds)} poses, with one effect hidden → {session}")
    write_session(session, measured, "blade")
    write_truth(truth_path(session), measured, seed)
    _say("\nstitch run: correct the hand-eye, register, fuse")
    run_sessions([session], RunOptions(output=folder / "run", recording=False, says_next=False))
    _say("\nstitch diagnose: what is missing?")
    run_diagnose(folder / "run", None, trust=False, as_json=False, says_next=False)
    _say("\nstitch add --suggested: add it, fit everything anew, ask again")
    add_diagnosed(folder / "run", AT_MOST, says_next=False)
    _say("\nstitch reveal: what was hidden")
    reveal(folder / "run", truth_path(session))
    for name in ("stitched.ply", "recording.rrd", "report.html"):
        _say(f"  {folder / 'run' / name}")
    _say(f"Next: stitch review {shlex.quote(str(folder / 'run'))}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
