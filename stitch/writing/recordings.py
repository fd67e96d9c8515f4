"""Recordings of a run, made by the packages that offer one."""

from importlib.metadata import entry_points
from pathlib import Path

from stitch.runs.recorder import Recorder


def recordings(folder: Path) -> list[Recorder]:
    """What other packages record of a run into its folder, by the entry-point group `stitch.recorders`."""
    return [entry.load()(folder / "recording.rrd") for entry in entry_points(group="stitch.recorders")]
