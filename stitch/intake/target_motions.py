"""How the scanner moved between views, from targets that both show: a flat board tells as much as any."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.integrity.relative_scans import RelativeScans
from stitch.measurement.labelled_points import Sighting

# Views that are compared: each with the next few that show the same targets.
_NEXT = 4
_FEWEST = 3
# Targets closer to one line than this share of their extent do not show how the scanner turned.
_LINE = 0.05


def target_motions(sightings: Sequence[Sighting]) -> RelativeScans:
    """Motions (Arun, Huang & Blostein 1987) between views with three common targets or more that span a plane."""
    pairs, motions = list[tuple[int, int]](), list[Array]()
    showing = [v for v, s in enumerate(sightings) if len(s.targets) >= _FEWEST]
    for place, v in enumerate(showing):
        for w in showing[place + 1 : place + 1 + _NEXT]:
            T = _relative_motion(sightings[v], sightings[w])
            if T is not None:
                pairs.append((v, w))
                motions.append(T)
    return RelativeScans(tuple(pairs), np.array(motions).reshape(-1, 4, 4))


def _relative_motion(first: Sighting, second: Sighting) -> Array | None:
    """T (4, 4) that maps the second view's scanner frame into the first's."""
    common = [name for name in first.targets if name in second.targets]
    if len(common) < _FEWEST:
        return None
    a, b = (s.points[[s.targets.index(name) for name in common]] for s in (first, second))
    from_a, from_b = a - a.mean(axis=0), b - b.mean(axis=0)
    extent = np.linalg.svd(from_a, compute_uv=False)
    if extent[1] < _LINE * extent[0]:
        return None
    R = frames.nearest_rotation(from_a.T @ from_b)
    return frames.make(R, a.mean(axis=0) - R @ b.mean(axis=0))
