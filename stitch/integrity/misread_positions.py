"""Positions whose columns were read in another way than they were written, undone."""

from collections.abc import Iterator, Mapping
from itertools import permutations, product

import numpy as np

from stitch.frames import Array

_AXES = "xyz"


def other_columns(position: Array) -> Iterator[tuple[str, Array]]:
    """Positions (V, 3) with their columns in other places, then one or two with the other sign, and what that undoes.

    All three with the other sign are a left-handed frame, of poses or of scans.
    """
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            named = ", ".join(_AXES[i] for i in np.argsort(order))
            yield f"the columns of the positions are {named}, not x, y, z", position[:, order]
    for signs in product((1.0, -1.0), repeat=3):
        wrong = [axis for axis, sign in zip(_AXES, signs, strict=True) if sign < 0]
        if len(wrong) in (1, 2):
            have = "has" if len(wrong) == 1 else "have"
            yield f"{' and '.join(wrong)} of the positions {have} the wrong sign", position * signs


def other_units(position: Array, units: Mapping[float, str]) -> Iterator[tuple[str, Array]]:
    """Positions (V, 3) of which one column is in another unit than the rest, and what that undoes.

    Args:
        units: factors by which lengths may be too large, and how that comes about.
    """
    for column, axis in enumerate(_AXES):
        for factor, words in units.items():
            right = np.array(position)
            right[:, column] /= factor
            yield f"{axis} of the positions alone is in {words}: convert this column", right
