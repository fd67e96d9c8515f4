"""`stitch import FILE`: the points of a robot program or of a tracker as a table of a session."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.terminal.streams import results
from stitch.errors import InputError
from stitch.system.whole_file import whole


def import_command(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="FANUC .ls, KUKA .dat/.src, ABB .mod, UR .script/.csv, tracker .csv; or a table of poses or joint "
            "angles as text, JSON, YAML, NPY.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="TABLE", help="views.csv to write; default standard output."),
    ] = None,
    unit: Annotated[str, typer.Option("--unit", help="mm or m: the session's length_unit.")] = "mm",
    frame: Annotated[
        str | None,
        typer.Option("--frame", help="Frame of the points in the base, numbers as the controller shows them."),
    ] = None,
    tool: Annotated[
        str | None, typer.Option("--tool", help="Tool in the flange, numbers as the controller shows them.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option("--columns", help="Of a table: x,y,z,rx,ry,rz or j1,j2 …; - leaves one out.")
    ] = None,
    rotation: Annotated[
        str | None, typer.Option("--rotation", help="Of a table: xyz-extrinsic, zyx-intrinsic, rotation-vector …")
    ] = None,
    angles: Annotated[str | None, typer.Option("--angles", help="Of a table: deg or rad.")] = None,
    file_unit: Annotated[str | None, typer.Option("--file-unit", help="Of a table: mm, m, cm or inch.")] = None,
    inverse: Annotated[bool, typer.Option("--inverse", help="The table holds T_flange_base.")] = False,
) -> None:
    """Write the points of a robot program, of a tracker or of a table as views.csv (frames.csv, points.csv).

    \b
    Examples:
      stitch import scan.ls -o views.csv --frame 0,0,0,0,0,0 --tool 0,0,150,0,0,0
      stitch import poses.txt -o views.csv --columns x,y,z,rx,ry,rz --rotation xyz-extrinsic --angles deg
    """
    if output is not None and (output.exists() or output.is_symlink()):
        raise InputError(f"{output}: exists already; name another file, or remove it")
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.controllers.importer import import_file
    from stitch.intake.import_table import import_table, is_table_of_poses
    from stitch.intake.stated import Stated

    names = tuple(name.strip() for name in columns.split(",")) if columns else ()
    stated = Stated(None, names, rotation, angles, file_unit, inverse=inverse or None)
    if stated != Stated() or is_table_of_poses(file):
        imported = import_table(file, unit, stated)
    else:
        imported = import_file(file, unit, frame, tool)
    if output is None:
        results().write(imported.text)
    else:
        with whole(output) as file:
            file.write_text(imported.text, encoding="utf-8")
    for warning in imported.warnings:
        print(f"stitch: {file}: {warning}", file=sys.stderr)
    where = output or "standard output"
    print(f"{imported.rows} rows of {imported.table} to {where}; orientations: {imported.convention}", file=sys.stderr)
