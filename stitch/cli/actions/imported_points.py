"""What `stitch import` does: the points of a program, of a tracker or of a table, as a table of a session."""

import sys
from pathlib import Path

from stitch.cli.terminal.streams import results_stream
from stitch.controllers.importer import import_file
from stitch.intake.import_table import import_table, is_table_of_poses
from stitch.intake.stated import StatedTable
from stitch.system.whole_file import whole_file


def run_import(
    file: Path, output: Path | None, unit: str, stated: StatedTable, *, frame: str | None, tool: str | None
) -> None:
    """Read a file as a table of poses, where it is one or anything is stated of one, else as a controller's.

    Raises:
        InputError, NoResultError: as `stitch import` ends.
    """
    if stated != StatedTable() or is_table_of_poses(file):
        imported = import_table(file, unit, stated)
    else:
        imported = import_file(file, unit, frame, tool)
    if output is None:
        results_stream().write(imported.text)
    else:
        with whole_file(output) as scratch:
            scratch.write_text(imported.text, encoding="utf-8")
    for warning in imported.warnings:
        print(f"stitch: {file}: {warning}", file=sys.stderr)
    where = output or "standard output"
    print(f"{imported.rows} rows of {imported.table} to {where}; orientations: {imported.convention}", file=sys.stderr)
