"""Scans onto CAD: allowance beside the pose, and errors of the placing scans."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from data_synth.cells import window_scans, window_views
from data_synth.scanning import scan
from data_synth.shapes import build_shape, car_door
from data_synth.shapes.car_door import CarDoor, Pane
from data_synth.shapes.casting import around, with_stock
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.output.session_files import SessionFiles, pose_columns, write_session
from stitch.plugins.cells.cad import cad_surface, cell_weights, nearest_partners, surface_cells
from stitch.plugins.cells.job_files import JobTable
from stitch.plugins.cells.placed_scans import (
    SOURCES,
    JoinedScans,
    PlacedScans,
    PlacingErrors,
    assemble_scans,
    join_scans,
    read_hand_eye,
    read_placed_session,
    stated_errors,
)
from stitch.plugins.cells.scan_to_cad import AllowancePrior, allowance_sentence, fit_cad, read_allowance
from stitch.plugins.cells.seam import Limits, Station, measure_seam
from stitch.session.scan import prepare_scan
from stitch.session.session import Cloud
from tests.command_line import ended

FREE, VARYING = AllowancePrior(free=True), AllowancePrior(free=True, varying=True)
STOCK = 0.3


@pytest.fixture(scope="module")
def blade():
    return build_shape("blade", sections=30, around=120)


@pytest.fixture(scope="module")
def blade_cad(blade):
    return cad_surface(blade)


def even(points):
    return np.full(len(points), STOCK)


def slow(points):
    """Quadratic along the span: 0.2 at the ends, 0.35 in the middle."""
    return 0.35 - 0.15 * (points[:, 2] / 100 - 1) ** 2


def scanned(mesh, stock, seed, views=6, rays=60, noise=0.02):
    """The casting's scans in the base, the true T_base_part, and a start that is off by 4 mrad and 0.6 mm per axis."""
    rng = np.random.default_rng([seed, 5])
    T = frames.make(Rotation.random(rng=rng).as_matrix(), [1200.0, -300.0, 800.0])
    tool = window_scans.area_scanner(rays, 34.0, 420.0, depth=300.0, noise=noise)
    poses = around(mesh, views, 420.0, rng)
    clouds = [scan(with_stock(mesh, stock), pose, tool, window_scans.NO_FIELD, rng).points for pose in poses]
    off = frames.exp(rng.normal(size=6) * np.repeat([4e-3, 0.6], 3))
    centre = frames.make(np.eye(3), mesh.bounds.mean(axis=0))
    return join_scans([prepare_scan("", c) for c in clouds], T @ poses), T, T @ centre @ off @ np.linalg.inv(centre)


def error(found, T, cad):
    """(6,) twist about the CAD's centre, as `covariance` counts it."""
    centre = frames.make(np.eye(3), cad.centre)
    return frames.log(np.linalg.inv(T @ centre) @ found.T_base_part @ centre)


@pytest.fixture(scope="module")
def casting(blade):
    return scanned(blade, even, 0)


def test_an_even_allowance_is_found_and_the_pose_stays(casting, blade_cad):
    joined, T, start = casting
    found = fit_cad(joined, blade_cad, start, prior=FREE)
    assert abs(found.allowance.value - STOCK) < 0.005
    assert abs(found.allowance.value - STOCK) < 4 * found.allowance.sigma < 0.005
    off = error(found, T, blade_cad)
    assert off @ np.linalg.solve(found.covariance, off) < 27.9  # χ² of 6, chance 1e-4
    assert "plus: stock outside" in allowance_sentence(found.allowance, "mm")


def test_too_little_stock_is_minus(blade, blade_cad):
    joined, _, start = scanned(blade, lambda p: -0.2 * np.ones(len(p)), 1)
    assert fit_cad(joined, blade_cad, start, prior=FREE).allowance.value == pytest.approx(-0.2, abs=0.005)


def test_the_fit_makes_the_variance_smallest(casting, blade_cad):
    """Variance-minimisation matching (λ = 0): from where the fit stands, its step −D⁻¹b is none."""
    joined, _, start = casting
    found = fit_cad(joined, blade_cad, start, prior=FREE)
    T = frames.inverse(found.T_base_part)
    usable = joined.take(joined.usable)
    local = frames.transform(T, usable.points)
    distance, normal, accept = nearest_partners(blade_cad, local, frames.rotate(T, usable.normals))
    rest = distance - found.allowance.value
    w = accept * tukey(rest, found.scale)
    w *= cell_weights(surface_cells(local, normal, blade_cad.size / 40), rest, accept, found.scale)
    A = np.hstack([np.cross(local - blade_cad.centre, normal), normal])
    A, d = A - np.average(A, axis=0, weights=w), distance - np.average(distance, weights=w)
    step = -np.linalg.solve((A * w[:, None]).T @ A, (A * w[:, None]).T @ d)
    assert len(usable.points) < 20_000  # the fit took all of them
    assert np.abs(step / found.sigma).max() < 0.01
    total = np.average(distance**2, weights=w)
    assert total == pytest.approx(np.average(d**2, weights=w) + found.allowance.value**2, rel=1e-4)


def test_flash_on_one_side_does_not_pull_the_allowance(casting, blade_cad):
    """One point in eight stands 0.02 to 0.2 mm further out."""
    joined, T, start = casting
    rng = np.random.default_rng(3)
    out = np.where(rng.random(len(joined.points)) < 0.125, rng.uniform(0.02, 0.2, len(joined.points)), 0.0)
    joined = replace(joined, points=joined.points + out[:, None] * joined.normals)
    found = fit_cad(joined, blade_cad, start, prior=FREE)
    assert abs(found.allowance.value - STOCK) < 0.005


def test_a_varying_allowance_is_found_at_its_places(blade, blade_cad):
    joined, T, start = scanned(blade, slow, 2)
    found = fit_cad(joined, blade_cad, start, prior=VARYING)
    places = frames.transform(np.linalg.inv(T), joined.points[joined.usable])
    off = found.allowance.at(places) - slow(places)
    assert np.sqrt(np.mean(off**2)) < 0.005
    assert np.abs(off.mean()) < 4 * found.allowance.sigma
    assert found.allowance.highest - found.allowance.lowest == pytest.approx(np.ptp(slow(places)), abs=0.01)
    turned = error(found, T, blade_cad)
    assert turned @ np.linalg.solve(found.covariance, turned) < 27.9


def test_where_nothing_varies_the_field_shrinks_to_nothing(casting, blade_cad):
    joined, T, start = casting
    field, flat = (fit_cad(joined, blade_cad, start, prior=w).allowance for w in (VARYING, FREE))
    assert field.value == pytest.approx(flat.value, abs=0.5 * flat.sigma)
    assert field.highest - field.lowest < 0.005


HALF = np.array([100.0, 75.0, 50.0])


@pytest.fixture(scope="module")
def box_cad():
    return cad_surface(trimesh.creation.box(2 * HALF))


def box_sides(*sides):
    """Points 0.3 outside some sides (axis, sign) of the box."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.9, 0.9, (len(sides), 600, 3)) * HALF, np.zeros((len(sides), 600, 3))
    for own, normal, (axis, sign) in zip(points, normals, sides, strict=True):
        own[:, axis] = sign * (HALF[axis] + STOCK) + 0.01 * rng.standard_normal(600)
        normal[:, axis] = sign
    ones = np.ones(600 * len(sides))
    return JoinedScans(
        points.reshape(-1, 3), normals.reshape(-1, 3), ones > 0, ones, 3.0, 0.01, np.zeros(len(ones), int)
    )


def test_what_a_shift_imitates_is_no_allowance(box_cad):
    """Three sides of one corner fix the pose but not the stock: a shift along the diagonal does the same."""
    joined = box_sides((0, 1), (1, 1), (2, 1))
    with pytest.raises(NoResultError, match=r"cannot be told from a shift .* \((0.58 0.58 0.58|-0.58 -0.58 -0.58)\)"):
        fit_cad(joined, box_cad, np.eye(4), prior=FREE)
    stated = fit_cad(joined, box_cad, np.eye(4), prior=AllowancePrior(known=STOCK))
    assert np.abs(stated.T_base_part - np.eye(4)).max() < 0.01
    assert stated.allowance.value == STOCK
    assert "as stated" in allowance_sentence(stated.allowance, "mm")


def test_an_opposite_side_tells_it(box_cad):
    found = fit_cad(box_sides((0, 1), (0, -1), (1, 1), (2, 1)), box_cad, np.eye(4), prior=FREE)
    assert abs(found.allowance.value - STOCK) < 4 * found.allowance.sigma < 0.005


def test_a_plate_seen_from_above_says_so(box_cad):
    with pytest.raises(NoResultError, match="of a plate the allowance is a shift along its normal"):
        fit_cad(box_sides((2, 1)), box_cad, np.eye(4), prior=FREE)


def test_what_the_option_takes():
    assert read_allowance(None) == AllowancePrior()
    assert read_allowance("free") == FREE
    assert read_allowance("varying") == VARYING
    assert read_allowance("-0.25") == AllowancePrior(known=-0.25)


@pytest.mark.parametrize("text", ["frei", "nan", "inf", "", "0,3"])
def test_other_words_are_refused(text):
    with pytest.raises(InputError, match="--allowance is .*; to fix: write free"):
        read_allowance(text)


def test_the_command_refuses_in_one_line(tmp_path):
    shown = ended("fit", tmp_path / "any.toml", "--allowance", "much", code=2)
    assert shown.out == ""
    assert shown.err.count("\n") == 1


@pytest.mark.slow
def test_sigmas_of_allowance_and_pose_hold(blade, blade_cad):
    """Of 24 castings as many lie within 1.96 sigma as a binomial of 95 % lets, both tails 1 in 1,000."""
    z = []
    for seed in range(100, 124):
        joined, T, start = scanned(blade, even, seed)
        found = fit_cad(joined, blade_cad, start, prior=FREE)
        off = (found.allowance.value - STOCK) / found.allowance.sigma
        z.append([off, *error(found, T, blade_cad) / found.sigma])
        assert abs(found.allowance.value - STOCK) < 0.005
    inside = (np.abs(z) < 1.96).sum(axis=0)
    assert (inside >= binom.ppf(0.001, 24, 0.95)).all()


DOOR = {"length": 600.0, "height": 520.0, "belt": 300.0, "window_frame": 34.0}
X = frames.make(np.eye(3), [0.0, 130.0, 90.0])  # T_flange_scanner
# A hand-eye's error along one direction of its twist, and one of a view's flange.
XI = np.array([1e-4, -2e-4, 5e-5, 0.03, 0.02, -0.04])


def scans_of(pane):
    far, poses = window_scans.scan_outside(pane, np.eye(4), 0.02, 1, (2, 1), rays=60, distance=600.0)
    near, close = window_scans.scan_edges(pane, np.eye(4), Pane(**DOOR), "pane", 0.02, 2, count=6, rays=70)
    return [prepare_scan("", c) for c in far + near], np.concatenate([poses, close]) @ frames.inverse(X)


@pytest.fixture(scope="module")
def pane():
    return car_door.build_pane(Pane(**DOOR))


def errors_of(T_base_flange, **kinds):
    return PlacingErrors(T_base_flange, X, kinds.pop("hand_eye", np.zeros((6, 6))), **kinds)


def test_modes_move_points_as_frames_do(pane):
    scans, T_base_flange = scans_of(pane)
    scan = join_scans(scans, T_base_flange @ X)
    # Of a covariance of rank one all other modes vanish.
    *rest, (own, moved) = errors_of(T_base_flange, hand_eye=np.outer(XI, XI)).modes(scan, "hand_eye")
    assert all(np.abs(other).max() < 1e-6 for _, other in rest)
    there = join_scans(scans, T_base_flange @ X @ frames.exp(XI))
    truly = there.points - scan.points
    sign = np.sign((truly * moved).sum())
    assert len(own) == len(scan.points)
    assert np.abs(sign * moved - truly).max() < 1e-3 * np.abs(truly).max()
    modes = list(errors_of(T_base_flange, rotation=1e-4).modes(scan, "robot"))
    own, moved = modes[4]  # the second view's turn about its flange's y
    T_base_flange[1] = T_base_flange[1] @ frames.exp(np.array([0, 1e-4, 0, 0, 0, 0]))
    truly = join_scans(scans, T_base_flange @ X).points - scan.points
    assert len(modes) == 3 * len(scans) and not truly[scan.view != 1].any()
    assert np.abs(moved - truly[own]).max() < 1e-3 * np.abs(moved).max()


def test_scans_of_one_stop_are_displaced_alike(pane):
    scans, poses = scans_of(pane)
    scan = join_scans(scans, poses @ X)
    errors = errors_of(poses, carriage=0.3, stop=np.arange(len(poses)) // 2)
    modes = list(errors.modes(scan, "carriage"))
    assert len(modes) == 3 * (errors.stop.max() + 1)
    for k, (index, moved) in enumerate(modes):
        assert (moved == 0.3 * np.eye(3)[k % 3]).all()
        assert set(errors.stop[scan.view[index]]) == {k // 3}


def sweeps(folder, columns=("sweep_x", "sweep_y", "sweep_z"), time=True):
    """Two sweeps over a plane; returns the session, its hand-eye, and where each sweep's points lie in the base."""
    rng = np.random.default_rng(3)
    T_flange_scanner = X @ frames.exp(np.array([0.3, -0.2, 0.1, 0, 0, 0]))
    poses = np.array([frames.exp(np.append(rng.normal(0, 0.5, 3), rng.normal(0, 300, 3))) for _ in range(2)])
    velocity, clouds, places = rng.normal(0, 60, (2, 3)), {}, []
    for k, T in enumerate(poses):
        place, t = np.column_stack([rng.uniform(0, 100, (80, 2)), np.zeros(80)]), rng.uniform(-1, 1, 80)
        scanner = np.array([frames.make(np.eye(3), v) @ T @ T_flange_scanner for v in t[:, None] * velocity[k]])
        seen = np.array([frames.transform(frames.inverse(A), p) for A, p in zip(scanner, place, strict=True)])
        clouds[f"v{k}.ply"] = Cloud(seen, scalars={"time": t} if time else {})
        places.append(place)
    views = {"view": ["v0", "v1"], "cloud": list(clouds), **pose_columns(poses)}
    views |= dict(zip(columns, velocity.T, strict=True))
    write_session(folder / "s", SessionFiles("s", "mm", "eye_in_hand", views, clouds=clouds, exact=True))
    (folder / "x.json").write_text(json.dumps({"hand_eye": T_flange_scanner.tolist(), "length_unit": "mm"}))
    return read_placed_session(folder / "s", folder / "x.json"), velocity, places


def test_sweeps_are_put_together_by_the_flange_s_motion(tmp_path):
    placed, _, places = sweeps(tmp_path)
    for T, cloud, place in zip(placed.T_base_scanner, placed.clouds, places, strict=True):
        assert np.abs(frames.transform(T, cloud) - place).max() < 1e-3  # clouds hold seven digits


def test_errors_of_a_sweep_turn_about_the_flange_where_it_was(tmp_path):
    placed, _, _ = sweeps(tmp_path)
    scan = assemble_scans(placed)
    errors = PlacingErrors(placed.T_base_flange, placed.T_flange_scanner, np.outer(XI, XI))
    moved = list(errors.modes(scan, "hand_eye"))[-1][1]
    T = placed.T_base_scanner[scan.view]
    local = np.einsum("nji,nj->ni", T[:, :3, :3], scan.points - np.vstack(placed.carried) - T[:, :3, 3])
    truly = frames.transform(T @ frames.exp(XI), local[:, None])[:, 0] + np.vstack(placed.carried) - scan.points
    sign = np.sign((truly * moved).sum())
    assert np.abs(sign * moved - truly).max() < 1e-3 * np.abs(truly).max()


def test_a_sweep_without_times_is_refused(tmp_path):
    with pytest.raises(InputError, match="view v0 is a sweep, and the points of its cloud have no time; to fix"):
        sweeps(tmp_path, time=False)


def test_scanner_error_has_its_rms_along_the_ray(pane):
    """All modes together have the stated variance where the field is evenly seen."""
    grid = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 41), np.linspace(-0.2, 0.2, 41)), -1).reshape(-1, 2)
    flat = prepare_scan("", np.column_stack([400 * grid, np.full(len(grid), 400.0)]))
    scan = join_scans([flat], np.eye(4)[None] @ X)
    modes = [moved for _, moved in errors_of(np.eye(4)[None], scanner=0.01).modes(scan, "scanner")]
    variance = sum((moved**2).sum(axis=1).mean() for moved in modes)
    assert np.sqrt(variance) == pytest.approx(0.01, rel=0.1)
    ray = scan.points - X[:3, 3]
    assert all(np.abs(np.cross(moved, ray)).max() < 1e-9 for moved in modes)


def test_pose_answers_as_a_fit_of_the_misplaced_scans():
    """A block seen from all six sides; four views of three sides each."""
    block, rng = trimesh.creation.box((200.0, 150.0, 100.0)), np.random.default_rng(0)
    points = trimesh.sample.sample_surface(block, 12000, seed=1)[0]
    normals = np.zeros_like(points)
    side = np.abs(points / [100.0, 75.0, 50.0]).argmax(axis=1)
    normals[np.arange(len(points)), side] = np.sign(points[np.arange(len(points)), side])
    view = rng.integers(4, size=len(points))
    noisy = points + rng.normal(0, 0.02, (len(points), 1)) * normals
    T = np.array([frames.exp(np.append(rng.normal(0, 1, 3), rng.normal(0, 300, 3))) for _ in range(4)])
    T_base_flange, ones = T @ frames.inverse(X), np.ones(len(points))
    scan = JoinedScans(noisy, normals, ones > 0, ones, 2.0, 0.02, view)
    xi = 0.2 * XI
    errors = errors_of(T_base_flange, hand_eye=np.outer(xi, xi))
    cad = cad_surface(block)
    before = fit_cad(scan, cad, np.eye(4), errors=errors)
    local = frames.transform(frames.inverse(T)[view], noisy[:, None])[:, 0]
    misplaced = frames.transform((T @ frames.exp(xi))[view], local[:, None])[:, 0]
    after = fit_cad(replace(scan, points=misplaced), cad, np.eye(4))
    truly = frames.log(frames.inverse(before.T_base_part) @ after.T_base_part)
    assert np.sqrt(np.diag(before.parts["hand_eye"])) == pytest.approx(
        np.abs(truly), rel=0.1, abs=2e-7 + 0.03 * np.abs(truly[3:]).max()
    )
    assert before.covariance == pytest.approx(sum(before.parts[name] for name in ("scan", *SOURCES)))


def test_gap_and_flush_answer_as_a_measurement_of_the_misplaced_scans(pane):
    door = car_door.build(CarDoor(**DOOR))
    places = [values[:1] for values in window_views.stations(Pane(**DOOR))]
    clouds, poses = window_scans.scan_seam([door, pane], np.eye(4), tuple(places), 0.02, 1, rays=120)
    scans, station = [prepare_scan("", c) for c in clouds], Station("1", *(values[0] for values in places))
    T_base_flange = poses @ frames.inverse(X)
    scan = join_scans(scans, poses)
    (alone,) = measure_seam(scan, np.eye(4), [station], Limits())
    xi = 0.1 * XI  # well below the noise: further apart, the two views no longer share a surface
    errors = errors_of(T_base_flange, hand_eye=np.outer(xi, xi))
    (known,) = measure_seam(scan, np.eye(4), [station], Limits(), errors=errors)
    (moved,) = measure_seam(join_scans(scans, poses @ frames.exp(xi)), np.eye(4), [station], Limits())
    for name in ("gap", "flush"):
        wanted = abs(getattr(moved, name) - getattr(alone, name))
        added = np.sqrt(getattr(known, f"sigma_{name}") ** 2 - getattr(alone, f"sigma_{name}") ** 2)
        assert added == pytest.approx(wanted, rel=0.1, abs=2e-4)
    # Each flank is seen by one scan, both surfaces by both: what the scans are apart is in the gap, less in the flush.
    robot = errors_of(T_base_flange, translation=0.1 / np.sqrt(2))
    (apart,) = measure_seam(scan, np.eye(4), [station], Limits(), errors=robot)
    assert apart.sigma_gap == pytest.approx(np.hypot(alone.sigma_gap, 0.1), rel=0.3)
    assert apart.sigma_flush < 0.05
    # What the scans of one stop share is in neither.
    carriage = errors_of(T_base_flange, carriage=0.1, stop=np.zeros(len(poses), int))
    (alike,) = measure_seam(scan, np.eye(4), [station], Limits(), errors=carriage)
    assert max(alike.sigma_gap - alone.sigma_gap, alike.sigma_flush - alone.sigma_flush) < 0.01


def test_hand_eye_file_brings_its_errors(tmp_path):
    covariance = np.diag([1e-8] * 3 + [4e-10] * 3)
    run = {"hand_eye": np.eye(4).tolist(), "length_unit": "m", "hand_eye_covariance": covariance.tolist()}
    run["repeatability"] = {"rotation": 3e-5, "translation": 2e-5}
    (tmp_path / "result.json").write_text(json.dumps(run))
    _, errors = read_hand_eye(tmp_path / "result.json", "mm", np.eye(4)[None])
    assert np.sqrt(np.diag(errors.hand_eye)) == pytest.approx([1e-4] * 3 + [0.02] * 3)
    assert (errors.rotation, errors.translation) == pytest.approx((3e-5, 0.02))
    sphere = {"hand_eye": np.eye(4).tolist(), "length_unit": "mm", "scatter_of_views": {"shift": 0.04}}
    (tmp_path / "sphere.json").write_text(json.dumps(sphere))
    _, errors = read_hand_eye(tmp_path / "sphere.json", "mm", np.eye(4)[None])
    assert errors.translation == 0.04 and not errors.hand_eye.any()


def test_job_states_what_nobody_measured(tmp_path):
    placed = PlacedScans((), (), np.zeros((0, 4, 4)), X)
    assert stated_errors(JobTable(tmp_path, {}), placed) is None
    assert stated_errors(JobTable(tmp_path, {"errors": {"scanner": 0.02}}), placed).scanner == 0.02
    on_rail = replace(placed, columns=tuple({"rail_mm": at, "odd": 1.0} for at in (500.0, 0.0, 500.0)))
    table = {"carriage": 0.02, "carriage_column": "rail_mm"}
    errors = stated_errors(JobTable(tmp_path, {"errors": table}), on_rail)
    assert errors.carriage == 0.02 and errors.stop.tolist() == [1, 0, 1]
    with pytest.raises(InputError, match=r"carriage_column is 'rail'; to fix: write one of rail_mm, odd"):
        stated_errors(JobTable(tmp_path, {"errors": table | {"carriage_column": "rail"}}), on_rail)
    with pytest.raises(InputError, match=r"errors\.carriage is 0.02; to fix: leave it out"):
        stated_errors(JobTable(tmp_path, {"errors": table}), placed)
    with pytest.raises(InputError, match=r"errors\.scaner.*to fix: write 'scanner'"):
        stated_errors(JobTable(tmp_path, {"errors": {"scaner": 0.02}}), placed)
