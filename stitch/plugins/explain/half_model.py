"""The linear model restricted to some of the views: what a formula has to explain there."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from stitch.numerics.frames import Array, Indices
from stitch.numerics.least_squares import column_space
from stitch.numerics.reml import NOISE
from stitch.observations.linear_model import LinearModel
from stitch.plugins.explain.dictionary import Dictionary, Ingredient, scaled_values

# Of a number a view two views show one difference: in that all that differ are alike, but for their size.
_MIN_VIEWS = 2


class HalfModel:
    """Numbers (n,) of some views in units of their scatter, without what the model explains there."""

    def __init__(self, linear: LinearModel, terms: Dictionary, keep: Indices) -> None:
        """Restrict a linear model to the views to keep; all others move freely."""
        self._linear = linear
        self._terms = terms
        self._keep = keep
        # Where each view is a block of its own, the blocks and the numbers of those kept; of surfaces views share all.
        self._blocks = None if linear.observation.numbers_per_view is None else keep
        size = linear.mixed.z.shape[1]
        rows = (keep[:, None] * size + np.arange(size)).ravel()
        self._rows: slice | Indices = slice(None) if self._blocks is None else rows
        self._of_view = dict[tuple[str, int], Array]()

    @cached_property
    def _explained(self) -> Array:
        """(n, r) orthonormal."""
        linear = self._linear
        left_out = np.setdiff1d(np.arange(linear.measurement.views.count), self._keep)
        if self._blocks is None and len(left_out):
            return linear.explained_without(left_out)
        return column_space(linear.white_design[self._rows])

    @cached_property
    def z(self) -> Array:
        """(n,) what was seen; the last number stands for all that is the sensor's noise alone."""
        white = self._linear.white_z[self._rows]
        noise = self._noise[1] / self._linear.null.variances[NOISE]
        return np.append(white - self._explained @ (self._explained.T @ white), np.sqrt(noise))

    @property
    def _noise(self) -> Array:
        """(2,) numbers that are the sensor's noise alone, as many as these views have of all, and their square."""
        share = len(self._keep) / self._linear.measurement.views.count
        return share * np.array(self._linear.mixed.noise_only)

    @property
    def free(self) -> int:
        """Return how many of the numbers are free."""
        # What a view does not show has no variance.
        shown = np.einsum("cbii->bi", self._linear.mixed.components).ravel()[self._rows] > 0
        return int(shown.sum() + self._noise[0]) - int(self._explained.shape[1])

    def has_room(self, numbers: int = 1) -> bool:
        """True if these views can tell a sum of so many numbers from others, and leave numbers free beside it."""
        return len(self._keep) > _MIN_VIEWS and self.free > numbers

    @property
    def views(self) -> Indices:
        """Numbers of those kept."""
        return self._keep

    def residual_columns(self, response: Array) -> Array:
        """(n, k) whitened columns of a response (·, k), without what the model explains."""
        white = self._linear.whiten(self._linear.reduce(response), self._blocks)
        return np.pad(white - self._explained @ (self._explained.T @ white), ((0, 1), (0, 0)))

    def columns(self, ingredients: Sequence[Ingredient]) -> Array:
        """(n, k) of ingredients: from the response to each view's displacement alone, which is worked out once."""
        columns = np.empty((len(self.z), len(ingredients)))
        places = [(i.place, i.index) for i in ingredients]
        for place in dict.fromkeys(places):
            which = [k for k, other in enumerate(places) if other == place]
            values = np.stack([scaled_values(ingredients[k].quantity)[self._keep] for k in which], axis=1)
            columns[:, which] = self._view_by_view(ingredients[which[0]]) @ values
        return columns

    def _view_by_view(self, ingredient: Ingredient) -> Array:
        """(n, kept views) of a displacement in one view at a time."""
        place = ingredient.place, ingredient.index
        if place not in self._of_view:
            base = self._terms.base(ingredient).reshape(-1, self._terms.rows)
            alone = np.zeros((*base.shape, len(self._keep)))
            alone[self._keep, :, np.arange(len(self._keep))] = base[self._keep]
            self._of_view[place] = self.residual_columns(alone.reshape(-1, len(self._keep)))
        return self._of_view[place]


def sum_residual(ingredients: Sequence[Ingredient], half: HalfModel) -> Array:
    """Return what a sum leaves (n,), with the best sizes."""
    columns = half.columns(ingredients)
    return half.z - columns @ np.linalg.lstsq(columns, half.z, rcond=1e-9)[0]
