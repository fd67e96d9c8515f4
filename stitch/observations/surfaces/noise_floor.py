"""What the sensor's own noise would leave in the overlaps if every pose were perfect."""

import numpy as np

from stitch.measurement.capture import Capture
from stitch.observations.surfaces.overlaps import Overlaps


def noise_floor(capture: Capture, overlaps: Overlaps, stated: float | None = None) -> float:
    """Rms of (p − q)·n for perfect poses: √(σ_v² + σ_w²) over all correspondences.

    σ of each view is measured in its own scan, across local quadrics; where the scans are too small
    for that, `stated` (scanner.noise of the session) stands in. Noise cannot leave more than what was left
    once every view was free to move: where quadrics took a shape for noise, that is the floor.

    Args:
        overlaps: of the registered views.
    """
    sigma = np.array([scan.noise for scan in capture.scans])
    sigma = np.where(np.isfinite(sigma), sigma, np.nan if stated is None else stated)
    pairs = overlaps.gram.pairs[~overlaps.gram.labelled]
    count = overlaps.gram.count[~overlaps.gram.labelled]
    variance = sigma[pairs[:, 0]] ** 2 + sigma[pairs[:, 1]] ** 2
    measured = float(np.sqrt(np.average(variance, weights=np.maximum(count, 1))))
    spare = 1 - 6 * (len(sigma) - 1) / max(count.sum(), 1)
    return min(measured, overlaps.gram.rms / np.sqrt(spare)) if spare > 0 else measured
