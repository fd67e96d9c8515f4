"""Simulated scans: ranges by a second ray caster, noise, edges, drop-outs, spheres, overlaps, labelled points, lines."""

from dataclasses import replace
from itertools import pairwise

import igl
import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares
from scipy.stats import kstest, norm
from scipy.stats import t as t_distribution

from data_synth.fixtures.ideal_scanner import NO_FIELD, facing, flat_plate, ideal, ranges, step_part
from data_synth.fixtures.quiet_scenes import clean, mesh_for, mesh_of, simulated, with_part
from data_synth.scanner import Scanner, field_map, rays
from data_synth.scanning import cast, scan
from stitch.numerics import frames


def test_rays_cover_the_field_of_view():
    scanner = Scanner(columns=5, rows=3, field_of_view=40.0, field_of_view_y=20.0)
    d = rays(scanner)
    assert d.shape == (15, 3)
    assert np.degrees(np.arctan(d[:, 0].max())) == pytest.approx(20.0)
    assert np.degrees(np.arctan(d[:, 1].max())) == pytest.approx(10.0)
    assert (np.diff(d[:5, 0]) > 0).all() and d[0, 1] < d[-1, 1]


def test_backs_of_faces_are_not_seen():
    mesh = trimesh.creation.box([100.0, 100.0, 100.0])
    _, distance, _ = cast(mesh, np.eye(4), rays(ideal()))  # from inside
    assert not np.isfinite(distance).any()


def test_noise_is_as_set_and_grows_with_range_squared():
    scanner = ideal(noise=0.05, standoff=400.0, depth_of_field=1000.0, field_of_view=20.0)
    for distance in (300.0, 400.0, 600.0):
        for seed in (1, 2):
            cloud = scan(flat_plate(), facing(distance), scanner, NO_FIELD, np.random.default_rng(seed))
            r = ranges(cloud)
            z = (r - distance * r / cloud.points[:, 2]) / (r / 400.0) ** 2 / 0.05
            # Standard errors of mean and deviation of N normal numbers: 1/√N and 1/√2N.
            n = len(z)
            assert n == 3600
            assert abs(z.mean()) < 4 / np.sqrt(n) and abs(z.std() - 1) < 4 / np.sqrt(2 * n)


def test_heavy_tails_follow_students_t_of_the_same_variance():
    scanner = ideal(noise=0.05, standoff=400.0, tail=3.0, columns=100, rows=100)
    cloud = scan(flat_plate(), facing(400.0), scanner, NO_FIELD, np.random.default_rng(4))
    r = ranges(cloud)
    z = (r - 400.0 * r / cloud.points[:, 2]) / (r / 400.0) ** 2 / 0.05
    assert kstest(z * np.sqrt(3.0), t_distribution(3).cdf).pvalue > 1e-3
    assert kstest(z, norm.cdf).pvalue < 1e-6


def test_edge_bias_moves_two_pixels_beside_an_edge_and_no_other():
    scanner = ideal(columns=120, rows=120)
    true = scan(step_part(), facing(420.0), scanner, NO_FIELD, np.random.default_rng(0))
    biased = scan(step_part(), facing(420.0), replace(scanner, edge_bias=0.5), NO_FIELD, np.random.default_rng(0))
    moved = ranges(biased) - ranges(true)
    at_edge = moved > 1e-9
    assert np.allclose(moved[at_edge], 0.5) and np.allclose(moved[~at_edge], 0.0, atol=1e-9)
    assert 0.01 < at_edge.mean() < 0.3


def test_noise_lies_along_the_ray():
    scanner = ideal(noise=0.5, columns=30, rows=30)
    noisy = scan(flat_plate(), facing(420.0), scanner, NO_FIELD, np.random.default_rng(0))
    d = rays(scanner)
    assert np.allclose(noisy.points[:, :2] / noisy.points[:, 2:], d[:, :2], atol=1e-12)


def test_repeats_of_a_view_have_independent_noise():
    scanner = ideal(noise=0.05)
    a, b = (ranges(scan(flat_plate(), facing(420.0), scanner, NO_FIELD, np.random.default_rng(s))) for s in (1, 2))
    n = len(a)
    noise = 0.05 * (a.mean() / 420.0) ** 2
    assert (a - b).std() == pytest.approx(np.sqrt(2) * noise, rel=0.05)
    assert abs(np.corrcoef(a[1:] - b[1:], a[:-1] - b[:-1])[0, 1]) < 5 / np.sqrt(n)


@pytest.mark.parametrize("aspect", [None, 14.0])
def test_field_error_has_its_rms_and_is_smooth(aspect):
    scanner = ideal(field_error=0.01, field_of_view=30.0, field_of_view_y=aspect, columns=80, rows=80)
    values = []
    for seed in range(8):
        weights = field_map(scanner, np.random.default_rng(seed))
        cloud = scan(flat_plate(), facing(420.0), scanner, weights, np.random.default_rng(0))
        error = (ranges(cloud) - 420.0 * ranges(cloud) / cloud.points[:, 2]).reshape(80, 80)
        # Half a wave and a whole one over the field: at most 3 % of 2π·rms from a ray to the next.
        assert np.abs(np.diff(error, axis=1)).max() < 0.01
        # 80 samples of a cosine, ends included: the mean square is off by 1/80.
        assert np.sqrt((error**2).mean()) == pytest.approx(0.01, rel=0.04)
        values.append(error.ravel())
    # Another cell, another map.
    assert np.abs(np.corrcoef(values) - np.eye(8)).max() < 0.999


@pytest.mark.parametrize("step", [0.001, 0.25])
def test_quantisation(step):
    scanner = ideal(quantisation=step, noise=0.02)
    r = ranges(scan(flat_plate(20.0), facing(420.0), scanner, NO_FIELD, np.random.default_rng(0)))
    assert np.abs(r / step - np.round(r / step)).max() < 1e-6
    exact = ranges(
        scan(flat_plate(20.0), facing(420.0), replace(scanner, quantisation=0.0), NO_FIELD, np.random.default_rng(0))
    )
    assert np.abs(r - exact).max() <= step / 2 + 1e-9


def test_mixed_pixels_lie_between_front_and_back():
    scanner = ideal(mixed_pixels=1.0, columns=120, rows=120)
    mixed = scan(step_part(), facing(420.0), scanner, NO_FIELD, np.random.default_rng(0))
    height = 420.0 - mixed.points[:, 2]
    between = (height > 0.5) & (height < 39.5)
    assert (height > -1e-6).all() and (height < 40.0 + 1e-6).all()
    # Both upright edges of the block: 60 mm of the 209 mm that 120 rows see at the wall, 380 mm before the lens.
    expected = 2 * 60 / (2 * 380 * np.tan(np.radians(14))) * 119
    assert 0.8 * expected < between.sum() < 1.2 * expected
    few = scan(step_part(), facing(420.0), replace(scanner, mixed_pixels=0.3), NO_FIELD, np.random.default_rng(0))
    share = np.mean((few.points[:, 2] < 419.5) & (few.points[:, 2] > 380.5)) / between.mean()
    assert abs(share - 0.3) < 4 * np.sqrt(0.3 * 0.7 / between.sum())
    none = scan(step_part(), facing(420.0), replace(scanner, mixed_pixels=0.0), NO_FIELD, np.random.default_rng(0))
    assert not ((none.points[:, 2] < 419.5) & (none.points[:, 2] > 380.5)).any()


def test_grazing_surfaces_drop_out():
    """Nothing beyond 78°, everything up to where 1.5 times that cosine is reached, half way half of it."""
    limit = np.cos(np.radians(78.0))
    shares = {}
    for tilt in (0.0, 60.0, 70.0, 75.2, 77.0, 80.0):
        scanner = ideal(field_of_view=1.0, depth_of_field=800.0, columns=50, rows=50)
        cloud = scan(flat_plate(tilt), facing(420.0), scanner, NO_FIELD, np.random.default_rng(3))
        shares[tilt] = len(cloud.points) / 2500
    assert shares[0.0] == shares[60.0] == shares[70.0] == 1.0
    assert shares[80.0] == 0.0
    for tilt in (75.2, 77.0):
        expected = (np.cos(np.radians(tilt)) - limit) / (0.5 * limit)
        # Over the field of 1° the cosine changes by 4 % and with it the share, up and down alike.
        assert shares[tilt] == pytest.approx(expected, abs=4 * np.sqrt(0.25 / 2500) + 0.01)


def test_dark_places_drop_out_and_shine_less():
    scanner = ideal(dropout=0.5, columns=150, rows=150)
    every = scan(flat_plate(), facing(420.0), replace(scanner, dropout=0.0), NO_FIELD, np.random.default_rng(1))
    some = scan(flat_plate(), facing(420.0), scanner, NO_FIELD, np.random.default_rng(1))
    assert len(every.points) == 22500
    albedo = every.intensity / every.incidence * (ranges(every) / 420.0) ** 2
    assert 0.25 - 1e-9 <= albedo.min() < 0.45 and 0.8 < albedo.max() <= 1.0 + 1e-9
    expected = 1 - 0.5 * np.clip((0.5 - albedo) / 0.25, 0, 1)
    assert len(some.points) == pytest.approx(expected.sum(), abs=4 * np.sqrt((expected * (1 - expected)).sum()))


def test_depth_of_field_bounds_what_is_seen():
    scanner = ideal(depth_of_field=20.0)
    cloud = scan(flat_plate(45.0), facing(420.0), scanner, NO_FIELD, np.random.default_rng(0))
    assert np.abs(cloud.points[:, 2] - 420.0).max() < 10.0 and len(cloud.points) > 100
    assert len(scan(flat_plate(), facing(450.0), scanner, NO_FIELD, np.random.default_rng(0)).points) == 0


@pytest.mark.parametrize("name", ["blade", pytest.param("car-door", marks=pytest.mark.slow), "spheres"])
def test_ranges_agree_with_libigl(name):
    """Two ray casters; the second carries its rays in double precision through a tree of its own."""
    scene = clean(name, rays=50)
    mesh = mesh_of(name)
    measured = simulated(scene, {}, 1, 2)
    T = frames.inverse(scene.T_reference_part) @ measured.T_reference_scanner[0]
    directions = rays(scene.scanner)
    triangle, distance, cosine = cast(mesh, T, directions)
    unit = frames.rotate(T, directions / np.linalg.norm(directions, axis=1)[:, None])
    boxes, arrays = igl.AABB(), (np.array(mesh.vertices), np.array(mesh.faces))
    boxes.init(*arrays)
    struck, other, _ = boxes.intersect_ray_first(*arrays, np.tile(T[:3, 3], (len(unit), 1)), unit)
    other = np.where(struck >= 0, other, np.inf)
    both = np.isfinite(distance) & np.isfinite(other)
    # A ray that grazes an edge may miss it in one of the two.
    assert (np.isfinite(distance) != np.isfinite(other)).mean() < 2e-3
    slanted = both & (cosine > 0.1)
    assert slanted.sum() > 200
    off = np.abs(distance[slanted] - other[slanted])
    assert np.quantile(off, 0.99) < 2e-3 and np.median(off) < 2e-4
    # And with the planes of trimesh: the point lies in its triangle.
    places = T[:3, 3] + unit[slanted] * distance[slanted, None]
    corners = mesh.triangles[triangle[slanted]]
    inside = trimesh.triangles.points_to_barycentric(corners, places)
    assert np.quantile(np.abs(inside - np.clip(inside, 0, 1)), 0.99) < 1e-3


def fit_sphere(points: np.ndarray, sigma: np.ndarray, start: float) -> tuple[float, float]:
    """Radius and its standard error; residuals along the radius weighed by the noise across the surface."""

    def off(x):
        return (np.linalg.norm(points - x[:3], axis=1) - x[3]) / sigma

    found = least_squares(off, np.append(points.mean(axis=0) + np.array([0, 0, start / 2]), start), x_scale="jac")
    return found.x[3], np.sqrt(np.linalg.inv(found.jac.T @ found.jac)[3, 3])


@pytest.mark.parametrize("radius", [12.0, pytest.param(30.0, marks=pytest.mark.slow)])
def test_a_sphere_has_its_radius(radius):
    tolerance = 1e-3 * radius / 30
    scene = with_part(clean("blade", rays=110), "sphere", radius=radius, tolerance=tolerance)
    measured = simulated(scene, {}, 4, 3)
    found = []
    for cloud, T in zip(measured.clouds, measured.T_reference_scanner, strict=True):
        y = frames.transform(frames.inverse(scene.T_reference_part) @ T, cloud.points)
        near = (np.linalg.norm(y, axis=1) < radius + 0.5) & (y[:, 2] > -radius / 2)  # without the stem
        sigma = scene.scanner.noise * (ranges(cloud) / scene.scanner.standoff) ** 2 * cloud.incidence
        found.append(fit_sphere(cloud.points[near], sigma[near], radius))
    value, error = np.array(found).T
    assert (error < 0.02).all()
    # Facets leave the sphere by at most the tolerance, half of it outwards and half inwards.
    assert (np.abs(value - radius) < 4 * error + tolerance).all()


@pytest.mark.parametrize(
    "name", ["blade", "blade-table", "panel", "spheres", pytest.param("drill-plate", marks=pytest.mark.slow)]
)
def test_views_show_enough_and_overlap(name):
    scene = clean(name, rays=40)
    measured = simulated(scene, {}, 2, 4)
    mesh = mesh_of(name)
    seen = []
    for cloud, T in zip(measured.clouds, measured.T_reference_scanner, strict=True):
        T_part_scanner = frames.inverse(scene.T_reference_part) @ T
        _, distance, _ = cast(mesh, T_part_scanner, rays(scene.scanner))
        hits = np.isfinite(distance).sum()
        # No more points than rays that hit, and a planned view loses only what is out of depth or at a slant.
        assert 0.3 * hits < len(cloud.points) <= hits
        assert hits >= 0.5 * scene.plan.minimum_seen * 1600
        seen.append(frames.transform(T_part_scanner, cloud.points))
    # Neighbouring views show the same places: points of one within 1.5 ray spacings of points of the next.
    spacing = 2 * np.tan(np.radians(scene.scanner.field_of_view / 2)) * scene.scanner.standoff / 40
    for a, b in pairwise(seen):
        near = np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1) < 1.5 * spacing
        assert near.mean() > 0.25
    q = measured.plan.joints
    assert (q > scene.arm.lower).all() and (q < scene.arm.upper).all()


def test_share_of_rays_on_a_ball_is_its_solid_angle():
    """A ball of radius R at distance D covers π R²/(D² − R²) of a plane with z = 1, a little more off the axis."""
    scene = with_part(clean("blade", rays=100), "sphere", radius=40.0, tolerance=0.05, stem_length=1.0, foot_radius=6.1)
    scene = replace(scene, plan=replace(scene.plan, tilt=10.0, aim=2.0))
    measured = simulated(scene, {}, 5, 2)
    half = np.tan(np.radians(scene.scanner.field_of_view / 2))
    for T in measured.T_reference_scanner:
        T_part_scanner = frames.inverse(scene.T_reference_part) @ T
        _, distance, _ = cast(mesh_for(scene), T_part_scanner, rays(scene.scanner))
        D = np.linalg.norm(T_part_scanner[:3, 3])
        # 100 rays span 99 steps. Rays on the rim are counted or not: 1 % of 1100.
        expected = np.pi * 40**2 / (D**2 - 40**2) / (2 * half) ** 2 * 0.99**2
        # Stem and foot stick out by less than a tenth of the disc.
        assert expected * 0.98 < np.isfinite(distance).mean() < expected * 1.15


def test_labelled_points_lie_where_the_truth_has_them():
    scene = clean("spheres", rays=24)
    scene = replace(scene, scanner=replace(scene.scanner, field_of_view_y=20.0))
    measured = simulated(scene, {}, 1, 3)
    assert len(measured.labelled) == 5
    half = np.tan(np.radians([scene.scanner.field_of_view / 2, 10.0]))
    z, missing = [], 0
    for name, seen in measured.labelled.items():
        for v, T in enumerate(measured.T_reference_scanner):
            true = frames.transform(frames.inverse(T), measured.targets[name][None])[0]
            inside = (np.abs(true[:2]) < half * true[2]).all() and abs(true[2] - 300.0) < 130.0
            assert np.isfinite(seen[v]).all() == inside
            missing += not inside
            z.extend((seen[v] - true) / scene.part.sigma if inside else [])
    assert missing  # the field is narrow: some are not seen
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(z)))


def test_times_of_a_line_scanner_match_its_sweep():
    scene = clean("line-sweep", rays=40, noise=0.0)
    measured = simulated(scene, {}, 1, 2)
    tool = scene.scanner
    for cloud in measured.clouds:
        duration = tool.sweep / tool.speed
        assert np.abs(cloud.time).max() <= duration / 2
        step = duration / tool.rows
        assert np.allclose(cloud.time / step - 0.5, np.round(cloud.time / step - 0.5), atol=1e-6)
        # In the view's frame a profile lies in a plane of y that moves at the speed of the sweep, one way or the other.
        ways = np.polyfit(cloud.time, cloud.points[:, 1], 1)[0]
        assert abs(ways) == pytest.approx(tool.speed, rel=0.02)
        assert np.abs(cloud.points[:, 1] - ways * cloud.time).max() < 0.02 * tool.sweep


def test_a_line_scan_of_a_still_cell_lies_on_the_part():
    scene = clean("line-sweep", rays=60)
    measured = simulated(scene, {}, 1, 2)
    mesh = mesh_of("line-sweep")
    for cloud, T in zip(measured.clouds, measured.T_reference_scanner, strict=True):
        y = frames.transform(frames.inverse(scene.T_reference_part) @ T, cloud.points)
        _, face, _ = igl.point_mesh_squared_distance(y, np.array(mesh.vertices), np.array(mesh.faces))
        off = np.einsum("ij,ij->i", y - mesh.triangles[face, 0], mesh.face_normals[face])
        # Depth, not range, sets the least noise: rays slant by at most 20°, 1/cos² of it.
        sigma = scene.scanner.noise * (np.linalg.norm(cloud.points, axis=1) / scene.scanner.standoff) ** 2
        z = off / (sigma * cloud.incidence)
        assert len(z) > 300
        # Ranges count from the view's place, not from the profile's: over half a sweep that is 5 % of the noise.
        assert np.quantile(np.abs(z), 0.5) == pytest.approx(0.6745, abs=5 * 0.79 / np.sqrt(len(z)) + 0.07)
        assert np.abs(z).max() < 6
