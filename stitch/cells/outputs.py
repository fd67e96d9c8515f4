"""What every cell's command reads and can hand out beside its result: a Rerun recording, a page, a session folder.

Recording and page come from whoever offers them under the entry points `stitch.cell_recordings` and
`stitch.cell_reports`, by the command's name.
"""

from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import typer

from stitch.errors import InputError
from stitch.system.whole_file import whole_file

JobFile = Annotated[Path, typer.Argument(metavar="JOB", help="Job file, TOML.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON alone on standard output.")]
RecordingOption = Annotated[
    Path | None, typer.Option("--recording", metavar="FILE", help="Write a Rerun recording, .rrd.")
]
ReportOption = Annotated[Path | None, typer.Option("--report", metavar="FILE", help="Write one page, .html.")]
SessionOption = Annotated[
    Path | None,
    typer.Option("--session", metavar="FOLDER", help="Write the readings as a session for `stitch run` and diagnose."),
]


def write_pictures(command: str, folder: Path, *results: Any) -> list[str]:
    """Write the pictures of a command's job and result (`results`) into its folder; returns the files' names.

    They come from whoever offers them under the entry point `stitch.cell_pictures`, by the command's name.
    """
    offered = entry_points(group="stitch.cell_pictures", name=command)
    return [name for writer in offered for name in writer.load()(*results, folder)]


def write_recording_and_page(command: str, recording: Path | None, report: Path | None, *results: Any) -> None:
    """Write recording and page of a command's job and result (`results`), each whole or not at all.

    Raises:
        InputError: nobody offers one for this command, or its folder does not exist.
    """
    for group, path in (("stitch.cell_recordings", recording), ("stitch.cell_reports", report)):
        if path is None:
            continue
        offered = entry_points(group=group, name=command)
        if not offered:
            raise InputError(f"{path}: no writer for `stitch {command}` is installed; install stitch anew")
        if not path.parent.is_dir():
            raise InputError(f"{path}: its folder does not exist; make it first")
        with whole_file(path) as scratch:
            for writer in offered:
                writer.load()(*results, scratch)
