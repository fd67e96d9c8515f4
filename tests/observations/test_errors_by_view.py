"""Smooth errors that every view has for itself, beside those that all views share."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import check_grad

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import Measured, clean, simulated
from stitch.api import pipeline
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.effects.contract import EFFECTS
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import field_error
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import gram
from stitch.observations.surfaces.scanner_errors import (
    COARSE,
    PER_VIEW,
    SmoothErrorLikelihood,
    part_of_view,
    sum_smooth_errors,
    view_error_likelihood,
)

VIEWS = 12
# What moves the points (N, 3) of view v, scanner frame, mm.
Law = Callable[[np.ndarray, int, Measured], np.ndarray]


def swings(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The arm swings once by 0.15 mm, in another direction in every view, while the scanner reads across its field."""
    way = np.random.default_rng(v).standard_normal(3)
    field = points[:, 0] / points[:, 2]
    return 0.15 * np.sin(np.pi * field / np.abs(field).max())[:, None] * way / np.linalg.norm(way)


def bends(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """0.2 mm at the part's ends over the session."""
    T = cell.T_reference_scanner[v]
    x = (points @ T[:3, :3].T + T[:3, 3])[:, 0] / (0.5 * np.ptp(cell.mesh.vertices[:, 0]))
    return 0.2 * v / (VIEWS - 1) * (x**2)[:, None] * T[2, :3]


def alike(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The same 0.06 mm along the ray in every view, by a law finer than that of a view of its own."""
    a, b = (points[:, i] / points[:, 2] / np.abs(points[:, i] / points[:, 2]).max() for i in (0, 1))
    return 0.06 * (np.cos(np.pi * a) * np.cos(np.pi * b))[:, None] * points / np.linalg.norm(points, axis=1)[:, None]


def linear_of(law: Law | None, seed: int = 5) -> LinearModel:
    """The model of twelve views of a plate with spheres, whose points err by a law."""
    cell = simulated(clean("spheres", rays=55), {}, seed, views=VIEWS)
    if law is not None:
        clouds = [replace(c, points=c.points + law(c.points, v, cell)) for v, c in enumerate(cell.clouds)]
        cell = replace(cell, clouds=clouds)
    return linear_model_of(pipeline.run(session_of(cell)))


@pytest.fixture(scope="module")
def sound() -> LinearModel:
    return linear_of(None)


def test_what_either_view_does_adds_up(sound: LinearModel):
    """Sums for either view of a pair its own, added up, are those for both together."""
    apart, _ = sum_smooth_errors(sound.measurement, sound.observation.unconstrained, per_view=True)
    together, _ = sum_smooth_errors(sound.measurement, sound.observation.unconstrained)
    coarse = apart.merge_sides(COARSE).select(slice(COARSE + 1))
    for name in ("vector", "residual", "square"):
        wanted = getattr(together, name)
        np.testing.assert_allclose(getattr(coarse, name), wanted, atol=1e-9 * np.abs(wanted).max())


def test_the_likelihood_has_the_slopes_that_it_says():
    rng = np.random.default_rng(0)
    told = tuple(rng.standard_normal((9, k)) for k in (3, 1, 6))
    shown = SmoothErrorLikelihood(rng.standard_normal(9), told, rng.uniform(0.5, 2.0, 9))
    value, slope = (lambda x, i=i: shown._deviance(x)[i] for i in (0, 1))
    for point in rng.uniform(-2, 1, (5, 3)):
        assert check_grad(value, slope, point) < 1e-5 * max(1.0, np.linalg.norm(slope(point)))


def test_sizes_are_those_with_which_errors_were_drawn():
    """Errors of three causes drawn by their variances: log shares within three of their standard errors on average."""
    rng = np.random.default_rng(1)
    told = tuple(rng.standard_normal((150, k)) for k in (20, 20, 90))
    true, found = np.array([1.0, 0.4, 0.7]), []
    for _ in range(40):
        errors = sum(s * t @ rng.standard_normal(t.shape[1]) for s, t in zip(true, told, strict=True))
        seen = errors + 0.5 * rng.standard_normal(150)
        found.append(np.log(SmoothErrorLikelihood(seen, told, np.full(150, 0.25)).ml_shares([10.0] * 3)[0] / true))
    # Likelihood underestimates variances of n numbers by about 1/n of themselves.
    mean, error = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(mean) < 3 * error + 1 / np.array([20, 20, 90]))


def test_parts_of_a_session_follow_each_other():
    assert list(part_of_view(4)) == [0, 1, 2, 3]
    many = part_of_view(100)
    assert many[0] == 0 and many[-1] == 29 and set(np.diff(many)) == {0, 1}


def test_a_sound_scanner_errs_in_no_view_of_its_own(sound: LinearModel):
    found = field_error(sound.measurement, sound.model, sound.observation.unconstrained, 0.01)
    assert not found.unusual


@pytest.mark.slow
@pytest.mark.parametrize(("law", "with_time"), [(swings, False), (bends, True)])
def test_every_view_by_itself(law: Law, with_time: bool):
    """Neither is laid on the scanner's field; what grows with the session is told from what does not."""
    linear = linear_of(law)
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, 0.01)
    assert found.by_view and found.over_noise
    assert found.with_time == with_time
    # Poses follow what they can: less is left, and never more than was put in.
    assert found.rms_by_view < 0.2


@pytest.mark.slow
def test_the_same_in_every_view_is_no_view_of_its_own():
    linear = linear_of(alike)
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, 0.01)
    assert found.rms > 0 and not found.by_view


def test_estimates_are_those_of_weighted_least_squares():
    """The likeliest errors of a cause: ridge regression in closed form."""
    rng = np.random.default_rng(2)
    told = (rng.standard_normal((12, 4)), rng.standard_normal((12, 2)))
    shown = SmoothErrorLikelihood(rng.standard_normal(12), told, rng.uniform(0.5, 2.0, 12))
    shares = np.array([0.7, 1.3])
    A = np.hstack([s * t for s, t in zip(shares, told, strict=True)])
    W = np.diag(1 / shown.scatter)
    wanted = np.linalg.solve(A.T @ W @ A + np.eye(6), A.T @ W @ shown.data)
    np.testing.assert_allclose(shown.estimate(0, shares), wanted[:4])
    np.testing.assert_allclose(shown.estimate(1, shares), wanted[4:])


@pytest.mark.parametrize(
    ("short", "name"),
    [
        (0.003, "range_scale"),
        *(
            pytest.param(short, name, marks=pytest.mark.slow)
            for short, name in product((0.0, 0.003), (None, "range_scale", "scanner_thermal_scale", "field_curvature"))
            if (short, name) not in ((0.0, None), (0.003, "range_scale"))  # a sound scanner; above
        ),
    ],
)
def test_where_the_iteration_ended_makes_no_error_of_the_scanner(sound: LinearModel, name: str | None, short: float):
    """Views that stand some micrometres off the place where they agree best show nothing, beside whatever may be there:
    poses follow most of what a scale does, so that a small step they still owe looks like hundreds of nats."""
    freed, rng = sound.observation.unconstrained, np.random.default_rng(0)
    g = freed.overlaps.gram
    twists = short * rng.standard_normal((g.views, 6)) / g.displacement_factors

    def moved(m: Match) -> Match:
        B = np.concatenate([np.cross(m.middle - g.centre, m.normal), m.normal], axis=1)
        return replace(m, residual=m.residual + B @ (twists[m.v] - twists[m.w]))

    matches = [moved(m) for m in freed.overlaps.matches]
    stopped = replace(freed.overlaps, matches=matches, gram=gram(matches, g.views, g.centre, g.scale))
    beside = [] if name is None else [candidate_of(sound, EFFECTS[name]).forms[0].term]
    freed = replace(freed, overlaps=stopped)
    assert not field_error(sound.measurement, sound.model, freed, 0.01, beside).unusual


def test_what_is_beside_may_have_any_size(sound: LinearModel):
    """Errors that parameters beside them explain wholly are not seen."""
    freed = sound.observation.unconstrained
    sums, noise = sum_smooth_errors(sound.measurement, freed, per_view=True)
    # The error over incidence once more, as something beside.
    doubled = sums.select(np.append(np.arange(sums.residual.shape[1]), 2 * COARSE))
    shown = view_error_likelihood(doubled, freed, noise, nuisance=1)
    strength = [float(np.linalg.norm(told)) for told in shown.design]
    assert strength[1] < 1e-6 * strength[PER_VIEW]
