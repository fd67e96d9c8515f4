"""`stitch demo`: a blade cell with a hand-eye that is a little wrong and an effect that nobody told it of."""

import shlex
import shutil
from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError

# What the demo may hide: each is visible on a blade that is turned and tilted in front of a scanner.
HIDDEN = ("joint_compliance", "joint_offset", "backlash", "range_scale", "lens_distortion", "part_slip")


def demo(
    folder: Annotated[Path, typer.Argument(help="Where session and run are written.")] = Path("runs/demo"),
    seed: Annotated[int, typer.Option(help="Another seed, another cell and another hidden effect.")] = 0,
    verify: Annotated[bool, typer.Option("--verify", help="Instead: a sphere plate and a part, verified.")] = False,
) -> None:
    """Scan a blade in a cell with a hidden effect, stitch it, find the effect, add it, and watch the error fall.

    \b
    Examples:
      stitch demo
      stitch demo elsewhere --seed 4
      stitch demo plate --verify
    """
    if verify:
        _demo_verify(folder, seed)
        return
    # Imported here so that --help stays fast.
    import numpy as np

    from data_synth.commands import reveal
    from data_synth.made_session import make, truth_path
    from data_synth.write import write_session, write_truth
    from stitch.cli.change import add
    from stitch.cli.diagnose import diagnose_run
    from stitch.cli.run import run
    from stitch.cli.terminal import headlines_only, say, show_files

    session = folder / "blade"
    if folder.exists() and not truth_path(session).is_file():
        raise InputError(f"{folder}: exists and is not a demo; to fix: name another folder")
    shutil.rmtree(folder, ignore_errors=True)
    hidden = str(np.random.default_rng(seed).choice(HIDDEN))
    measured = make("blade", {hidden: 2.0}, seed)
    say(f"Scanned a blade from {len(measured.clouds)} poses, with one effect hidden → {session}")
    write_session(session, measured, "blade")
    write_truth(truth_path(session), measured, seed)
    with headlines_only():
        say("stitch run: correct the hand-eye, register, fuse", bold=True)
        run([session], folder / "run", recording=False)
        say("stitch diagnose: what is missing?", bold=True)
        diagnose_run(folder / "run")
        say("stitch add --suggested: add it, fit everything anew, ask again", bold=True)
        add(folder / "run", suggested=True)
    say("stitch reveal: what was hidden", bold=True)
    reveal(folder / "run", truth_path(session))
    show_files(folder / "run", ("stitched.ply", "recording.rrd", "report.html"))
    say(f"Next: stitch review {shlex.quote(str(folder / 'run'))}")


def _demo_verify(folder: Path, seed: int) -> None:
    """Fit a cell on a part, measure the part with U, and verify the fit by a calibrated sphere plate."""
    from data_synth.cells.verified_cell import write_verified_cell
    from stitch.cli.run import run
    from stitch.cli.terminal import headlines_only, say, show_files
    from stitch.plugins.metrology.measure import measure
    from stitch.plugins.metrology.verify import verify as verify_run

    if folder.exists() and not (folder / "artefact.truth.json").is_file():
        raise InputError(f"{folder}: exists and is no demo of a verification; to fix: name another folder")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    made = write_verified_cell(folder, seed)
    say(f"Scanned a part on one day, the sphere plate that verifies the cell on another → {folder}")
    with headlines_only():
        say("stitch run: hand-eye from the part", bold=True)
        run([made["part"]], folder / "run", recording=False)
    say("stitch measure: features of the part with U", bold=True)
    measure(folder / "run", folder / "part.toml")
    say("stitch verify: an artefact that no fit has seen", bold=True)
    verify_run(folder / "run", made["artefact"], output=folder / "certificate")
    show_files(folder / "certificate", ("certificate.json", "certificate.html"))
