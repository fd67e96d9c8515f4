"""The map of a scanner's smooth error against the error that was put in, less what no overlap shows."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, simulated
from stitch.api import pipeline
from stitch.diagnosis.diagnose import linear_model_of
from stitch.observations.surfaces.field_error import FieldError, FieldMap, field_error, robust_pass_share

# mm along the ray at places (N,) of the field, −1 … 1 both ways.
Law = Callable[[np.ndarray, np.ndarray], np.ndarray]
VIEWS, REACH = 12, 0.38  # REACH: x/z and y/z at the edges of the field


def tilted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A focus that is tilted across the corners, clearly more than the scanner's noise hides."""
    return 0.08 * a * b


def wavy(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """No polynomial of the model: a whole wave along either way."""
    return 0.06 * np.cos(np.pi * a) * np.cos(np.pi * b)


def nothing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.zeros_like(a)


@cache
def along(law: Law) -> Callable[[np.ndarray], np.ndarray]:
    """What moves points so, the same function for the same law."""
    return lambda points: moved(points, law)


def moved(points: np.ndarray, law: Law) -> np.ndarray:
    """Points (N, 3) in the scanner frame that err by a law along their rays."""
    a, b = (points[:, :2] / points[:, 2:] / REACH).T
    return points + law(a, b)[:, None] * points / np.linalg.norm(points, axis=1)[:, None]


def askew(points: np.ndarray) -> np.ndarray:
    """The scanner's x and y by 3 mrad: across the rays, hardly along them."""
    return points + points @ np.array([[0.0, 0.003, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]).T


@cache
def found(change: Callable[[np.ndarray], np.ndarray], backwards: bool = False) -> tuple[FieldError, float]:
    """What is found where the points of every view change, and the share that robust weights keep.

    Args:
        backwards: of a scanner whose frame is turned about its y, so that it looks against its z.
    """
    cell = simulated(clean("spheres", rays=65), {}, 5, views=VIEWS)
    cell = replace(cell, clouds=[replace(c, points=change(c.points)) for c in cell.clouds])
    session = session_of(cell)
    if backwards:
        turn = np.diag([-1.0, 1.0, -1.0, 1.0])
        clouds = [replace(v.cloud, points=v.cloud.points @ turn[:3, :3]) for v in session.views]
        views = tuple(replace(v, cloud=c) for v, c in zip(session.views, clouds, strict=True))
        tool = session.scanner
        tool = replace(tool, T_mount=tool.T_mount @ turn, optical_axis=-tool.optical_axis)
        session = replace(session, views=views, scanner=tool)
    linear = linear_model_of(pipeline.run(session))
    freed = linear.observation.unconstrained
    return field_error(linear.measurement, linear.model, freed, 0.01), robust_pass_share(freed.overlaps)


def less_unseen(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (N,) less a constant, slopes and a bowl over the field, which motions of the views do as well."""
    A = np.stack([np.ones_like(x), x, y, x**2 + y**2], axis=1)
    return values - A @ np.linalg.lstsq(A, values, rcond=None)[0]


def both(drawn: FieldMap, law: Law) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Map, truth and sigma (N,) where the map is drawn, the first two less what is not seen."""
    seen = np.isfinite(drawn.error)
    x, y = (at[seen] for at in np.meshgrid(drawn.x, drawn.y))
    error, truth = (less_unseen(v, x, y) for v in (drawn.error[seen], law(x / REACH, y / REACH)))
    return error, truth, drawn.sigma[seen]


@pytest.mark.parametrize("law", [pytest.param(tilted, marks=pytest.mark.slow), wavy])
def test_the_map_is_the_error_that_was_put_in(law: Law):
    """Sign, place and size; as far off as its sigma says."""
    shown, _ = found(along(law))
    error, truth, sigma = both(shown.map, law)
    assert np.corrcoef(error, truth)[0, 1] > 0.9
    assert 0.75 < error @ truth / (truth @ truth) < 1.25
    assert np.sqrt(np.mean((error - truth) ** 2)) < 2.5 * shown.map.uncertainty
    assert np.all(sigma > 0) and shown.map.uncertainty < 0.5 * shown.map.rms


@pytest.mark.slow
def test_a_scanner_that_looks_against_its_z_has_the_same_map_turned():
    ahead, back = (found(along(tilted), backwards)[0].map for backwards in (False, True))
    np.testing.assert_allclose(back.x, -ahead.x[::-1], atol=1e-9)
    seen = np.isfinite(ahead.error) & np.isfinite(back.error[:, ::-1])
    np.testing.assert_allclose(back.error[:, ::-1][seen], ahead.error[seen], atol=0.1 * ahead.rms)


@pytest.mark.slow
@pytest.mark.parametrize("change", [along(nothing), askew])
def test_no_map_of_what_is_no_error_along_the_ray(change):
    assert found(change)[0].map is None


@pytest.mark.slow
def test_robust_weights_let_five_sixths_of_a_small_error_through():
    """Of normal residuals Σ ψ′/Σ ψ/e of the biweight at 4.685 σ: 0.758/0.915."""
    assert found(along(nothing))[1] == pytest.approx(0.828, abs=0.02)
