"""The simulated scanner: noise, edges, drop-outs and quantisation before plates and a step."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.stats import kstest, norm
from scipy.stats import t as t_distribution

from data_synth.fixtures.ideal_scanner import NO_FIELD, facing, flat_plate, ideal, ranges, step_part
from data_synth.scanner import Scanner, field_map, rays
from data_synth.scanning import cast, scan


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
