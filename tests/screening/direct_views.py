"""Views whose poses are observed directly, about one common unknown one: everything has a closed form."""

from dataclasses import replace

import numpy as np

from stitch.observations.surfaces.hand_eye_fit import ReducedPoses
from stitch.screening.view_model import ViewModel


def direct_views(z, reduction=None, errors=None):
    """The model of numbers z (6V,), each a coordinate of one view's twist, or what a reduction makes of all of them."""
    R = np.eye(len(z)) if reduction is None else reduction
    common, turns = np.tile(np.eye(6), (len(z) // 6, 1)), np.arange(len(z)) % 6 < 3
    rotation, translation = (R[:, half] @ R[:, half].T for half in (turns, ~turns))
    reduced = ReducedPoses(R, R.T, z, R @ common, np.array([rotation, translation, 1e-8 * np.eye(len(R))]))
    return ViewModel(reduced, common.reshape(-1, 6, 6), np.zeros(3), 1.0, errors=errors)


def with_z(model, z):
    """The same model of other numbers."""
    return replace(model, reduced=replace(model.reduced, z=np.asarray(z)))
