"""The frame of a part by its datum: six numbers of its features that are nominal there, as 3-2-1 and RPS choose them.

A motion ξ (6,) of the part changes its Q numbers by M·ξ, to first order. Where the six rows M_d of the datum hold
every motion, one motion makes its six numbers nominal; measured, moved and measured again, they are so exactly. What
moves the part as a whole moves no number then, and what errs at the datum moves all (`free_of_datum`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.metrology.budget import answers_to_motion, datum_rows, fit_features, number_table
from stitch.plugins.metrology.feature_file import FeatureList
from stitch.plugins.metrology.place_errors import PlaceErrors

# An error at the datum that comes out so many times larger elsewhere on it is one of a direction that is open.
_OPEN = 1e3
_ROUNDS, _STILL = 6, 1e-9


def into_datum(places: PlaceErrors, wanted: FeatureList) -> tuple[PlaceErrors, Array | None]:
    """Return the places of a run in the frame of a datum, and the motion (4, 4) from the reference frame to there.

    Without a datum the places are as they were, and the motion is None.

    Raises:
        NoResultError: a feature of the datum is not seen, or its six numbers leave a motion open.
    """
    if not wanted.datum:
        return places, None
    names = {number.rpartition(".")[0] for number in wanted.datum}
    features = [feature for feature in wanted.features if feature.name in names]
    T = np.eye(4)
    for _ in range(_ROUNDS):
        fits, not_measured = fit_features(places.points, features)
        for missing in not_measured.values():
            raise NoResultError(f"datum: {missing}")
        quantities, values, nominal, slopes = number_table(features, fits)
        rows = datum_rows(quantities, wanted.datum)
        size = float(np.ptp(np.vstack([fit.at.points for fit in fits]), axis=0).max())
        motions = answers_to_motion(slopes, fits, places.centre)[rows]
        _require_all_directions(motions, [quantities[q][1] for q in rows], size)
        step = np.asarray(np.linalg.solve(motions, (nominal - values)[rows]), np.float64)
        moved = frames.moved_about(places.centre, step, np.eye(4))
        places = _moved_places(places, moved)
        T = moved @ T
        if np.abs(step * np.repeat([size, 1.0], 3)).max() < _STILL * size:
            break
    return places, T


def _require_all_directions(motions: Array, quantities: Sequence[str], size: float) -> None:
    """Refuse a datum that leaves a motion of the part open, turns and slopes counted at its size."""
    as_lengths = np.array([size if quantity.startswith("slope") else 1.0 for quantity in quantities])
    if np.linalg.cond(as_lengths[:, None] * motions / np.repeat([size, 1.0], 3)) > _OPEN:
        raise NoResultError(
            "datum: its six numbers leave a motion of the part open; to fix: name six that hold it in every direction, "
            "as three heights of a face, two of a side, one of an end"
        )


def _moved_places(places: PlaceErrors, T: Array) -> PlaceErrors:
    """Return the places after a motion T (4, 4) of the part with all that errs."""

    def turned(twists: Array) -> Array:
        halves = twists.reshape(-1, 3, twists.shape[1])
        return np.einsum("ij,hjm->him", T[:3, :3], halves).reshape(twists.shape)

    return replace(
        places,
        poses=T @ places.poses,
        centre=frames.transform(T, places.centre[None])[0],
        sources=tuple(replace(source, views=turned(source.views)) for source in places.sources),
    )
