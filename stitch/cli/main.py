"""`stitch`: the command line, and how errors end it."""

import errno
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.commands import CommandGroup
from stitch.cli.progress import TimeLeft, live_line
from stitch.cli.terminal import answers, say, speak_any_terminal
from stitch.errors import StitchError
from stitch.session.reading.text_files import shortened
from stitch.system import process, time_limit
from stitch.system.packages import missing_package, stitch_version
from stitch.system.process import watched

_LONGEST = 2000
_ROOM = "; to fix: make room there, then run it again; what stood there is as it was"
_RIGHTS = "; to fix: name a folder that may be written, or change its rights"
_FIXES = {
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: _ROOM,
    errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
    errno.EROFS: _RIGHTS,
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR, errno.ENOENT), "; to fix: name another folder, or make it"),
    errno.ENAMETOOLONG: "; to fix: shorten it",
}


def _version(requested: bool) -> None:
    if requested:
        print(f"stitch {stitch_version()}")
        raise typer.Exit


def build() -> typer.Typer:
    """Return the application with the commands of every installed package."""
    app = typer.Typer(
        cls=CommandGroup,
        help="Stitch robot scans: find and correct the hand-eye, register, fuse, and say what is left.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_options)
    return app


def _options(
    show_version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """What stands before the commands."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; an error ends in one line and an exit code: 2 for wrong input, 1 for anything else.

    Args:
        arguments: words after the program's name; None: those of this process, which then ends.
    """
    # Before a library is loaded that has threads of its own: one that comes later would fight ours for the cores.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    if arguments is None:
        process.keep_freed_memory()
    speak_any_terminal()
    time_limit.may_end_process()
    try:
        with watched(TimeLeft()):
            words = sys.argv[1:] if arguments is None else arguments
            try:
                # JSON is then the only result; what else is said goes beside it.
                with nullcontext() if "--json" in words else answers():
                    build()(list(arguments) if arguments is not None else None)
            except SystemExit as end:
                if arguments is None and not end.code and process.ends_at_once():
                    # Taking arrays, modules and threads down one by one takes a quarter of a second.
                    sys.stdout.flush()
                    sys.stderr.flush()
                    os._exit(0)
                raise
            finally:
                live_line().stop()
    except StitchError as error:
        _exit_with_message(error.command_line, error.exit_code)
    except BrokenPipeError:
        # Whoever read the output has seen enough; nothing must be flushed to it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(1)
    except OSError as error:
        fix = _FIXES.get(error.errno or 0, "")
        place = shortened(error.filename, 200).strip("'") if error.filename else "file system"
        _exit_with_message(f"{place}: {error.strerror or error}{fix}", 2)
    except MemoryError:
        _exit_with_message(
            "not enough memory; to fix: leave out views, thin the scans, or state --memory (stitch run)", 1
        )
    except ModuleNotFoundError as error:
        missing = missing_package(error)
        _exit_with_message(missing or _unexpected_message(error), 2 if missing else 1)
    except Exception as error:
        _exit_with_message(_unexpected_message(error), 1)


def _exit_with_message(message: str, code: int) -> None:
    """Print a message as one line of printable characters on standard error, and end the process with a code."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(message.split()))
    line = f"stitch: {line if len(line) <= _LONGEST else line[:_LONGEST] + ' …'}"
    if sys.stderr.isatty():
        say(line)
    else:
        print(line, file=sys.stderr, flush=True)
    if time_limit.running_over():
        # The thread of an effect that never ends would be waited for.
        os._exit(code)
    sys.exit(code)


def _unexpected_message(error: Exception) -> str:
    """Return an error that nothing caught as one line; with STITCH_TRACEBACK set, the traceback is printed too."""
    if os.environ.get("STITCH_TRACEBACK"):
        traceback.print_exception(error)
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(last.filename).name} line {last.lineno}"
    return f"unexpected {type(error).__name__} in {place}: {error}; a fault of stitch: STITCH_TRACEBACK=1 shows where"
