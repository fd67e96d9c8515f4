"""Every law of nature against its formula, written out here a second time: undone, the cloud lies on the part.

Laws of nature: amplitudes, joints, signs, and that each is drawn anew for every arm.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_synth import nature
from data_synth.fixtures.arm_sources import plain_product, second_source
from data_synth.fixtures.part_distance import EXACT, off_part
from data_synth.fixtures.quiet_scenes import clean, mesh_of, simulated
from data_synth.kinematics import GRAVITY
from data_synth.laws import points as point_laws
from data_synth.laws.brackets import GEOMETRY
from data_synth.moment import Plan
from data_synth.scanner import Cloud
from data_synth.simulate import Measured
from stitch.numerics import frames
from stitch.session import robot

VIEWS = 3
HOUR = 3600.0
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")


@cache
def measured_with(name: str | None, amplitude: float = 1.0, scene: str = "blade", noise: float = 0.0) -> Measured:
    cell = clean(scene, rays=40, noise=noise)
    return simulated(cell, {name: amplitude} if name else {}, 11, VIEWS)


def number(p: dict[str, float], letter: str, n: int) -> np.ndarray:
    return np.array([p.get(f"{letter}{i + 1}", 0.0) for i in range(n)])


def twist(p: dict[str, float], share: float = 1.0) -> np.ndarray:
    return frames.exp(share * np.array([p[k] for k in TWIST]))


def beam(p: dict[str, float], down: np.ndarray) -> np.ndarray:
    """(4, 4) displacement of what sits at the end of a uniform beam: force F at the end gives the slope L²/2EI and the
    deflection L³/3EI, a moment there L/EI and L²/2EI."""
    end, load, weak = (np.array([p[f"{name}_{axis}"] for axis in "xyz"]) for name in ("end", "load", "weak"))
    length = np.linalg.norm(end)
    z = end / length
    axes = np.column_stack([weak, np.cross(z, weak), z])
    soft = axes @ np.diag([p["bend_weak"], p["bend_strong"], p["twist"]]) @ axes.T
    force, moment = soft @ np.cross(z, down), soft @ np.cross(load, down)
    slope = length**2 / 2 * force + length * moment
    moved = np.cross(length**3 / 3 * force + length**2 / 2 * moment, z)
    return frames.exp(np.concatenate([slope, moved - np.cross(slope, end)]))


def undone(name: str | None, measured: Measured, v: int) -> np.ndarray:
    """Points of one view in the part frame, by the formulas of EFFECTS.md backwards."""
    p = measured.hidden.get(name, {})
    scene, cloud, t = measured.scene, measured.clouds[v], measured.times[v]
    n = scene.arm.joints
    here, start = ({k: c[i] for k, c in measured.covariates.items()} for i in (v, 0))
    warmer = {k: here[k] - start[k] for k in here}
    # sensor
    x, r0 = cloud.points, scene.scanner.standoff
    if name == "range_scale":
        x = x / (1 + p["s"])
    elif name == "scanner_thermal_scale":
        x = x / (1 + p["k"] * warmer["scanner_temperature_c"])
    elif name == "lens_distortion":
        true = x.copy()
        for _ in range(6):  # (a, b)(1 + k₁ρ²) has no closed inverse
            rho2 = (true[:, 0] ** 2 + true[:, 1] ** 2) / true[:, 2] ** 2
            true = x / np.column_stack([1 + p["k1"] * rho2, 1 + p["k1"] * rho2, np.ones(len(x))])
        x = true
    elif name in ("range_nonlinearity", "intensity_bias", "field_curvature", "covariate_bias"):
        u, r = x / np.linalg.norm(x, axis=1)[:, None], np.linalg.norm(x, axis=1)
        rho2 = (u[:, 0] / u[:, 2]) ** 2 + (u[:, 1] / u[:, 2]) ** 2
        true = r
        for _ in range(6):
            shift = {
                "range_nonlinearity": p["k"] * (true / r0 - 1) ** 2 if name == "range_nonlinearity" else 0,
                "intensity_bias": p["k"] * (cloud.intensity - 0.5) / 0.18,
                "field_curvature": p["k"] * rho2,
                "covariate_bias": p["k"] * warmer["humidity_percent"],
            }[name]
            true = r - shift
        x = u * np.reshape(true, (-1, 1))
    # arm and joints
    q = measured.plan.joints[v].copy()
    before = measured.plan.joints[max(v - 1, 0)]
    arm = scene.arm
    if name == "joint_offset":
        q = q + number(p, "d", n)
    elif name == "joint_compliance":
        q = q + number(p, "c", n) * robot.gravity_torques(second_source(arm), q)
    elif name in ("gear_eccentricity", "gear_harmonic", "third_harmonic"):
        k = {"gear_eccentricity": 1, "gear_harmonic": 2, "third_harmonic": 3}[name]
        q = q + number(p, "A", n) * np.sin(k * q) + number(p, "B", n) * np.cos(k * q)
    elif name == "joint_thermal":
        q = q + number(p, "k", n) * warmer["robot_temperature_c"]
    elif name == "joint_step" and v >= p["v"]:
        q = q + number(p, "d", n)
    elif name == "backlash":
        q = q - number(p, "b", n) * np.sign(q - before)
    elif name == "settling":
        q = q + number(p, "s", n) * (q - before)
    elif name == "link_geometry":
        arm = replace(
            arm, a=arm.a + number(p, "da", n), d=arm.d + number(p, "dd", n), alpha=arm.alpha + number(p, "dalpha", n)
        )
    elif name in ("robot_thermal_growth", "link_thermal"):
        growth = 1 + (p.get("g") or number(p, "g", n)) * warmer["robot_temperature_c"]
        arm = replace(arm, a=arm.a * growth, d=arm.d * growth)
    # mount
    mount = measured.T_mount
    if name == "mount_drift":
        mount = mount @ twist(p, t / HOUR)
    elif name == "mount_warmup":
        mount = mount @ twist(p, 1 - np.exp(-t / p["T_c"]))
    elif name == "mount_creep":
        mount = mount @ twist(p, np.log(1 + t / p["tau"]))
    elif name == "mount_step" and v >= p["v"]:
        mount = mount @ twist(p)
    T_flange = plain_product(arm, q)
    if name == "base_compliance":
        source = second_source(arm)
        of_kg = robot.base_moments(source, measured.plan.joints[v])
        moment = np.append(source.mass, source.payload_mass) @ of_kg
        T_flange = frames.exp(np.array([p["c_x"] * moment[0], p["c_y"] * moment[1], 0, 0, 0, 0])) @ T_flange
    down = GRAVITY / np.linalg.norm(GRAVITY)
    in_flange = np.linalg.inv(plain_product(scene.arm, measured.plan.joints[v]))[:3, :3] @ down
    if name in ("mount_droop", "mount_bend"):
        mount = beam(p, down if scene.mount == "eye_to_hand" else in_flange) @ mount
    T = (np.linalg.inv(T_flange) if scene.mount == "eye_to_hand" else T_flange) @ mount
    # part
    T_part = scene.T_reference_part
    if name == "fixture_drift":
        T_part = twist(p, t / HOUR) @ T_part
    elif name in ("fixture_droop", "fixture_bend"):
        T_part = beam(p, in_flange if scene.mount == "eye_to_hand" else down) @ T_part
    elif name == "part_slip" and v >= p["v"]:
        T_part = twist(p) @ T_part
    T_part_scanner = np.linalg.inv(T_part) @ T
    if name == "incidence_bias":
        u = x / np.linalg.norm(x, axis=1)[:, None]
        scale = 1.0
        for _ in range(3):
            _, normal = off_part(scene.name, frames.transform(T_part_scanner, x * np.reshape(scale, (-1, 1))))
            cosine = -np.einsum("ij,ij->i", normal, u @ T_part_scanner[:3, :3].T)
            r = np.linalg.norm(x, axis=1)
            scale = (r - p["b"] * (1 / cosine - 1)) / r
        x = x * scale[:, None]
    y = frames.transform(T_part_scanner, x)
    if name == "part_growth":
        y = y / (1 + p["g"] * warmer["part_temperature_c"])
    elif name == "part_sag":
        down = scene.T_reference_part[:3, :3].T @ (in_flange if scene.mount == "eye_to_hand" else down)
        h = y[:, 2]
        for _ in range(3):  # h is the height before sagging
            h = (y - p["kappa"] * h[:, None] ** 2 * down)[:, 2]
        y = y - p["kappa"] * h[:, None] ** 2 * down
    return y


def chord() -> float:
    """How far a parabola κh² leaves its chord over the tallest edge of the blade's facets: facets stay flat."""
    mesh = mesh_of("blade")
    tallest = np.abs(np.diff(mesh.vertices[mesh.edges_unique][..., 2], axis=1)).max()
    return float(3e-6 * tallest**2 / 4) + EXACT


def check_on_part(name: str | None, scene: str, tolerance: float) -> None:
    measured, still = measured_with(name, scene=scene), measured_with(None, scene=scene)
    shifts = []
    for v in range(VIEWS):
        y = undone(name, measured, v)
        assert len(y) > 50
        off = np.abs(off_part(scene, y)[0])
        if name == "incidence_bias":
            # The undoing takes the incidence of the nearest facet, at the blade's edges it may be a neighbour's.
            assert np.quantile(off, 0.9) < tolerance and off.max() < 0.05
        else:
            assert off.max() < tolerance, f"view {v}"
        # Where the cloud would lie if nobody knew of the law.
        naive = undone(None, replace(measured, hidden={}), v)
        shifts.append(np.linalg.norm(naive - y, axis=1))
        assert len(still.clouds[v].points) == pytest.approx(len(y), rel=0.1)
    size = np.sqrt(np.mean(np.concatenate(shifts) ** 2))
    if name:
        # "Around a tenth of a millimetre": a decade to either side, common shifts of all views included.
        assert 0.01 < size < 1.0, f"{name} moves points by {size:.3f} mm"


# An area scanner stands still while it looks: latency needs the line scanner, below.
STILL = [name for name in nature.LAWS if name != "latency"]


@pytest.mark.parametrize("name", [None, *STILL])
def test_undone_by_its_formula_the_cloud_lies_on_the_part(name):
    check_on_part(name, "blade", chord() if name == "part_sag" else EXACT)


@pytest.mark.parametrize(
    "name",
    ["base_compliance", "joint_compliance", "mount_drift", "mount_droop", "mount_bend", "fixture_drift", "part_sag"],
)
def test_the_same_with_the_scanner_on_the_arm(name):
    check_on_part(name, "blade-table", chord() if name == "part_sag" else EXACT)


def test_amplitude_zero_changes_nothing():
    """All laws at once: none may leave a trace."""
    none = measured_with(None)
    zero = simulated(clean("blade", rays=40, noise=0.0), dict.fromkeys(nature.LAWS, 0.0), 11, VIEWS)
    assert set(zero.hidden) == set(nature.LAWS)
    for a, b in zip(none.clouds, zero.clouds, strict=True):
        assert np.allclose(a.points, b.points, atol=1e-9)
        assert np.allclose(a.intensity, b.intensity, atol=1e-9)
    assert np.allclose(none.T_reference_scanner, zero.T_reference_scanner, atol=1e-12)


@pytest.mark.parametrize(
    "name",
    [
        "range_scale",
        pytest.param("part_growth", marks=pytest.mark.slow),
        "part_sag",
        "part_slip",
        "fixture_drift",
        "mount_drift",
    ],
)
def test_labelled_points_follow_the_laws_too(name):
    """Centres of spheres move with the part and are reported through the scanner, as the cloud is."""
    scene = clean("spheres", rays=24, noise=0.0)
    scene = replace(scene, part=replace(scene.part, sigma=0.0))
    measured = simulated(scene, {name: 3.0}, 1, 3)
    p = measured.hidden[name]
    down = scene.T_reference_part[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    compared = 0
    for target, seen in measured.labelled.items():
        for v, T in enumerate(measured.T_reference_scanner):
            place = frames.transform(frames.inverse(scene.T_reference_part), measured.targets[target][None])[0]
            T_part, factor = scene.T_reference_part, 1.0
            if name == "part_growth":
                course = measured.covariates["part_temperature_c"]
                place = place * (1 + p["g"] * (course[v] - course[0]))
            elif name == "part_sag":
                place = place + p["kappa"] * place[2] ** 2 * down
            elif name == "part_slip" and v >= p["v"]:
                T_part = twist(p) @ T_part
            elif name == "fixture_drift":
                T_part = twist(p, measured.times[v] / HOUR) @ T_part
            elif name == "range_scale":
                factor = 1 + p["s"]
            expected = factor * frames.transform(frames.inverse(T) @ T_part, place[None])[0]
            if np.isfinite(seen[v]).all():
                compared += 1
                assert seen[v] == pytest.approx(expected, abs=1e-9)
    assert compared > 8


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
    [
        "blade",
        "blade-table",
        "panel",
        "spheres",
        pytest.param("car-door", marks=pytest.mark.slow),
        pytest.param("drill-plate", marks=pytest.mark.slow),
    ],
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
