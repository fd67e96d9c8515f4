"""How far something is off, in words: no more than is held, nothing that arms do anyway."""

import numpy as np
import pytest

from stitch.screening.problems import displacement_text


@pytest.mark.parametrize(
    ("best", "least", "said"),
    [
        ((1e-6, 5.002), (0.0, 4.981), "5 mm"),
        ((0.03, 3.25), (0.002, 1.2), "at least 1.2 mm and 2 mrad"),
        ((np.radians(109), 50.0), (np.radians(108.6), 17.0), "at least 17 mm and 109°"),
        ((np.radians(2), 5.0), (np.radians(2), 5.0), "5 mm and 2.0°"),
        ((1e-5, 0.02), (1e-6, 0.0006), ""),
    ],
)
def test_a_size_is_told_as_far_as_it_is_held(best, least, said):
    assert displacement_text(best, least, "mm") == said
