"""What labelled points and probes of a session say: their fit, and the linear model of their rows."""

from dataclasses import dataclass

import numpy as np

from stitch.model.forward import corrected_capture
from stitch.model.model import Model
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.row_model import row_model
from stitch.observations.targets.rows import Drawing, Landmarks, TargetRows, initial_landmarks, target_rows
from stitch.session.measurement import Measurement
from stitch.system.values import Value


@dataclass(frozen=True, eq=False)
class TargetModelFit(Value):
    """Model, places of the targets and scatter of the poses; lengths in length_unit, angles in rad.

    Example:
        >>> run.targets is None  # of clouds without labelled points
        True
    """

    model: Model
    inflation: float  # factor on the covariance that views left out ask for, ≥ 1
    landmarks: Landmarks
    landmarks_covariance: Array  # (U, U)
    variances: Array  # (3,) of rotation scatter, translation scatter, factor on the sensor's noise
    rows: TargetRows  # at the solution
    heldout: Array  # (V, S) distances of targets predicted without their own views; NaN where none was seen
    history: tuple[float, ...]  # 3D rms per iteration

    @property
    def distances(self) -> Array:
        """(V, S) 3D distances of the targets from their places; NaN where none was seen."""
        return self.rows.distances(self.rows.residual)

    @property
    def rms(self) -> float:
        """Root mean square of `distances`, length_unit."""
        return rms_of(self.distances)

    @property
    def heldout_rms(self) -> float:
        """Root mean square of `heldout`, length_unit."""
        return rms_of(self.heldout)

    @property
    def noise_floor(self) -> float:
        """Rms 3D distance, length_unit, that the sensor's own noise would leave if every pose were perfect."""
        noise = self.rows.noise[: len(self.rows.lever), : self.rows.positions]
        return float(np.sqrt(3 * np.mean(noise[noise > 0])))

    @property
    def target_rms(self) -> Array:
        """(K,) rms distance of the views from every target; NaN for one that nobody sees."""
        s, distances = self.rows.sightings, self.distances
        seen = enumerate(s.view_counts)
        return np.array([rms_of(distances[s.used & (s.target == k)]) if n else np.nan for k, n in seen])

    @property
    def view_squares(self) -> Array:
        """(V,) mean square distance of the targets in every view; NaN where none was seen: no perfect view."""
        distances = self.distances
        seen = np.isfinite(distances).sum(axis=1)
        return np.where(seen > 0, np.nansum(distances**2, axis=1) / np.maximum(seen, 1), np.nan)

    @property
    def single_view_targets(self) -> tuple[str, ...]:
        """Targets that say nothing of the poses: fewer than two views show them, and no other run knows them."""
        s = self.rows.sightings
        few = [name for name, n in zip(s.targets, s.view_counts, strict=True) if n < 2]
        return tuple(name for name in few if name not in self.model.targets)

    @property
    def uninformative(self) -> bool:
        """True if no target says anything of the poses."""
        return len(self.single_view_targets) == len(self.rows.sightings.targets)

    @property
    def landmark_sigmas(self) -> Array:
        """(K, 3) standard deviations of the targets' places, length_unit."""
        K = len(self.landmarks.positions)
        return np.sqrt(np.maximum(np.diag(self.landmarks_covariance)[: 3 * K], 0)).reshape(K, 3)

    def __repr__(self) -> str:
        return f"TargetFit({len(self.landmarks.positions)} targets, rms {self.rms:.3g}, {self.model!r})"


def rms_of(distances: Array) -> float:
    """Return the root mean square of distances, NaN left out."""
    return float(np.sqrt(np.nanmean(distances**2)))


def target_model(measurement: Measurement, model: Model, drawing: Drawing | None) -> LinearModel:
    """Return the linear model of a session's labelled points, linearised about `model`.

    Args:
        measurement: with the sightings that count, others masked.
        drawing: nominal places of targets; None: none are known.
    """
    capture = corrected_capture(measurement, model)
    landmarks = initial_landmarks(capture, model.T_mount, drawing)
    return row_model(measurement, model, target_rows(capture, model.T_mount, landmarks))
