"""Which files of a folder are scans, and which of them are the scans of its campaign."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch.reading.clouds import CLOUD_SUFFIXES
from stitch.reading.depth_image import DEPTH_SUFFIXES, is_depth_image

# Text files are clouds or tables of poses: a scan has more lines than a campaign has views.
_EITHER = (".txt", ".csv", ".asc")
_CLOUD_LINES = 400


def clouds_among(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Files of the kind that most clouds have, and clouds of other kinds."""
    fitting = [f for f in files if f.suffix.lower() in CLOUD_SUFFIXES and _is_cloud(f)]
    if not fitting:
        return [], []
    kinds = Counter(f.suffix.lower() for f in fitting)
    order = list(CLOUD_SUFFIXES)
    best = max(kinds, key=lambda kind: (kinds[kind], -order.index(kind)))
    return [f for f in fitting if f.suffix.lower() == best], [f for f in fitting if f.suffix.lower() != best]


def _is_cloud(file: Path) -> bool:
    if file.suffix.lower() == ".npy":
        return _is_cloud_array(file) or is_depth_image(file)
    if file.suffix.lower() in DEPTH_SUFFIXES:
        return is_depth_image(file)
    if file.suffix.lower() not in _EITHER:
        return True
    with file.open("rb") as stream:
        return sum(1 for _, _ in zip(stream, range(_CLOUD_LINES), strict=False)) == _CLOUD_LINES


def _is_cloud_array(file: Path) -> bool:
    """An image of points, or more rows than a campaign has views; matrices (V, 4, 4) are poses."""
    try:
        shape = np.load(file, mmap_mode="r", allow_pickle=False).shape or (0,)
    except (ValueError, OSError):
        return False
    image = len(shape) == 3 and shape[1:] not in ((4, 4), (3, 4))
    return shape[-1] >= 3 and (image or (len(shape) == 2 and shape[0] >= _CLOUD_LINES))
