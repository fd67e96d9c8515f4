"""What a hand-eye's error does at the part."""

import numpy as np

from stitch.numerics import frames
from stitch.session.capture import Capture


def at_part(capture: Capture, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle of the part in the scanner frame, and the (3, 6) map from ξ to its displacement."""
    middle = np.mean([scan.points.mean(axis=0) for scan in capture.scans], axis=0)
    return middle, np.hstack([-frames.skew(middle), np.eye(3)])
