"""Which units lengths can have, by what robots reach and scanners see."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array

# Metres per unit in which people write poses.
POSE_UNITS = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "inch": 0.0254}
CLOUD_UNITS = {"mm": 1e-3, "m": 1.0}
# Of the flange from the base, metres: from a desktop arm to one on a rail; in units that few robots count in, an
# arm's own.
_REACH_M = {"mm": (0.08, 12.0), "m": (0.08, 12.0), "cm": (0.25, 2.5), "inch": (0.25, 2.5)}
# Longest side of a scan, metres, and its distance from the scanner.
_SIZE_M, _RANGE_M = (5e-3, 10.0), 12.0


def pose_units(position: Array) -> list[str]:
    """Units that positions (V, 3) can have, the usual first; mm if none is plausible."""
    reach = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    return [u for u, m in POSE_UNITS.items() if _REACH_M[u][0] <= reach * m <= _REACH_M[u][1]] or ["mm"]


def cloud_units(clouds: Sequence[Array]) -> list[str]:
    """Units that clouds (N, 3) can have, the usual first; mm if none is plausible."""
    size = float(np.median([np.ptp(np.percentile(c, (5, 95), axis=0), axis=0).max() for c in clouds]))
    away = float(np.median([np.median(np.linalg.norm(c, axis=1)) for c in clouds]))
    fits = [u for u, m in CLOUD_UNITS.items() if _SIZE_M[0] <= size * m <= _SIZE_M[1] and away * m <= _RANGE_M]
    return fits or ["mm"]


def size_words(clouds: Sequence[Array]) -> str:
    """How large the scans are, in the file's own numbers."""
    size = float(np.median([np.ptp(np.percentile(c, (5, 95), axis=0), axis=0).max() for c in clouds]))
    away = float(np.median([np.median(np.linalg.norm(c, axis=1)) for c in clouds]))
    return f"scans are {size:.3g} long and {away:.3g} away"
