"""A colour bar as a native picture of a recording."""

import numpy as np
import rerun as rr
from matplotlib import colormaps

from viz.colours import UNSEEN

_LENGTH, _HEIGHT = 256, 14
# All of it with its words, which are as large in any window.
WIDE, HIGH = (-28.0, _LENGTH + 44.0), (-4.0, _HEIGHT + 54.0)


def log_colour_bar(recording: rr.RecordingStream, path: str, name: str, ticks: list[str], grey: str) -> None:
    """The colours of a map from left to right, with labels at equal distances below, and what grey means below them."""
    row = np.asarray(colormaps[name](np.linspace(0, 1, _LENGTH))[:, :3] * 255, np.uint8)
    recording.log(f"{path}/colours", rr.Image(np.tile(row, (_HEIGHT, 1, 1))), static=True)
    places = np.column_stack([np.linspace(0, _LENGTH, len(ticks)), np.full(len(ticks), _HEIGHT + 6.0)])
    marks = rr.Points2D(places, labels=ticks, radii=0.4, colors=[(128, 128, 128)], show_labels=True)
    recording.log(f"{path}/ticks", marks, static=True)
    below = [(_LENGTH / 2, _HEIGHT + 27.0)]
    unseen = rr.Points2D(below, labels=[f"grey: {grey}"], radii=0.4, colors=[UNSEEN], show_labels=True)
    recording.log(f"{path}/grey", unseen, static=True)
