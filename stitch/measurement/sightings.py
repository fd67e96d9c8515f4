"""Labelled points of all views in arrays of one shape: S slots a view, empty where a target was not seen."""

from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array, Indices, Mask
from stitch.measurement.session import Session
from stitch.units import METRES

# Where neither a row nor scanner.noise says how well the sensor sees: what a good one does, in metres. The factor
# on the noise is estimated from the data anyway.
_USUAL_SIGMA_M = 1e-5
# A probe's own targets lie some 20 cm apart: that is how well it knows its direction, unless it says so itself.
_PROBE_LEVER_M = 0.2


@dataclass(frozen=True)
class Sightings:
    """What V views show of K targets, sensor frame; lengths in length_unit, angles in rad."""

    targets: tuple[str, ...]  # K
    target: Indices  # (V, S) which target sits in a slot; −1 in an empty one
    points: Array  # (V, S, 3); zero in an empty slot
    sigma: Array  # (V, S) of a coordinate
    used: Mask  # (V, S): seen, and not an outlier
    rotation: Array | None = None  # (V, 3, 3) of a 6D probe, R_sensor_probe
    sigma_rotation: Array | None = None  # (V,)

    @property
    def view_counts(self) -> Indices:
        """(K,) number of views that use each target."""
        return np.asarray(np.bincount(self.target[self.used], minlength=len(self.targets)), np.int64)

    @property
    def with_outliers(self) -> "Sightings":
        """The same with the outliers back in."""
        return replace(self, used=self.target >= 0)

    def points_by_view(self) -> list[Array]:
        """Per view the points in use, (k, 3); none where it shows nothing."""
        return [points[used] for points, used in zip(self.points, self.used, strict=True)]

    def without(self, left_out: Indices) -> "Sightings":
        """The sightings less some views."""
        keep = np.setdiff1d(np.arange(len(self.points)), left_out)
        of_views = ("target", "points", "sigma", "used", "rotation", "sigma_rotation")
        known = {name: values for name in of_views if (values := getattr(self, name)) is not None}
        return replace(self, **{name: values[keep] for name, values in known.items()})


def sightings_of(session: Session) -> Sightings | None:
    """All labelled points of a session, its views in order; None without any."""
    seen = [view.sighting for view in session.views]
    names = sorted({name for s in seen if s is not None for name in s.targets})
    if not names:
        return None
    number = {name: k for k, name in enumerate(names)}
    V, S = len(seen), max(len(s.targets) for s in seen if s is not None)
    target, points, sigma = np.full((V, S), -1), np.zeros((V, S, 3)), np.ones((V, S))
    rotation, turn = np.tile(np.eye(3), (V, 1, 1)), np.full(V, np.nan)
    for v, s in enumerate(seen):
        if s is not None:
            k = len(s.targets)
            target[v, :k], points[v, :k], sigma[v, :k] = [number[name] for name in s.targets], s.points, s.sigma
            if s.rotation is not None:
                rotation[v], turn[v] = s.rotation, s.sigma_rotation
    metres = METRES[session.length_unit]
    usual = _USUAL_SIGMA_M / metres if session.scanner.noise is None else session.scanner.noise
    sigma = np.where(np.isnan(sigma), usual, sigma)
    found = Sightings(tuple(names), target, points, sigma, target >= 0)
    if not any(s is not None and s.rotation is not None for s in seen):
        return found
    turn = np.where(np.isnan(turn), sigma[:, 0] * metres / _PROBE_LEVER_M, turn)
    return replace(found, rotation=rotation, sigma_rotation=turn)
