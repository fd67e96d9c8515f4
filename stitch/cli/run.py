"""`stitch run SESSION...`: coarse → correct → register → fuse, one run folder per call."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import (
    EffectsFile,
    Force,
    Json,
    Memory,
    Tolerance,
    Trust,
    bytes_of,
    require_tolerance,
    split_names,
)
from stitch.cli.run_options import ModelOptions, RunOptions

_Sessions = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[SESSION]...", help="Session folders of one rig; default: the one you stand in."),
]
_Output = Annotated[Path | None, typer.Option("-o", "--output", metavar="RUN", help="Run folder; default runs/NAME.")]
_HandEye = Annotated[
    Path | None, typer.Option("--hand-eye", metavar="RUN2", help="Use the model of another run, do not correct.")
]
_Arm = Annotated[
    Path | None,
    typer.Option("--arm", metavar="RUN2", help="Keep the arm of another run (joints, links), fit all else."),
]
_Effects = Annotated[str, typer.Option("--effects", help="Effects to fit, separated by commas.")]
_Keep = Annotated[bool, typer.Option("--keep", help="Fuse also the views that do not belong.")]
_Register = Annotated[
    str | None,
    typer.Option("--register", metavar="METHOD", help="How single views are registered: dpwvm (usual) or gicp."),
]
_Recording = Annotated[bool, typer.Option("--recording/--no-recording", help="Write recording.rrd.")]
_Mesh = Annotated[bool, typer.Option("--mesh", help="Also write mesh.ply.")]


def run(
    sessions: _Sessions = None,
    output: _Output = None,
    hand_eye: _HandEye = None,
    arm: _Arm = None,
    effects: _Effects = "",
    effects_file: EffectsFile = None,
    trust: Trust = False,
    force: Force = False,
    keep: _Keep = False,
    register: _Register = None,
    recording: _Recording = True,
    mesh: _Mesh = False,
    tolerance: Tolerance = None,
    memory: Memory = None,
    as_json: Json = False,
) -> None:
    """Find and correct the hand-eye, register the views, fuse them.

    \b
    Examples:
      stitch run blade-17
      stitch run
      stitch run blade-17 -o found --effects joint_offset,backlash
      stitch run monday tuesday -o both
      stitch run blade-18 --hand-eye found --mesh
      stitch run other-scanner --arm found
      stitch run fuselage --memory 4GB
    """
    require_tolerance(tolerance)
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.run_sessions import run_sessions

    named = tuple(name for name in split_names(effects) if name)
    options = RunOptions(
        output=output,
        model=ModelOptions(hand_eye, arm, named, effects_file=effects_file, trust=trust),
        force=force,
        keep=keep,
        register=register,
        recording=recording,
        mesh=mesh,
        tolerance=tolerance,
        memory=bytes_of(memory),
        as_json=as_json,
    )
    run_sessions(sessions or [], options)
