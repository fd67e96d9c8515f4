"""Stock on a casting: blades grown facet by facet, scanned from all around; truth from the generator."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from data_synth.cells import window_scans
from data_synth.scanning import scan
from data_synth.shapes import build_shape
from data_synth.shapes.casting import around, with_stock
from stitch.cli.main import main
from stitch.errors import InputError, NoResultError
from stitch.numerics import frames
from stitch.plugins.cells.cad import TUKEY, biweight, cad_surface, cell_weights, nearest_partners
from stitch.plugins.cells.placed_scans import JoinedScans, join_scans
from stitch.plugins.cells.scan_to_cad import AllowancePrior, allowance_sentence, fit_cad, read_allowance
from stitch.session.scan import prepare_scan

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
    seen = nearest_partners(blade_cad, local, frames.rotate(T, usable.normals))
    d = seen.distance
    rest = d - found.allowance.value
    w = seen.accept * biweight(rest / (TUKEY * found.scale))
    w *= cell_weights(local, replace(seen, distance=rest), seen.accept, blade_cad.size / 40, found.scale)
    A = np.hstack([np.cross(local - blade_cad.centre, seen.normal), seen.normal])
    A, d = A - np.average(A, axis=0, weights=w), d - np.average(d, weights=w)
    step = -np.linalg.solve((A * w[:, None]).T @ A, (A * w[:, None]).T @ d)
    assert len(usable.points) < 20_000  # the fit took all of them
    assert np.abs(step / found.sigma).max() < 0.01
    total = np.average((seen.distance) ** 2, weights=w)
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


def test_the_command_refuses_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(tmp_path / "any.toml"), "--allowance", "much"])
    assert stop.value.code == 2
    shown = capsys.readouterr()
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
