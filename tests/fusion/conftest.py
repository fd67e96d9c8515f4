"""A small cell whose poses are off by what a robot does."""

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade
from stitch.numerics import frames


@pytest.fixture(scope="package")
def cell():
    """A capture of five views and their model's poses, each off by 0.2 mrad and 0.1 mm a component."""
    measured, capture = captured_blade(3, views=5, pixels=80, repeatability=(0.0, 0.0))
    off = np.random.default_rng(0).normal(size=(5, 6)) * np.repeat([2e-4, 0.1], 3)
    return capture, frames.exp(off) @ measured.T_reference_scanner, measured.T_reference_scanner
