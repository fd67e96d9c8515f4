"""`stitch check SESSION`: read everything, compute nothing, say what is there or what is wrong."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.options import Json


def check(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    deep: Annotated[
        bool, typer.Option("--deep", help="Also try out what people do wrong: pairing, conventions, units, views.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Read sessions completely and say what is wrong; computes nothing unless asked to look deeper.

    \b
    Examples:
      stitch check blade-17
      stitch check --deep blade-17 --json
    """
    # Loaded by who runs something: whoever asks for help has it at once.
    from stitch.cli.actions.checked_sessions import check_deeply, check_sessions

    if deep:
        check_deeply(sessions, as_json)
    else:
        check_sessions(sessions, as_json)
