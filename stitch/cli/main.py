"""`stitch`: parsing and printing only; every command is also a library function.

Other packages, and the cells, add commands through the entry-point group `stitch.commands`.
"""

import sys
from collections.abc import Sequence
from importlib.metadata import entry_points

import typer

from stitch.cli.batch import batch
from stitch.cli.calibrate import calibrate
from stitch.cli.change import add, drop
from stitch.cli.check import check
from stitch.cli.compare import compare_run
from stitch.cli.diagnose import diagnose_run, next_measurement
from stitch.cli.effects import effects
from stitch.cli.import_file import import_command
from stitch.cli.report import report
from stitch.cli.run import run
from stitch.errors import StitchError

app = typer.Typer(
    help="Stitch robot scans: find and correct the hand-eye, register, fuse, and say what is left.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None,
)  # fmt: skip


def build() -> typer.Typer:
    """The application with the commands of every installed package."""
    app.command()(run)
    app.command()(check)
    app.command("compare")(compare_run)
    app.command("diagnose")(diagnose_run)
    app.command()(add)
    app.command()(drop)
    app.command("next")(next_measurement)
    app.command()(effects)
    app.command()(report)
    app.command()(batch)
    app.command("import")(import_command)
    app.add_typer(calibrate, name="calibrate")
    for entry in sorted(entry_points(group="stitch.commands"), key=lambda e: e.name):
        app.command(entry.name)(entry.load())
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; errors of the input or the computation end in one line and their exit code."""
    try:
        build()(list(arguments) if arguments is not None else None)
    except StitchError as error:
        print(f"stitch: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        print(f"stitch: {error.filename or 'file system'}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
