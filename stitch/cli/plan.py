"""`stitch plan SESSION|RUN`: what planned views would tell, and which further ones to take."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json, Trust
from stitch.errors import InputError

_Folder = Annotated[
    Path, typer.Argument(metavar="SESSION|RUN", help="Session with planned views, or folder that `stitch run` wrote.")
]
_Views = Annotated[int | None, typer.Option("--views", metavar="N", help="Further views at the most.")]
_Split = Annotated[
    tuple[str, str] | None,
    typer.Option("--split", metavar="EFFECT EFFECT", help="Views that tell these two apart."),
]
_Halve = Annotated[bool, typer.Option("--halve", help="Views that halve the hand-eye's uncertainty.")]
_Feature = Annotated[
    str | None,
    typer.Option("--for", metavar="FEATURE", help="Where U counts: x,y,z in the frame of the stitched cloud."),
]
_Part = Annotated[
    Path | None, typer.Option("--part", metavar="MESH", help="The part: a mesh, or a cloud with normals.")
]
_Size = Annotated[
    float | None,
    typer.Option("--size", metavar="MM", help="Longest side of a part of which nothing else is known."),
]
_Field = Annotated[float | None, typer.Option("--field", metavar="DEG", help="Full angle of the scanner's field.")]
_Start = Annotated[
    str | None,
    typer.Option("--start", metavar="J1,J2,…", help="Joint angles (°) that see the part, where no view is planned."),
]
_Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="New folder for views.csv and plan.json.")
]


def plan_views(
    folder: _Folder,
    views: _Views = None,
    split: _Split = None,
    halve: _Halve = False,
    feature: _Feature = None,
    part: _Part = None,
    size: _Size = None,
    field: _Field = None,
    start: _Start = None,
    output: _Output = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say before measuring what views would tell, and which further ones bring most.

    \b
    Examples:
      stitch plan blade-18 --size 300
      stitch plan blade-18 --part blade.stl --split joint_compliance gear_eccentricity -o more
      stitch plan runs/blade-17 --halve
    """
    _require_plan_options(views, size, field, output)
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.planned_views import PlanOptions, StatedCell, run_plan

    stated = StatedCell(part, size, field, start)
    run_plan(folder, PlanOptions(views, split, halve, feature), stated, output, trust=trust, as_json=as_json)


def _require_plan_options(views: int | None, size: float | None, field: float | None, output: Path | None) -> None:
    if views is not None and not 0 < views <= 40:
        raise InputError(f"--views {views}: to fix: give a number from 1 to 40")
    if size is not None and not 0 < size < 1e6:
        raise InputError(f"--size {size:g}: to fix: give the part's longest side in mm, above zero")
    if field is not None and not 0 < field < 150:
        raise InputError(f"--field {field:g}: to fix: give the full angle in degrees, between 0 and 150")
    if output is not None and output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output}: there is such a folder; to fix: name another, or move it away")
