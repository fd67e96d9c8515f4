"""How features answer to errors of the scanner and of poses, against the whole run repeated with those errors in it.

Smooth errors that are new in each scan, against those that a simulator of its own put into the scans.

Fits and their slopes, against shapes of known size and against the fit repeated with moved points.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.scanner import Scanner, scan_waves
from data_synth.scene import load_scene
from data_synth.shapes.spheres import SpherePlate, centres
from stitch.api.pipeline import run
from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.plugins.metrology import error_sources
from stitch.plugins.metrology.budget import (
    OWN_NOISE,
    distance_between,
    evaluate,
    fit_features,
    monte_carlo,
    number_table,
)
from stitch.plugins.metrology.error_sources import INCIDENCE, OVERLAPS, SCANNER, error_chain, place_errors
from stitch.plugins.metrology.feature_file import Contribution, FeatureList
from stitch.plugins.metrology.features import Feature, fit_feature, fit_points, nominal_parameters, reach_of
from stitch.plugins.metrology.place_errors import RunPoints, point_sigmas

PLATE = SpherePlate(radius=28.0)
RNG = np.random.default_rng(5)
TURN = Rotation.from_rotvec([0.4, -0.3, 0.2]).as_matrix()
AT = np.array([30.0, -20.0, 100.0])
_COUNT = 400  # points of a shape


@pytest.fixture(scope="module")
def cell():
    """A measured session of a sphere plate, its run, and what is asked of it."""
    state = _plate_run(3)
    T = load_scene("spheres").T_reference_part
    balls = frames.transform(T, centres(PLATE))
    wanted = [Feature(f"ball {i}", "sphere", at=at, size=56.0, within=2.0) for i, at in enumerate(balls[:3])]
    wanted.append(Feature("apart", "distance", between=("ball 0", "ball 1")))
    at = frames.transform(T, np.array([[-45.0, 0.0, 0.0]]))[0]
    wanted.append(Feature("top", "plane", at=at, axis=T[:3, 2], radius=30.0, within=2.0))
    return state, place_errors(state), FeatureList(tuple(wanted))


def _plate_run(seed, **scanner):
    """A run of a plate of spheres by a scanner that errs so."""
    scene = clean("spheres", rays=90, noise=0.02, **scanner)
    part = replace(scene.part, labelled=False, parameters={"radius": PLATE.radius})
    return run(session_of(simulated(replace(scene, part=part, repeatability=(15e-6, 0.01)), {}, seed, views=6)))


def _numbers(state, wanted):
    places = place_errors(state)
    _, values, _, _ = number_table(wanted.features, fit_features(places.points, wanted.features)[0])
    return values


def _loadings(places, wanted, source):
    places = replace(places, sources=(source,))
    fits = fit_features(places.points, wanted.features)[0]
    _, _, _, slopes = number_table(wanted.features, fits)
    return slopes @ np.vstack([places.loadings(fit.at, fit.gradient) for fit in fits])


def _lengths(wanted, values):
    """Without slopes, and in the order of the table."""
    names = [
        q
        for f in wanted.features
        for q in {"plane": ("o", "s", "s"), "distance": ("d",)}.get(f.kind, ("d", "x", "y", "z"))
    ]
    return values[np.array(names) != "s"]


@pytest.mark.slow  # a whole run again
def test_smooth_scanner_error_moves_features_as_predicted(cell):
    state, places, wanted = cell
    smooth = next(s for s in places.sources if s.name == SCANNER)
    k, size = 2, 0.05  # one that is coarse over the field, mm
    of_modes = np.linalg.lstsq(smooth.shapes, np.eye(len(smooth.shapes))[k])[0]
    predicted = _loadings(places, wanted, smooth) @ of_modes * size
    views = []
    for v, view in enumerate(state.session.views):
        scan = state.measurement.capture.scans[v]
        moved = scan.points + size * places.point_modes(v, np.arange(len(scan.points)))[k]
        views.append(replace(view, cloud=replace(view.cloud, points=moved)))
    again = run(replace(state.session, views=tuple(views)))
    seen = _lengths(wanted, _numbers(again, wanted) - _numbers(state, wanted))
    predicted = _lengths(wanted, predicted)
    assert np.abs(predicted).max() > 0.02
    _require_alike(seen, predicted)


@pytest.mark.slow  # two whole runs
def test_smooth_error_of_one_scan_moves_features_as_predicted(cell):
    state, places, wanted = cell
    v, size = 2, 0.02
    source = next(s for s in places.sources if s.scan == v)
    of_modes = size / places.scan_errors.size * RNG.standard_normal(source.views.shape[1])
    predicted = _lengths(wanted, _loadings(places, wanted, source) @ of_modes)
    views = [*state.session.views]
    scan = state.measurement.capture.scans[v]
    rays, modes = places.scan_modes(v, np.arange(len(scan.points)))
    values = []
    for sign in (1, -1):
        points = scan.points + sign * (modes @ of_modes)[:, None] * rays
        views[v] = replace(state.session.views[v], cloud=replace(state.session.views[v].cloud, points=points))
        values.append(_numbers(run(replace(state.session, views=tuple(views))), wanted))
    seen = _lengths(wanted, values[0] - values[1]) / 2
    assert 0.67 < seen @ predicted / (predicted @ predicted) < 1.5
    # A bend that is as short as a ball changes which points are partners, too.
    assert np.linalg.norm(seen - predicted) < 0.7 * np.linalg.norm(predicted)


def _require_alike(seen, predicted):
    """Weights of views and partners of points change with the error, which no linear map says: by a third at most."""
    assert 0.67 < seen @ predicted / (predicted @ predicted) < 1.5
    assert np.linalg.norm(seen - predicted) < 0.4 * np.linalg.norm(predicted)


@pytest.mark.slow  # two whole runs
def test_error_of_one_pose_moves_features_as_predicted(cell):
    state, _, wanted = cell
    bare = [replace(view, joints=None, approach=None) for view in state.session.views]
    v, xi = 2, np.array([0.0, 1e-4, 0.0, 0.0, 0.0, 0.02])
    moved = [*bare]
    moved[v] = replace(bare[v], T_base_flange=bare[v].T_base_flange @ frames.exp(xi))
    before, after = (run(replace(state.session, robot=None, views=tuple(views))) for views in (bare, moved))
    chain, errors = error_chain(before), place_errors(before)
    left = frames.adjoint(frames.make(np.eye(3), -errors.centre) @ bare[v].T_base_flange) @ xi
    twist = np.zeros((6 * len(bare), 1))
    twist[6 * v : 6 * v + 6, 0] = -left  # the true pose is the reported one less this
    source = replace(
        errors.sources[0], views=chain.of_poses(twist)[0], shapes=np.zeros((len(errors.sources[0].shapes), 1))
    )
    predicted = _lengths(wanted, _loadings(errors, wanted, source)[:, 0])
    seen = _lengths(wanted, _numbers(after, wanted) - _numbers(before, wanted))
    _require_alike(seen, predicted)


def test_shares_add_up_and_the_largest_source_is_named(cell):
    _, places, wanted = cell
    fits = fit_features(places.points, wanted.features)[0]
    for name in {source.name for source in places.sources}:
        larger = tuple(
            replace(s, views=50 * s.views, shapes=50 * s.shapes) if s.name == name else s for s in places.sources
        )
        found = evaluate(replace(places, sources=larger), wanted, fits)
        for number in found.numbers:
            assert sum(number.shares.values()) == pytest.approx(1.0, abs=1e-9)
        if any(np.abs(s.views).max() > 1e-5 for s in places.sources if s.name == name):
            assert next(iter(found.numbers[1].shares)) == name


def test_a_scanner_without_smooth_errors_is_not_charged_with_large_ones(cell):
    _, places, _ = cell
    field, incidence = (np.linalg.norm(source.shapes, axis=1).max() for source in places.sources[:2])
    # Usual is 0.3 of the noise; its logarithm scatters by 0.7, so that one sigma more is 0.6.
    assert field < 0.3 * 0.02 and incidence < 0.6 * 0.02
    assert places.scan_errors.size < 0.3 * 0.02


def test_what_smooth_errors_make_of_the_overlaps_is_not_called_noise(cell):
    state, places, _ = cell
    chain = error_chain(state)
    smooth = 0.1 * error_sources._smooth_errors(state, chain)[0]  # mm, five times the noise
    rig = chain.solution.rig
    drawn = rig.reduce([smooth]) @ np.random.default_rng(0).standard_normal(smooth.shape[1])
    moved = replace(rig)
    vars(moved)["z"] = rig.z + drawn  # the cached property
    bent = replace(chain, solution=replace(chain.solution, rig=moved))
    beside, alone = (
        sum(np.sum(m[1][0] ** 2) for m in error_sources._pose_modes(state, bent, known) if m[0] == OVERLAPS)
        for known in (smooth, 0 * smooth)
    )
    before = sum(np.sum(source.views**2) for source in places.sources if source.name == OVERLAPS)
    assert beside < 5 * before < alone


BALL = Feature("ball", "sphere", at=np.array([0.0, 0.0, 500.0]), size=40.0)


def _lower_normals(directions):
    """Unit normals of the lower side of a ball."""
    normal = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return normal[normal[:, 2] < -0.5]


def test_a_shell_and_ways_along_the_rays_are_all_that_incidence_does_to_a_ball():
    normal = _lower_normals(np.random.default_rng(0).standard_normal((4000, 3)) - [0.0, 0.0, 2.0])
    points, ray = BALL.at + 20.0 * normal, np.array([0.0, 0.0, 1.0])  # of a scanner far away
    shift = 0.01 * (1 / -normal[:, 2] - 1)
    at = RunPoints(points + shift[:, None] * ray, normal, *np.zeros((2, len(points)), np.int64))
    fit = fit_points(BALL, at, np.array([0.0, 0.0, 0.0, 20.0]))
    # But for the square of the shift over the ball's size.
    assert fit.values[0] - 40.0 == pytest.approx(-0.02, rel=3e-3)
    assert fit.values[3] - 500.0 == pytest.approx(-0.01, rel=3e-3)
    assert np.abs(fit.residual).max() < 1e-5


def test_noise_along_the_rays_moves_a_ball_as_its_own_residuals_say():
    rng = np.random.default_rng(1)
    normal = _lower_normals(rng.standard_normal((3000, 3)))
    fits = []
    for noise in 0.02 * rng.standard_normal((300, len(normal))):  # of a scanner far away, along z
        points = BALL.at + 20.0 * normal + np.outer(noise, [0.0, 0.0, 1.0])
        at = RunPoints(points, normal, *np.zeros((2, len(points)), np.int64))
        fits.append(fit_points(BALL, at, np.array([0.0, 0.0, 0.0, 20.0])))
    by_residuals = np.mean([np.sum((fit.slopes * fit.noise) ** 2, axis=1) for fit in fits], axis=0)
    spread = np.var([fit.values for fit in fits], axis=0)
    # Of 300 draws a standard deviation is known to 4 %; the same noise across the whole surface would make 1.6 times it.
    assert np.sqrt(by_residuals / spread) == pytest.approx(1.0, abs=0.15)


def test_what_is_stated_of_a_source_takes_the_place_of_its_usual_size(cell):
    _, places, wanted = cell
    fits = fit_features(places.points, wanted.features)[0]
    stated = replace(wanted, contributions=(Contribution(INCIDENCE, length=1e-6),))
    before, after = (evaluate(places, which, fits).numbers[0] for which in (wanted, stated))
    assert before.quantity == "diameter" and before.shares[INCIDENCE] > 0.5 and after.shares[INCIDENCE] < 1e-3
    assert after.u == pytest.approx(before.u * np.sqrt(1 - before.shares[INCIDENCE]), rel=1e-3)


def test_a_distance_is_better_known_than_its_ends(cell):
    _, places, wanted = cell
    found = evaluate(places, wanted, fit_features(places.points, wanted.features)[0])
    U = {n.name: n.U for n in found.numbers}
    ends = np.hypot(*(np.linalg.norm([U[f"ball {i}.{axis}"] for axis in "xyz"]) for i in (0, 1)))
    assert U["apart.distance"] < 0.5 * ends
    assert np.abs(found.correlation).max() <= 1 + 1e-9


def test_monte_carlo_agrees_with_the_propagation(cell):
    _, places, wanted = cell
    few = FeatureList((*wanted.features[:2], wanted.features[3]), (Contribution("scale", relative=2e-5),))
    found = monte_carlo(places, few, fit_features(places.points, few.features)[0], 400)
    # Five standard deviations of 400 trials.
    assert np.abs(found.ratio - 1).max() < 5 / np.sqrt(2 * 400)


def test_a_stated_contribution_counts_by_its_length(cell):
    _, places, wanted = cell
    fits = fit_features(places.points, wanted.features)[0]
    plain = evaluate(places, wanted, fits)
    stated = evaluate(places, replace(wanted, contributions=(Contribution("scale", relative=1e-3),)), fits)
    for before, after in zip(plain.numbers, stated.numbers, strict=True):
        own = 1e-3 * after.value if after.quantity in ("distance", "diameter") else 0.0
        assert after.u == pytest.approx(np.hypot(before.u, own), rel=1e-9)


def test_every_fused_point_has_a_sigma_of_the_size_of_a_small_patch(cell):
    state, places, _ = cell
    sigma = point_sigmas(places, state.fused)
    assert np.isfinite(sigma).all() and (sigma > 0).all()
    T = state.fused.points
    at = T[len(T) // 2]
    patch = Feature("here", "point", at=at, axis=state.fused.normals[len(T) // 2], radius=8.0, within=3.0)
    found = evaluate(places, FeatureList((patch,)), fit_features(places.points, (patch,))[0])
    known = float(np.median(sigma[np.linalg.norm(T - at, axis=1) < 8.0]))
    number = found.numbers[0]
    shared = number.u * np.sqrt(1 - number.shares[OWN_NOISE])
    assert 0.6 * shared < known < 2.0 * np.hypot(number.u, 0.02)


def _measured_errors(size: float, length: float, seed: int):
    return place_errors(_plate_run(seed, scan_error=size, scan_error_length=length)).scan_errors


@pytest.mark.parametrize(
    ("size", "length", "seed"), [(0.01, 0.1, 3), pytest.param(0.02, 0.2, 4, marks=pytest.mark.slow)]
)
def test_the_overlaps_show_how_large_errors_of_single_scans_are(size, length, seed):
    errors = _measured_errors(size, length, seed)
    # Some thirty patches of a length in each of six scans, of which poses take up a part: a sigma known to a tenth.
    assert 0.6 < errors.size / size < 1.4


@pytest.mark.slow
def test_the_modes_hold_the_variance_and_the_correlation_of_what_the_simulator_draws():
    errors = _measured_errors(0.02, 0.15, 5)
    scanner = Scanner(field_of_view=48.0, field_of_view_y=40.0, scan_error=errors.size, scan_error_length=0.15)
    rays = np.column_stack([np.linspace(-0.3, 0.3, 7), np.full(7, 0.05), np.ones(7)])
    modes = errors.along(rays)
    drawn = np.array([scan_waves(scanner, rays, np.random.default_rng(k)) for k in range(4000)])
    modelled, simulated_covariance = modes @ modes.T, np.cov(drawn.T)
    # The field is cut into modes, and the length is one of few: variances within a third, far places independent.
    assert np.abs(np.diag(modelled) / np.diag(simulated_covariance) - 1).max() < 0.35
    assert np.abs(modelled[0, 4:]).max() < 0.15 * errors.size**2


def test_the_order_of_the_views_changes_nothing(monkeypatch):
    scene = clean("spheres", rays=60, noise=0.02, scan_error=0.02, scan_error_length=0.2)
    session = session_of(simulated(replace(scene, repeatability=(15e-6, 0.01)), {}, 6, views=5))
    views = [replace(view, time_s=None) for view in session.views]
    # Half of the pairs, so that it counts which they are.
    monkeypatch.setattr("stitch.plugins.metrology.scan_errors._MOST_PAIRS", 5)
    sizes = [place_errors(run(replace(session, views=tuple(order)))).scan_errors.size for order in (views, views[::-1])]
    assert sizes[0] == pytest.approx(sizes[1], rel=1e-6)


def _sphere():
    normal = RNG.standard_normal((_COUNT, 3))
    normal[:, 2] = np.abs(normal[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return 12.5 * normal, normal


def _cylinder():
    angle = RNG.uniform(0, 4.0, _COUNT)
    normal = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_COUNT)])
    return 8.0 * normal + np.outer(RNG.uniform(-15, 15, _COUNT), [0, 0, 1]), normal


def _plane():
    places = np.column_stack([RNG.uniform(-9, 9, (_COUNT, 2)), np.zeros(_COUNT)])
    return places, np.tile([0.0, 0.0, 1.0], (_COUNT, 1))


SHAPES = {
    "sphere": (_sphere, Feature("s", "sphere", at=AT, axis=TURN[:, 2], size=25.0, within=1.0)),
    "cylinder": (_cylinder, Feature("c", "cylinder", at=AT, axis=TURN[:, 2], size=16.0, radius=15.0, within=1.0)),
    "circle": (_cylinder, Feature("k", "circle", at=AT, axis=TURN[:, 2], size=16.0, within=16.0)),
    "plane": (_plane, Feature("p", "plane", at=AT, axis=TURN[:, 2], radius=12.0, within=1.0)),
    "point": (_plane, Feature("q", "point", at=AT, axis=TURN[:, 2], radius=12.0, within=1.0)),
}


def _points(kind, noise=0.0):
    make, feature = SHAPES[kind]
    local, normal = make()
    points = feature.at + (local + noise * RNG.standard_normal((len(local), 1)) * normal) @ feature.R.T
    index = np.arange(len(points))
    return feature, RunPoints(points, normal @ feature.R.T, np.zeros(len(points), int), index)


@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_without_noise_is_found_exactly(kind):
    feature, points = _points(kind)
    found = fit_feature(feature, points, points.index)
    expected = np.append(feature.size, AT) if feature.size else np.zeros(len(found.values))
    assert np.abs(found.values - expected).max() < 1e-8
    assert found.form < 1e-9


@pytest.mark.parametrize("kind", SHAPES)
def test_slopes_are_those_of_the_fit_repeated(kind):
    feature, points = _points(kind, noise=0.01)
    found = fit_points(feature, points, nominal_parameters(feature))
    moved = 1e-4 * RNG.standard_normal(points.points.shape)
    predicted = np.einsum("qni,ni->q", found.gradient, moved)
    repeated = (found.refit(points.points + moved) - found.refit(points.points - moved)) / 2
    # Residuals of 10 µm against radii of millimetres are what the slopes leave out.
    assert np.abs(repeated - predicted).max() < 0.02 * np.abs(found.gradient).sum(axis=1).max() * 1e-4 + 5e-8


def test_points_far_from_the_nominal_surface_do_not_count():
    feature, points = _points("sphere", noise=0.01)
    off = points.points.copy()
    off[:40] += 0.6 * points.normals[:40]
    found = fit_feature(feature, RunPoints(off, points.normals, points.view, points.index), points.index)
    assert found.values[0] == pytest.approx(25.0, abs=0.01)


def test_points_that_fill_the_space_about_a_ball_are_not_measured_as_one():
    feature, points = _points("sphere")
    spread = points.points + RNG.uniform(-6, 6, (_COUNT, 1)) * points.normals
    with pytest.raises(NoResultError, match="its points spread by"):
        fit_feature(replace(feature, within=8.0), replace(points, points=spread), points.index)


def test_a_deviation_counts_from_the_mesh():
    box = trimesh.creation.box([100.0, 100.0, 20.0])
    flat = np.column_stack([RNG.uniform(-5, 5, (300, 2)), np.full(300, 10.07)])
    feature = Feature("d", "deviation", at=np.array([0.0, 0.0, 10.0]), radius=6.0, within=1.0, cad=box)
    points = RunPoints(flat, np.tile([0.0, 0.0, 1.0], (300, 1)), np.zeros(300, int), np.arange(300))
    found = fit_feature(feature, points, points.index)
    assert found.values[0] == pytest.approx(0.07, abs=1e-6)
    assert reach_of(feature) >= 6.0


def test_slopes_of_distances_are_those_of_differences():
    fits = {
        kind: fit_points(*(lambda f, p: (f, p, nominal_parameters(f)))(*_points(kind, noise=0.01))) for kind in SHAPES
    }
    ball, plane = fits["sphere"], fits["plane"]
    wanted = [ball.feature, plane.feature, Feature("x", "distance", between=("p", "s"))]
    _, _, _, slopes = number_table(wanted, [ball, plane])
    values = np.concatenate([ball.values, plane.values])
    for k in range(len(values)):
        step = np.zeros(len(values))
        step[k] = 1e-6
        up, down = (
            distance_between(ball.feature, (values + s)[:4], plane.feature, (values + s)[4:]) for s in (step, -step)
        )
        assert (up - down) / 2e-6 == pytest.approx(slopes[-1, k], abs=1e-3)
