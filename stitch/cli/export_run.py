"""`stitch export RUN`: what a run found in the words of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust, require_new
from stitch.errors import InputError
from stitch.export.export_options import ARM, CLOUD, HAND_EYE, LIMIT_MM

_KINDS = f"hand-eye: {', '.join(HAND_EYE)}; arm: {', '.join(ARM)}; cloud: {', '.join(CLOUD)}"
_To = Annotated[str | None, typer.Option("--to", metavar="FORMAT", help=f"{_KINDS}.")]
_Program = Annotated[
    Path | None,
    typer.Option("--program", metavar="FILE", help="Move the targets of a KUKA, FANUC, ABB or UR program."),
]
_Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FILE", help="File to write; texts: standard output.")
]
_Parent = Annotated[
    str | None, typer.Option("--parent", help="Name of the frame that carries the scanner: flange, base_link …")
]
_Child = Annotated[str, typer.Option("--child", help="Name of the scanner's frame.")]
_Frame = Annotated[
    str | None, typer.Option("--frame", help="Of a program's poses in the base, numbers as the controller shows.")
]
_Tool = Annotated[
    str | None, typer.Option("--tool", help="Of a program's poses in the flange, numbers as the controller shows.")
]
_Limit = Annotated[float, typer.Option("--limit", metavar="MM", help="Largest move of a target that is believed.")]
_Near = Annotated[str | None, typer.Option("--near", help="Joint angles in degrees about which the program works.")]
_J3 = Annotated[
    str | None, typer.Option("--j3", help="Of a FANUC program: own, or j2+j3 where the session's joint 3 is that.")
]


def export_run(
    run: RunFolder,
    to: _To = None,
    program: _Program = None,
    output: _Output = None,
    parent: _Parent = None,
    child: _Child = "scanner",
    frame: _Frame = None,
    tool: _Tool = None,
    limit: _Limit = LIMIT_MM,
    near: _Near = None,
    j3: _J3 = None,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Write what a run found for other programs, or a compensated copy of a robot program.

    \b
    Examples:
      stitch export runs/blade-17 --to ros
      stitch export runs/blade-17 --to kuka -o scanner.txt
      stitch export runs/blade-17 --to glb -o blade.glb
      stitch export runs/blade-17 --program scan.src -o compensated.src --frame 0,0,0,0,0,0 --tool 0,0,150,0,0,0
    """
    _require_export_options(to, program, output)
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.exported_program import export_program
    from stitch.cli.actions.exported_run import export_result
    from stitch.export.arm_model import arm_of_run

    if program is not None:
        arm = arm_of_run(run, effects_file, trust)
        export_program(program, arm, output, frame, tool, limit=limit, near=near, j3=j3, as_json=as_json)
    else:
        export_result(run, str(to), output, parent, child, effects_file, trust=trust)


def _require_export_options(to: str | None, program: Path | None, output: Path | None) -> None:
    """Refuse neither or both of format and program, a format that is none, and a file that has no place."""
    if (to is None) == (program is None):
        raise InputError("export what? to fix: name one of --to FORMAT and --program FILE")
    require_new(output)
    if output is not None and not output.parent.is_dir():
        raise InputError(f"{output}: there is no folder {output.parent}; to fix: make it, or name another")
    if program is None and to not in (*HAND_EYE, *ARM, *CLOUD):
        raise InputError(f"--to {to}: to fix: one of {_KINDS}")
