"""Who watches a command work: the terminal, a program that reads lines, and the recording."""

from pathlib import Path

from stitch.cli.terminal.progress import Progress
from stitch.cli.terminal.progress_lines import ProgressLines, progress_lines_requested
from stitch.runs.recorder import Recorder
from stitch.runs.tee import RecorderGroup
from stitch.writing.recordings import recordings


def recorder_for(folder: Path, recording: bool) -> Recorder:
    """Progress on a terminal or as lines, and the recording."""
    lines: list[Recorder] = [ProgressLines()] if progress_lines_requested() else []
    return RecorderGroup([Progress(), *lines, *(recordings(folder) if recording else [])])
