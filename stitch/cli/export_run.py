"""`stitch export RUN`: what a run found in the words of other programs."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stitch.cli.streams import results
from stitch.errors import InputError
from stitch.export.hand_eye import hand_eye_of
from stitch.export.hand_eye_formats import FORMATS, ros_launch
from stitch.system.whole_file import whole


def export_run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    to: Annotated[
        str | None, typer.Option("--to", metavar="FORMAT", help=f"The hand-eye as {', '.join(FORMATS)}.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="File to write; default standard output.")
    ] = None,
    parent: Annotated[
        str | None, typer.Option("--parent", help="Name of the frame that carries the scanner: flange, base_link …")
    ] = None,
    child: Annotated[str, typer.Option("--child", help="Name of the scanner's frame.")] = "scanner",
) -> None:
    """Write the hand-eye of a run in the form of another program, with its uncertainty and its frames."""
    if output is not None and (output.exists() or output.is_symlink()):
        raise InputError(f"{output}: exists already; name another file, or remove it")
    if to not in FORMATS:
        raise InputError(f"--to {to}: to fix: one of {', '.join(FORMATS)}")
    eye = hand_eye_of(run, parent, child)
    # ROS 1 knows launch files in XML only.
    old = to == "ros" and output is not None and output.suffix in (".launch", ".xml")
    text = ros_launch(eye) if old else FORMATS[to](eye)
    if output is None:
        results().write(text)
        return
    with whole(output) as file:
        file.write_text(text, encoding="utf-8")
    print(f"{eye.name} as {to} to {output}", file=sys.stderr)
