"""Laws of nature: amplitudes, joints, signs, and that each is drawn anew for every arm."""

from functools import cache

import numpy as np
import pytest

from data_synth import nature
from data_synth.fixtures.arm_sources import plain_product
from data_synth.fixtures.part_distance import EXACT, off_part
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.laws import points as point_laws
from data_synth.laws.brackets import GEOMETRY
from data_synth.moment import Plan
from data_synth.scanner import Cloud
from stitch.numerics import frames


@cache
def plan_of_the_blade() -> Plan:
    return simulated(clean("blade", rays=40, noise=0.0), {}, 11, 3).plan


@pytest.mark.parametrize("name", nature.LAWS)
def test_the_amplitude_scales_what_is_drawn(name):
    plan = plan_of_the_blade()
    once, twice = (nature.LAWS[name].draw(a, plan, np.random.default_rng(4)) for a in (1.0, 2.0))
    assert set(once) == set(twice) and once
    for parameter, value in once.items():
        # Times and views say when, places where, not how much.
        factor = 1.0 if parameter in ("T_c", "tau", "T", "v", *GEOMETRY) else 2.0
        assert twice[parameter] == pytest.approx(factor * value, rel=1e-12)


def test_joints_are_those_that_the_cell_can_show():
    plan = plan_of_the_blade()
    plan = Plan(plan.joints, plan.torque, plan.velocity, plan.arm, (3,))
    for name in ("joint_offset", "backlash", "gear_eccentricity", "gear_harmonic", "third_harmonic", "link_geometry"):
        drawn = nature.LAWS[name].draw(1.0, plan, np.random.default_rng(0))
        assert {p[-1] for p in drawn} == {"4"}


def test_laws_have_the_names_and_places_of_the_contract():
    places = {"points": 8, "base": 1, "joints": 10, "arm": 3, "mount": 6, "part": 4, "surface": 2}
    assert {place: sum(law.place == place for law in nature.LAWS.values()) for place in places} == places
    assert set(nature.SMALL) <= set(nature.LAWS)


def test_signs_at_the_sensor_by_hand():
    """A point straight ahead beyond the standoff, one at the side: where a person would expect them."""
    moment = type("M", (), {
        "standoff": 400.0, "covariates": {"scanner_temperature_c": 26.0, "humidity_percent": 50.0},
        "start": {"scanner_temperature_c": 24.0, "humidity_percent": 45.0},
    })()  # fmt: skip
    at = np.array([[0.0, 0.0, 500.0], [150.0, 200.0, 500.0]])
    cloud = Cloud(at, np.array([0.68, 0.32]), np.array([0.5, 1.0]))
    away = lambda law, p: np.linalg.norm(law(p, moment, cloud).points, axis=1) - np.linalg.norm(at, axis=1)  # noqa: E731
    r = np.linalg.norm(at[1])
    assert away(point_laws.range_scale, {"s": 1e-3}) == pytest.approx([0.5, 1e-3 * r])
    assert away(point_laws.scanner_thermal_scale, {"k": 1e-3}) == pytest.approx([1.0, 2e-3 * r])
    assert away(point_laws.range_nonlinearity, {"k": 2.0}) == pytest.approx([2 / 16, 2 * (r / 400 - 1) ** 2])
    assert away(point_laws.incidence_bias, {"b": 0.1}) == pytest.approx([0.1, 0.0], abs=1e-9)
    assert away(point_laws.intensity_bias, {"k": 0.1}) == pytest.approx([0.1, -0.1])
    assert away(point_laws.field_curvature, {"k": 2.0}) == pytest.approx([0.0, 2 * 0.25], abs=1e-9)
    assert away(point_laws.covariate_bias, {"k": 0.02}) == pytest.approx([0.1, 0.1])
    bent = point_laws.lens_distortion({"k1": 0.04}, moment, cloud).points
    assert bent == pytest.approx(np.array([[0, 0, 500], [150 * 1.01, 200 * 1.01, 500]]))


def test_latency_of_a_line_scanner():
    """Profiles assembled by the reported motion; the true arm is Δt further along."""
    for amplitude in (0.0, 1.0):
        cell = clean("line-sweep", rays=30, noise=0.0)
        measured = simulated(cell, {"latency": amplitude}, 2, 3)
        dt = measured.hidden["latency"]["dt"]
        assert dt == 2e-3 * amplitude
        for v, cloud in enumerate(measured.clouds):
            q, rate = measured.plan.joints[v], measured.plan.velocity[v]
            assert np.abs(rate).max() > 0
            y, naive = np.empty_like(cloud.points), np.empty_like(cloud.points)
            for time in np.unique(cloud.time):
                these = cloud.time == time
                reported = plain_product(cell.arm, q + rate * time) @ measured.T_mount
                at_view = plain_product(cell.arm, q) @ measured.T_mount
                true = plain_product(cell.arm, q + rate * (time + dt)) @ measured.T_mount
                profile = frames.transform(np.linalg.inv(reported) @ at_view, cloud.points[these])
                # In its own frame a profile is flat.
                assert np.abs(profile[:, 1]).max() < EXACT
                y[these] = frames.transform(np.linalg.inv(cell.T_reference_part) @ true, profile)
                naive[these] = frames.transform(np.linalg.inv(cell.T_reference_part) @ reported, profile)
            assert np.abs(off_part("line-sweep", y)[0]).max() < EXACT
            # 2 ms at 80 mm/s are 0.16 mm, along the sweep and whatever the direction.
            assert np.linalg.norm(y - naive, axis=1).mean() == pytest.approx(amplitude * 0.16, rel=0.1, abs=1e-9)


@pytest.mark.parametrize(
    "scene",
    ["blade", "blade-table", "panel", "spheres", pytest.param("car-door", marks=pytest.mark.slow), "drill-plate"],
)
def test_nothing_hidden_leaves_noise_alone(scene):
    """Clouds placed by the true poses: distances to the part over their sigma are a normal distribution."""
    cell = clean(scene, rays=40)
    measured = simulated(cell, {}, 3, 2)
    score = []
    for cloud, T in zip(measured.clouds, measured.T_reference_scanner, strict=True):
        y = frames.transform(frames.inverse(cell.T_reference_part) @ T, cloud.points)
        off, _ = off_part(scene, y)
        r = np.linalg.norm(cloud.points, axis=1)
        score.append(off / (cell.scanner.noise * (r / cell.scanner.standoff) ** 2 * cloud.incidence))
    z = np.concatenate(score)
    # Near an edge or in a fillet the nearest facet may be another one; the middle half of a distribution is safe.
    quartiles = np.quantile(z, [0.25, 0.5, 0.75])
    error = 1.36 / np.sqrt(len(z))  # standard error of a normal sample's quartile
    assert np.abs(quartiles - [-0.6745, 0.0, 0.6745]).max() < 5 * error
    assert np.abs(z).max() < 6
