"""`stitch import FILE`: the points of a robot program or of a tracker as a table of a session."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import require_new, split_names
from stitch.cli.terminal import results_stream, say, stdout_for_results

_File = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="FANUC .ls, KUKA .dat/.src, ABB .mod, UR .script/.csv, tracker .csv; or a table of poses or joint "
        "angles as text, JSON, YAML, NPY.",
    ),
]
_Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="TABLE", help="views.csv to write; default standard output.")
]
_Unit = Annotated[str, typer.Option("--unit", help="mm or m: the session's length_unit.")]
_Frame = Annotated[
    str | None, typer.Option("--frame", help="Frame of the points in the base, numbers as the controller shows them.")
]
_Tool = Annotated[str | None, typer.Option("--tool", help="Tool in the flange, numbers as the controller shows them.")]
_Columns = Annotated[
    str | None, typer.Option("--columns", help="Of a table: x,y,z,rx,ry,rz or j1,j2 …; - leaves one out.")
]
_Rotation = Annotated[
    str | None, typer.Option("--rotation", help="Of a table: xyz-extrinsic, zyx-intrinsic, rotation-vector …")
]
_Angles = Annotated[str | None, typer.Option("--angles", help="Of a table: deg or rad.")]
_FileUnit = Annotated[str | None, typer.Option("--file-unit", help="Of a table: mm, m, cm or inch.")]
_Inverse = Annotated[bool, typer.Option("--inverse", help="The table holds T_flange_base.")]


@stdout_for_results
def import_command(
    file: _File,
    output: _Output = None,
    unit: _Unit = "mm",
    frame: _Frame = None,
    tool: _Tool = None,
    columns: _Columns = None,
    rotation: _Rotation = None,
    angles: _Angles = None,
    file_unit: _FileUnit = None,
    inverse: _Inverse = False,
) -> None:
    """Write the points of a robot program, of a tracker or of a table as views.csv (frames.csv, points.csv).

    \b
    Examples:
      stitch import scan.ls -o views.csv --frame 0,0,0,0,0,0 --tool 0,0,150,0,0,0
      stitch import poses.txt -o views.csv --columns x,y,z,rx,ry,rz --rotation xyz-extrinsic --angles deg
    """
    from stitch.plugins.intake.import_table import import_export
    from stitch.plugins.intake.readings import StatedTable
    from stitch.system.files import whole_file

    require_new(output)
    stated = StatedTable(split_names(columns), rotation, angles, length_unit=file_unit, inverse=inverse or None)
    imported = import_export(file, unit, stated, frame, tool)
    if output is None:
        results_stream().write(imported.text)
    else:
        with whole_file(output) as scratch:
            scratch.write_text(imported.text, encoding="utf-8")
    for warning in imported.warnings:
        say(f"stitch: {file}: {warning}", stream=sys.stderr)
    where = output or "standard output"
    say(f"{imported.rows} rows of {imported.table} to {where}; orientations: {imported.convention}", stream=sys.stderr)
