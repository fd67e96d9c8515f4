"""What tests and benchmarks start from is as far off as it says."""

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import disturbed
from stitch.numerics import frames


def test_disturbed_is_as_far_off_as_it_says():
    off = frames.log(frames.inverse(np.eye(4)) @ disturbed(np.eye(4), 3))
    assert np.degrees(np.linalg.norm(off[:3])) == pytest.approx(5)
