"""Fixtures: the measured data beside the project, and small synthetic cells."""

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from data_synth.scene import load_scene
from data_synth.simulate import Measured, part_mesh, simulate
from stitch import frames
from stitch.measurement.capture import Capture, place
from stitch.measurement.scan import prepare_view
from stitch.system.threads import library_threads_off

# Two test processes that each use all cores would fight for them.
if os.environ.get("PYTEST_XDIST_WORKER") and hasattr(os, "sched_setaffinity"):
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_cores[int(os.environ["PYTEST_XDIST_WORKER"][2:]) % len(_cores)]})

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


SCENE_OF_MOUNT = {"eye_to_hand": "blade", "eye_in_hand": "blade-table"}


@lru_cache(maxsize=1)
def blade_mesh():
    return part_mesh(load_scene("blade"))


def measured_blade(
    seed: int, views: int = 12, mount: str = "eye_to_hand", repeatability: tuple[float, float] = (20e-6, 0.02),
    small: float = 0.0, pixels: int = 150, hidden: dict[str, float] | None = None,
    spread: tuple[float, float] = (0.003, 1.0), noise: float | None = None, **plan,
) -> Measured:  # fmt: skip
    """A blade scanned in a cell of known truth, with a scanner that has noise and nothing else."""
    scene = load_scene(SCENE_OF_MOUNT[mount])
    scanner = replace(
        scene.scanner, columns=pixels, rows=pixels, field_error=0.0, mixed_pixels=0.0, dropout=0.0, quantisation=0.0,
        noise=scene.scanner.noise if noise is None else noise,
    )  # fmt: skip
    scene = replace(
        scene, repeatability=repeatability, small=small, mount_spread=spread, scanner=scanner,
        plan=replace(scene.plan, **plan),
    )  # fmt: skip
    return simulate(scene, hidden or {}, seed, views)


def synthetic(seed: int, **cell) -> tuple[Measured, Capture]:
    """`measured_blade` made ready for the stages."""
    measured = measured_blade(seed, **cell)
    scans = [prepare_view(f"v{i}", cloud.points) for i, cloud in enumerate(measured.clouds)]
    return measured, place("blade", scans, measured.T_base_flange, measured.scene.mount)


def disturbed(T: np.ndarray, seed: int, degrees: float = 5.0, shift: float = 30.0) -> np.ndarray:
    """A hand-eye off by the given angle and distance in a random direction."""
    direction = np.random.default_rng(seed).normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return T @ frames.exp(np.concatenate([direction[0] * np.radians(degrees), direction[1] * shift]))
