"""Smooth errors of a scanner, the same in every view or of single views, and their map, against those put in.

A scanner's scale among the errors that all views repeat: against scans that are stretched.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from scipy.optimize import check_grad
from scipy.stats import chi2

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import Measured, clean, simulated
from data_synth.scene import load_scene
from stitch.api import pipeline
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.effects.contract import EFFECTS
from stitch.numerics import frames
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError, FieldMap, field_error, robust_pass_share
from stitch.observations.surfaces.hand_eye_fit import SCANNER_SCALE, hand_eye_statistics, solve_hand_eye
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import gram
from stitch.observations.surfaces.scanner_errors import (
    COARSE,
    PER_VIEW,
    SCALE_SIGMA,
    SHARE_SPREAD,
    USUAL_SHARE,
    SmoothErrorLikelihood,
    field_scatter,
    part_of_view,
    scale_scatter,
    shared_error_likelihood,
    sum_smooth_errors,
    view_error_likelihood,
)
from stitch.observations.surfaces.view_poses import unconstrained_poses
from stitch.session.measurement import measurement_of

# mm along the ray at places (N,) of the field, −1 … 1 both ways.
Law = Callable[[np.ndarray, np.ndarray], np.ndarray]
VIEWS, REACH = 12, 0.38  # REACH: x/z and y/z at the edges of the field
FEW_VIEWS, STRETCH = 6, 3e-4


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
def test_no_map_is_drawn_of_errors_across_the_ray(change):
    assert found(change)[0].map is None


@pytest.mark.slow
def test_robust_weights_let_five_sixths_of_a_small_error_through():
    """Of normal residuals Σ ψ′/Σ ψ/e of the biweight at 4.685 σ: 0.758/0.915."""
    assert found(along(nothing))[1] == pytest.approx(0.828, abs=0.02)


VIEWS_ERRORS_BY_VIEW = 12


# What moves the points (N, 3) of view v, scanner frame, mm.
LawOfErrorsByView = Callable[[np.ndarray, int, Measured], np.ndarray]


def swings(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The arm swings once by 0.15 mm, in another direction in every view, while the scanner reads across its field."""
    way = np.random.default_rng(v).standard_normal(3)
    field = points[:, 0] / points[:, 2]
    return 0.15 * np.sin(np.pi * field / np.abs(field).max())[:, None] * way / np.linalg.norm(way)


def bends(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """0.2 mm at the part's ends over the session."""
    T = cell.T_reference_scanner[v]
    x = (points @ T[:3, :3].T + T[:3, 3])[:, 0] / (0.5 * np.ptp(cell.mesh.vertices[:, 0]))
    return 0.2 * v / (VIEWS_ERRORS_BY_VIEW - 1) * (x**2)[:, None] * T[2, :3]


def alike(points: np.ndarray, v: int, cell: Measured) -> np.ndarray:
    """The same 0.06 mm along the ray in every view, by a law finer than that of a view of its own."""
    a, b = (points[:, i] / points[:, 2] / np.abs(points[:, i] / points[:, 2]).max() for i in (0, 1))
    return 0.06 * (np.cos(np.pi * a) * np.cos(np.pi * b))[:, None] * points / np.linalg.norm(points, axis=1)[:, None]


def linear_of(law: LawOfErrorsByView | None, seed: int = 5) -> LinearModel:
    """The model of twelve views of a plate with spheres, whose points err by a law."""
    cell = simulated(clean("spheres", rays=55), {}, seed, views=VIEWS_ERRORS_BY_VIEW)
    if law is not None:
        clouds = [replace(c, points=c.points + law(c.points, v, cell)) for v, c in enumerate(cell.clouds)]
        cell = replace(cell, clouds=clouds)
    return linear_model_of(pipeline.run(session_of(cell)))


@pytest.fixture(scope="module")
def sound() -> LinearModel:
    return linear_of(None)


def test_sums_for_either_view_add_up_to_those_of_both(sound: LinearModel):
    """Sums for either view of a pair its own, added up, are those for both together."""
    unconstrained = sound.observation.unconstrained
    apart, noise = sum_smooth_errors(sound.measurement, unconstrained, per_view=True)
    together, _ = sum_smooth_errors(sound.measurement, unconstrained)
    coarse = apart.select(slice(2 * COARSE + 1))
    added = shared_error_likelihood(coarse, unconstrained, noise, per_view=COARSE)
    wanted = shared_error_likelihood(together, unconstrained, noise)
    shares = np.array([0.4, 0.2])
    for cause in range(2):
        np.testing.assert_allclose(added.estimate(cause, shares), wanted.estimate(cause, shares), rtol=1e-6, atol=1e-9)


def test_the_likelihood_has_the_slopes_that_it_says():
    rng = np.random.default_rng(0)
    told = tuple(rng.standard_normal((9, k)) for k in (3, 1, 6))
    shown = SmoothErrorLikelihood(rng.standard_normal(9), told, rng.uniform(0.5, 2.0, 9))
    value, slope = (lambda x, i=i: shown._deviance(x)[i] for i in (0, 1))
    for point in rng.uniform(-2, 1, (5, 3)):
        assert check_grad(value, slope, point) < 1e-5 * max(1.0, np.linalg.norm(slope(point)))


@pytest.mark.slow
def test_sizes_are_those_with_which_errors_were_drawn():
    """Errors of three causes drawn by their variances: log shares within three of their standard errors on average."""
    rng = np.random.default_rng(1)
    told = tuple(rng.standard_normal((150, k)) for k in (20, 20, 90))
    true, found = np.array([1.0, 0.4, 0.7]), []
    for _ in range(40):
        errors = sum(s * t @ rng.standard_normal(t.shape[1]) for s, t in zip(true, told, strict=True))
        seen = errors + 0.5 * rng.standard_normal(150)
        found.append(np.log(SmoothErrorLikelihood(seen, told, np.full(150, 0.25)).ml_shares()[0] / true))
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
def test_errors_of_single_views_are_told_as_such(law: LawOfErrorsByView, with_time: bool):
    """Neither is laid on the scanner's field; what grows with the session is told from what does not."""
    linear = linear_of(law)
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, 0.01)
    assert found.by_view and found.over_noise
    assert found.with_time == with_time
    # Poses follow what they can: less is left, and never more than was put in.
    assert found.rms_by_view < 0.2


@pytest.mark.slow
def test_an_error_that_all_views_share_is_not_laid_on_single_views():
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


def test_moments_of_errors_of_unknown_size_are_those_of_weighed_draws():
    rng = np.random.default_rng(4)
    told = (rng.standard_normal((8, 2)), rng.standard_normal((8, 3)))
    shown = SmoothErrorLikelihood(told[0] @ [0.9, -0.4] + rng.standard_normal(8), told, np.full(8, 1.5))
    mean, moment, _ = shown.error_moments(0, np.array([9.0, 0.5]))
    sizes = USUAL_SHARE * np.exp(SHARE_SPREAD * rng.standard_normal((400_000, 1)))
    errors = sizes * rng.standard_normal((400_000, 2))
    left = shown.data - errors @ told[0].T
    beside = np.linalg.inv(np.diag(shown.scatter) + 0.25 * told[1] @ told[1].T)
    weights = np.exp(-0.5 * np.einsum("ni,ij,nj->n", left, beside, left))
    weights /= weights.sum()
    np.testing.assert_allclose(mean, weights @ errors, rtol=0.03, atol=0.01)
    np.testing.assert_allclose(moment, (errors.T * weights) @ errors, rtol=0.03, atol=0.01)


def test_a_size_that_nothing_shows_counts_as_the_usual_ones_do():
    nothing = SmoothErrorLikelihood(np.zeros(3), (np.zeros((3, 1)),), np.ones(3))
    mean, moment, degrees = nothing.error_moments(0, np.ones(1))
    square = np.exp(4 * SHARE_SPREAD**2)  # of a log-normal variance, over the square of its mean
    assert mean == pytest.approx(0.0)
    assert moment.item() == pytest.approx(USUAL_SHARE**2 * np.exp(2 * SHARE_SPREAD**2), rel=0.02)
    # Sizes beyond four of their spread are left out: an eighth of its square.
    assert degrees == pytest.approx(2 / (square - 1), rel=0.2)


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


def test_nuisance_effects_may_have_any_size(sound: LinearModel):
    """Errors that parameters beside them explain wholly are not seen."""
    freed = sound.observation.unconstrained
    sums, noise = sum_smooth_errors(sound.measurement, freed, per_view=True)
    # The error over incidence once more, as something beside.
    doubled = sums.select(np.append(np.arange(sums.residual.shape[1]), 2 * COARSE))
    shown = view_error_likelihood(doubled, freed, noise, nuisance=1)
    strength = [float(np.linalg.norm(told)) for told in shown.design]
    assert strength[1] < 1e-6 * strength[PER_VIEW]


SEEDS = 2


def repeated(share: float, seed: int) -> Measured:
    """A plate seen by a scanner of which smooth errors of `share` of the noise repeat."""
    scene = load_scene("drill-plate")
    scanner = replace(scene.scanner, columns=50, rows=50, field_error=share * scene.scanner.noise)
    return simulated(replace(scene, scanner=scanner, repeatability=(4e-6, 0.004)), {}, seed, views=10)


def chi_squares(share: float) -> tuple[list[float], list[float]]:
    """Per seed χ² of the hand-eye's error and the sigma of its place (mm); smooth errors of `share` of the noise."""
    squares, sigmas = [], []
    for seed in range(SEEDS):
        measured = repeated(share, seed)
        found = pipeline.run(session_of(measured))
        xi = frames.log(frames.inverse(found.T_mount) @ measured.T_mount)
        squares.append(float(xi @ np.linalg.solve(found.mount_covariance, xi)))
        sigmas.append(float(np.sqrt(np.trace(found.mount_covariance[3:, 3:]))))
    return squares, sigmas


@pytest.mark.parametrize(
    ("share", "unusual", "over_noise"),
    [
        pytest.param(0.2, False, False, marks=pytest.mark.slow),
        (0.9, True, False),
        pytest.param(4.0, True, True, marks=pytest.mark.slow),
    ],
)
def test_errors_that_repeat_are_told_with_their_size(share, unusual, over_noise):
    """A usual scanner, one that errs by nearly its noise, and one by four times that: none too much is said of any."""
    measured = repeated(share, 0)
    linear = linear_model_of(pipeline.run(session_of(measured)))
    found = field_error(linear.measurement, linear.model, linear.observation.unconstrained, 0.01)
    assert (found.unusual, found.over_noise) == (unusual, over_noise)
    assert found.rms < 2 * share * load_scene("drill-plate").scanner.noise
    assert not unusual or found.rms > 0.3 * share * load_scene("drill-plate").scanner.noise


@pytest.mark.slow
def test_sigmas_hold_whatever_the_scanner_repeats():
    """As large as the noise, or none: the error is within its covariance, and small errors do not widen it as large."""
    large, small = chi_squares(1.0), chi_squares(0.0)
    for squares, _ in (large, small):
        assert sum(squares) < chi2.ppf(0.999, 6 * SEEDS)
    assert np.mean(large[1]) > 1.5 * np.mean(small[1])


@pytest.mark.slow
def test_what_incidence_shows_is_not_laid_on_the_field():
    """A carried scanner on a coarse surface: grazing points pretend a bias, while its field has no error at all."""
    scene = load_scene("blade-table")
    scanner = replace(scene.scanner, columns=80, rows=80, field_error=0.0)
    measured = simulated(replace(scene, scanner=scanner), {}, 3, views=10)
    linear = linear_model_of(pipeline.run(session_of(measured)))
    errors, unconstrained = linear.observation.scanner_errors, linear.observation.unconstrained
    shown, unit = (field_scatter(errors, unconstrained, share) for share in (None, 1.0))
    shares = np.linalg.norm(shown, axis=0) / np.linalg.norm(unit, axis=0)
    assert np.max(shares[:-1]) < 0.2


def freed(measured):
    """The capture, and its views moved by the overlaps alone from their places under the true hand-eye."""
    capture = captured(measured)
    return capture, unconstrained_poses(capture, capture.poses(measured.T_mount), 1.0)


@pytest.fixture(scope="module")
def cell():
    """A blade of few views, and the same with all scans too large."""
    measured = measured_blade(4, views=FEW_VIEWS, pixels=60)
    clouds = [replace(cloud, points=(1 + STRETCH) * cloud.points) for cloud in measured.clouds]
    return measured, freed(measured), freed(replace(measured, clouds=clouds))


def test_scans_that_are_too_large_move_away_from_the_part(cell):
    """To a tenth, in the directions that overlaps show and as well as they show them: partners change a little."""
    measured, (capture, before), (_, after) = cell
    expected = STRETCH / SCALE_SIGMA * scale_scatter(measurement_of(session_of(measured), capture), before)
    visible = before.overlaps.gram.visible
    seen = (visible.vectors * np.sqrt(visible.values)).T / visible.scale
    moved, expected = seen @ (after.twists - before.twists).ravel(), seen @ expected.ravel()
    assert np.linalg.norm(moved - expected) < 0.1 * np.linalg.norm(expected)


def test_U_covers_what_data_sheets_state(cell):
    """Half as much again: without the source the hand-eye is off by twice U in an axis, with it in none by more."""
    measured, _, (capture, views) = cell
    measurement, T = measurement_of(session_of(measured), capture), measured.T_mount
    source = {SCANNER_SCALE: [scale_scatter(measurement, views)]}
    off = []
    for scanner_errors in ({}, source):
        found = hand_eye_statistics(solve_hand_eye([capture], [views], T), scanner_errors=scanner_errors)
        xi = frames.log(frames.inverse(found.T_mount) @ T)
        off.append(np.abs(xi) / np.sqrt(np.diag(found.covariance)))
    assert off[1].max() < 2
    assert off[0].max() > 4
