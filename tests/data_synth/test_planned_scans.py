"""What planned scans of parts show: ranges by a second ray caster, spheres, overlaps, labelled points, line scans."""

from dataclasses import replace
from itertools import pairwise

import igl
import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares

from data_synth.fixtures.ideal_scanner import ranges
from data_synth.fixtures.quiet_scenes import clean, mesh_for, mesh_of, simulated, with_part
from data_synth.scanner import rays
from data_synth.scanning import cast
from stitch.numerics import frames


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


@pytest.mark.parametrize("radius", [12.0, 30.0])
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


@pytest.mark.parametrize("name", ["blade", "blade-table", "panel", "spheres", "drill-plate"])
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
