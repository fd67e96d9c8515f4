"""The labelled points of one session about a model, as a step of the fit takes them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, exp
from stitch.model.model import Model
from stitch.model.term import Term
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import TargetRows
from stitch.observations.targets.target_fit import rms_of


@dataclass(frozen=True)
class LinearisedTargetSession:
    """The labelled points of one session about its model; P parameters of effects, the same in all sessions."""

    model: Model
    landmarks: Landmarks
    rows: TargetRows
    columns: Array  # (B, m, P)

    @property
    def base(self) -> Array:
        """(B, m, a) columns of hand-eye and landmarks."""
        return np.concatenate([self.rows.hand_eye, self.rows.landmarks], axis=2)

    @property
    def unknowns(self) -> int:
        """Of the session alone."""
        return 6 + int(self.rows.landmarks.shape[2])

    def moved(self, x: Array, terms: tuple[Term, ...]) -> tuple[Model, Landmarks]:
        """Model and landmarks after a step x (a,) of its own unknowns, with the effects as they are then."""
        return Model(self.model.T_mount @ exp(x[:6]), terms), self.landmarks.updated(x[6:])


def rms_of_rows(rows: Sequence[TargetRows]) -> float:
    """3D distance of the targets from where they are, length_unit."""
    return rms_of(np.concatenate([own.distances(own.residual).ravel() for own in rows]))
