"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from stitch.errors import InputError

EffectsFile = Annotated[
    Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own; it is run.")
]
Trust = Annotated[bool, typer.Option("--trust", help="Run the Python file of effects that the model names.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the run of another session.")]
Tolerance = Annotated[
    float | None,
    typer.Option("--tolerance", help="On the page: within which the views have to agree on the part, length_unit."),
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")]
Json = Annotated[bool, typer.Option("--json", help="Print the JSON result alone on standard output.")]


def require_tolerance(tolerance: float | None) -> None:
    """Refuse what is no length.

    Raises:
        InputError: zero, negative or not finite.
    """
    if tolerance is not None and not 0 < tolerance < float("inf"):
        raise InputError(f"--tolerance {tolerance:g}: to fix: give a length above zero, in the session's length_unit")
