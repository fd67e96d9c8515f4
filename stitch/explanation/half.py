"""Some of the views, as one who knows nothing of the others sees them."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from stitch.diagnosis.validation.halves import explained_basis
from stitch.explanation.dictionary import Dictionary, Ingredient, scaled_values
from stitch.frames import Array, Indices
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.statistics.least_squares import column_space

# Of a number a view two views show one difference: in that all that differ are alike, but for their size.
_MIN_VIEWS = 2


class HalfModel:
    """Numbers (n,) of some views in units of their scatter, without what the model explains there."""

    def __init__(self, linear: LinearModel, terms: Dictionary, keep: Indices) -> None:
        """Of a linear model the views to keep; all others move freely."""
        self._linear, self._terms, self._keep = linear, terms, keep
        self._out = np.setdiff1d(np.arange(linear.measurement.views.count), keep)
        self._of_view = dict[tuple[str, int], Array]()

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal."""
        linear = self._linear
        if isinstance(linear.observation, SurfaceObservation):
            if not len(self._out):
                return column_space(linear.white_design)
            return explained_basis(linear, linear.observation, self._out)
        return column_space(linear.white_design[self._rows])

    @cached_property
    def _rows(self) -> Indices:
        """Of the kept views, in the channel of views that are blocks of their own."""
        rows = self._linear.mixed.z.shape[1]
        return np.asarray((self._keep[:, None] * rows + np.arange(rows)).ravel())

    @cached_property
    def z(self) -> Array:
        """(n,) what was seen."""
        surfaces = isinstance(self._linear.observation, SurfaceObservation)
        white = self._linear.white_z if surfaces else self._linear.white_z[self._rows]
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    @property
    def free(self) -> int:
        """How many of the numbers are free."""
        return len(self.z) - int(self._explained.shape[1])

    def has_room(self, numbers: int = 1) -> bool:
        """True if these views can tell a sum of so many numbers from others, and leave numbers free beside it."""
        return len(self._keep) > _MIN_VIEWS and self.free > numbers

    @property
    def views(self) -> Indices:
        """Numbers of those kept."""
        return self._keep

    def residual_columns(self, response: Array) -> Array:
        """(n, k) whitened columns of a response (·, k), without what the model explains."""
        surfaces = isinstance(self._linear.observation, SurfaceObservation)
        white = self._linear.whiten(self._linear.reduce(response), None if surfaces else self._keep)
        return np.asarray(white - self._explained @ (self._explained.T @ white))

    def columns(self, ingredients: Sequence[Ingredient]) -> Array:
        """(n, k) of ingredients: from the response to each view's displacement alone, which is worked out once."""
        out = np.empty((len(self.z), len(ingredients)))
        at = [(i.place, i.index) for i in ingredients]
        for own in dict.fromkeys(at):
            which = [k for k, other in enumerate(at) if other == own]
            values = np.stack([scaled_values(ingredients[k].quantity)[self._keep] for k in which], axis=1)
            out[:, which] = self._view_by_view(ingredients[which[0]]) @ values
        return out

    def _view_by_view(self, ingredient: Ingredient) -> Array:
        """(n, kept views) of a displacement in one view at a time."""
        own = ingredient.place, ingredient.index
        if own not in self._of_view:
            base = self._terms.base(ingredient).reshape(-1, self._terms.rows)
            alone = np.zeros((*base.shape, len(self._keep)))
            alone[self._keep, :, np.arange(len(self._keep))] = base[self._keep]
            self._of_view[own] = self.residual_columns(alone.reshape(-1, len(self._keep)))
        return self._of_view[own]
