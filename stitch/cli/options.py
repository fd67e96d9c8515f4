"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

EffectsFile = Annotated[
    Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own; it is run.")
]
Trust = Annotated[bool, typer.Option("--trust", help="Run the Python file of effects that the model names.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the run of another session.")]
Json = Annotated[bool, typer.Option("--json", help="Print the JSON result alone on standard output.")]
