"""Log parts of the cells' recordings: frames, arrows, labelled points and words, all static."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stitch.numerics.frames import Array

os.environ.setdefault("RERUN_ANALYTICS", "off")
import rerun as rr
import rerun.blueprint as rrb

from viz.rrd_file import RecordingFile, words

Colours = NDArray[np.uint8] | Sequence[tuple[int, int, int]]
Recording = rr.RecordingStream
GREY, BLUE, GREEN, RED = (150, 150, 150), (72, 120, 168), (80, 150, 80), (196, 60, 40)


@contextmanager
def stage(path: Path, system: str, told: str) -> Iterator[rr.RecordingStream]:
    """A recording that opens on the scene `world` with the words beside it; written when the block has ended well."""
    scene = rrb.Spatial3DView(origin="world", name=system)
    side = rrb.TextDocumentView(origin="words", name="What was found")
    layout = rrb.Blueprint(rrb.Horizontal(scene, side, column_shares=[3, 1]), collapse_panels=True)
    file = RecordingFile(f"stitch_{system.replace(' ', '_')}", path, default=layout)
    recording = file.stream
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("words", words(told), static=True)
    yield recording
    file.write()


def frame(recording: rr.RecordingStream, name: str, T: Array, size: float) -> None:
    """Axes of a frame (4, 4), x red, y green, z blue, `size` long, with the name at their origin."""
    colours = [(200, 50, 40), (60, 160, 60), (50, 90, 200)]
    origins, axes = np.tile(T[:3, 3], (3, 1)), T[:3, :3].T * size
    recording.log(place(name), rr.Arrows3D(origins=origins, vectors=axes, colors=colours), static=True)
    mark = rr.Points3D([T[:3, 3]], labels=[name.rsplit("/", 1)[-1]], radii=size / 30, colors=[GREY], show_labels=True)
    recording.log(f"{place(name)}/name", mark, static=True)


def points(
    recording: rr.RecordingStream,
    name: str,
    places: Array,
    colours: Colours,
    radius: float,
    labels: Sequence[str] | None = None,
) -> None:
    """Points (N, 3), one colour each or one for all."""
    shown = None if labels is None else list(labels)
    cloud = rr.Points3D(np.float32(places), colors=colours, radii=radius, labels=shown, show_labels=labels is not None)
    recording.log(place(name), cloud, static=True)


def arrows(
    recording: rr.RecordingStream,
    name: str,
    origins: Array,
    vectors: Array,
    colour: tuple[int, int, int],
    radius: float,
) -> None:
    """Arrows from origins (N, 3) along vectors (N, 3)."""
    found = rr.Arrows3D(origins=np.float32(origins), vectors=np.float32(vectors), colors=[colour], radii=radius)
    recording.log(place(name), found, static=True)


def line(recording: rr.RecordingStream, name: str, places: Array, colour: tuple[int, int, int], radius: float) -> None:
    """A line through places (N, 3)."""
    strip = rr.LineStrips3D([np.float32(places)], colors=[colour], radii=radius)
    recording.log(place(name), strip, static=True)


def place(name: str) -> str:
    """The entity of a name, in which people may have written anything."""
    return "/".join(["world", *(rr.escape_entity_path_part(part) for part in name.split("/"))])
