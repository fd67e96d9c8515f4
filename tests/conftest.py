"""Fixtures: the measured data beside the project, and small synthetic cells."""

import os
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from data_synth.cell import Cell, Measured, measure
from data_synth.scanner import AreaScanner
from data_synth.shapes import blade
from stitch import frames
from stitch.capture import Capture, place
from stitch.scan import prepare_view
from stitch.threads import library_threads_off

# As inside a run: the tests call the stages directly.
library_threads_off()

SHARED = Path(os.environ.get("STITCH_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED.is_dir():
        pytest.skip(f"measured data are not at {SHARED}")
    return SHARED


@pytest.fixture(scope="session")
def reghec(shared_data):
    """Path of a session of the RegHEC scans by its name."""
    return lambda name: shared_data / "reghec" / name


@lru_cache(maxsize=1)
def blade_mesh():
    return blade.build()


def synthetic(
    seed: int, views: int = 12, mount: str = "eye_to_hand", pixels: int = 150, **cell
) -> tuple[Measured, Capture]:
    """A blade scanned in a cell of known truth."""
    measured = measure(blade_mesh(), Cell(mount=mount, scanner=AreaScanner(pixels, pixels), **cell), views, seed)
    scans = [prepare_view(f"v{i}", cloud) for i, cloud in enumerate(measured.clouds)]
    return measured, place("blade", scans, measured.T_base_flange, mount)


def disturbed(T: np.ndarray, seed: int, degrees: float = 5.0, shift: float = 30.0) -> np.ndarray:
    """A hand-eye off by the given angle and distance in a random direction."""
    direction = np.random.default_rng(seed).normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return T @ frames.exp(np.concatenate([direction[0] * np.radians(degrees), direction[1] * shift]))
