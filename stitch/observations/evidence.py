"""What the diagnosis asks of a session's evidence, whether it comes from overlaps or from labelled points.

`response` (·, P) is how the views answer to parameters in the evidence's own coordinates (twists of the views,
or rows of labelled points); `columns` (n, P) is the same in the channel, the numbers whose scatter is known.
"""

from collections.abc import Sequence
from typing import Protocol

from stitch.frames import Array, Indices
from stitch.measurement.measurement import Measurement, Term
from stitch.observations.surfaces.point_effects import PointGram
from stitch.statistics.folds import JointEnd
from stitch.statistics.satterthwaite import Satterthwaite
from stitch.statistics.variance_components import Evidence, VarianceFit


class Trial(Protocol):
    """A model with some columns, in the linear approximation."""

    def solve(self, left_out: Indices | None) -> Array:
        """Coefficients by least squares, without some views."""
        ...

    def squares(self, coefficients: Array) -> Array:
        """(units,) sums of squares of what is left, in the terms of residual_rms."""
        ...

    def scatter(self, left_out: Indices, coefficients: Array) -> float:
        """Sum of squares by which left-out views lie off, in units of their scatter."""
        ...

    def influential_views(self, coefficients: Array) -> Indices:
        """Views of which one alone could carry the coefficients."""
        ...


class ViewEvidence(Protocol):
    """One session under its model: what was seen beside hand-eye, landmarks and effects in use."""

    @property
    def measurement(self) -> Measurement: ...
    @property
    def terms(self) -> tuple[Term, ...]: ...
    @property
    def T_mount(self) -> Array: ...
    @property
    def model(self) -> Array:
        """(·, a) response of hand-eye, landmarks and effects in use."""
        ...

    @property
    def evidence(self) -> Evidence: ...
    @property
    def null(self) -> VarianceFit: ...
    @property
    def white_model(self) -> Array:
        """(n, a) of `model` in units of the null's scatter."""
        ...

    @property
    def white_z(self) -> Array:
        """(n,) what was seen, in the same units, without what the model explains."""
        ...

    @property
    def degrees_of_freedom(self) -> Satterthwaite:
        """How well the null's scatter is known."""
        ...

    def columns(self, candidates: Sequence[Term]) -> tuple[list[Array], PointGram | None, list[slice | None]]:
        """Responses (·, P) of candidates, the sums of point effects, and where each candidate's are in them."""
        ...

    def in_channel(self, response: Array) -> Array:
        """(n, P) columns of a response."""
        ...

    def in_blocks(self, columns: Array) -> Array:
        """(B, m, P) columns as the variance components take them."""
        ...

    def whiten_raw(self, columns: Array) -> Array:
        """(n, P) columns in units of the null's scatter."""
        ...

    def whiten_channel(self, columns: Array) -> Array:
        """(n, P) columns in units of the null's scatter, what the model explains projected out."""
        ...

    def whiten(self, response: Array) -> Array:
        """The same from a response."""
        ...

    def conditioned_on(self, columns: Array) -> "ViewEvidence":
        """The evidence with further free columns (n, p) in its model."""
        ...

    def trial(self, response: Array, points: PointGram | None = None, precision: Array | None = None) -> Trial:
        """A model with the columns of a response (·, k); `points` belong to its last ones; (k,) prior around zero."""
        ...

    def touched(self, views: Indices) -> Array:
        """(units,) bool: which squares of a trial some views have a part in."""
        ...

    def folds(self) -> list[Indices]:
        """Groups of views to leave out."""
        ...

    def ends(self) -> list[JointEnd]:
        """Ends of joints' ranges that may be left out; none where a square of a trial is no view's own."""
        ...

    def at_part(self, numbers: Array) -> Array:
        """(V, 3) what numbers (n,) of the channel displace at the part, reference frame, without a common motion."""
        ...

    def displaced(self) -> Array:
        """(V, 3) how far every view sits from where the model puts it."""
        ...
