"""The library of physical effects, in the order of the chain of frames.

First the arm: its base tilts, and effects give the true joint angles q* and the true links. Then the scanner's mount,
which truly is M·exp(twist), and the part, which creeps, slips, grows or sags in the reference frame. Then the scanner,
which reports a point that is at x*; a tracker or its probe has none of these. Last what holds scanner or part and gives
way under its weight, as it is turned against gravity.

Candidates are tried and listed in this order.
"""

from dataclasses import replace

import numpy as np

from stitch.effects.contract import (
    effect,
    event,
    number,
    offset,
    per_joint,
    per_moment,
    per_torque,
    temperature,
    twist,
    vector,
)
from stitch.numerics.frames import Array
from stitch.session.measurement import TEMPERATURES, ScanView, Views
from stitch.session.robot import Links

# A steel bracket of 30 N bends by 0.1 to 0.5 mrad and 0.02 to 0.1 mm; a sheet of metal is five times as soft.
_SHIFT = number("mm", typical=0.05, limit=2.0)
_TILT = vector("rad", typical=2e-4, limit=0.01)
_UNEVEN = offset("rad", typical=1e-4, limit=0.01, axes=("xx", "yy", "xy", "xz", "yz"))
# Belief beside an effect that any arm, mount or part has: a judgement, which decides only where views hardly do. A base
# that tilts and joints that follow a temperature are met less often than gears and springs; lost counts, and a link
# that grows without the others, seldom. What is
# like a usual effect in most sessions is that one, at less than 1 to 20: creep over an hour is like a scanner that
# warms up, which every scanner does, and an oblique bracket like one that stands straight.
_RARE, _SELDOM, _ALIKE = 0.3, 0.1, 0.04
_BENT = vector("mm", typical=0.05, limit=2.0, axes=("_xx", "_yy", "_zz", "_xy", "_xz", "_yz"))


@effect("base", needs=("moment",), prior=_RARE, c=per_moment("rad/(N m)", typical=5e-7, limit=2e-5))
def base_compliance(views: Views, c: Array) -> Array:
    """the base tilts by c times the moment of arm and load about its own axes"""
    return views.tilt(c)


@effect("robot", needs=("velocity",), dt=number("s", typical=2e-3, limit=0.5))
def latency(joints: Array, views: Views, dt: float) -> Array:
    """q* = q + q̇ Δt: pose taken at t, scan at t+Δt"""
    assert views.velocity is not None
    return joints + views.velocity * dt


@effect("robot", needs=("joints",), d=per_joint("rad", typical=1e-3, limit=0.02))
def joint_offset(joints: Array, views: Views, d: Array) -> Array:
    """q* = q + δ"""
    return joints + d


@effect(
    "links",
    needs=("joints",),
    da=per_joint("mm", 0.3, 5.0),
    dd=per_joint("mm", 0.3, 5.0),
    dalpha=per_joint("rad", 6e-4, 0.02),
)
def link_geometry(links: Links, views: Views, da: Array, dd: Array, dalpha: Array) -> Links:
    """DH a, d, α off by Δ"""
    return replace(links, da=links.da + da, dd=links.dd + dd, dalpha=links.dalpha + dalpha)


@effect("robot", needs=("torque",), c=per_torque("rad/(N m)", typical=5e-6, limit=2e-4))
def joint_compliance(joints: Array, views: Views, c: Array) -> Array:
    """q*_i = q_i + c_i τ_i(q), τ the gravity torque or the measured one"""
    return joints + views.sag(c)


@effect("robot", needs=("joints",), A=per_joint("rad", 4e-4, 0.01), B=per_joint("rad", 4e-4, 0.01))
def gear_eccentricity(joints: Array, views: Views, A: Array, B: Array) -> Array:
    """q*_i = q_i + A_i sin q_i + B_i cos q_i"""
    return joints + A * np.sin(views.joints) + B * np.cos(views.joints)


@effect("robot", needs=("joints",), A=per_joint("rad", 4e-4, 0.01), B=per_joint("rad", 4e-4, 0.01))
def gear_harmonic(joints: Array, views: Views, A: Array, B: Array) -> Array:
    """q*_i = q_i + A_i sin 2q_i + B_i cos 2q_i"""
    return joints + A * np.sin(2 * views.joints) + B * np.cos(2 * views.joints)


@effect("robot", needs=("joints",), b=per_joint("rad", 3e-4, 0.005))
def backlash(joints: Array, views: Views, b: Array) -> Array:
    """q*_i = q_i − b_i·approach_i"""
    return joints - b * views.approach


@effect("robot", needs=("joints",), s=per_joint("1", 5e-4, 0.02))
def settling(joints: Array, views: Views, s: Array) -> Array:
    """q*_i = q_i + s_i·(q_i − q_i of the previous row)"""
    return joints + s * (views.joints - views.previous)


@effect("robot", needs=("joints", "temperature"), prior=_RARE, k=per_joint("rad/°C", 5e-5, 2e-3), T=temperature())
def joint_thermal(joints: Array, views: Views, k: Array, T: float) -> Array:
    """q*_i = q_i + k_i·(T−T₀), T one of the temperatures that were measured"""
    return joints + np.outer(views.since_first(TEMPERATURES[round(T)]), k)


@effect("robot", needs=("joints",), prior=_SELDOM, d=per_joint("rad", 5e-4, 0.02), v=event())
def joint_step(joints: Array, views: Views, d: Array, v: float) -> Array:
    """q*_i = q_i + d_i from view v on (counted from 0), one joint"""
    return joints + np.outer(views.number >= v, d)


@effect("links", needs=("joints", "temperature"), prior=_SELDOM, g=per_joint("1/°C", 2e-5, 2e-4), T=temperature())
def link_thermal(links: Links, views: Views, g: Array, T: float) -> Links:
    """DH lengths of row i ×(1+g_i·(T−T₀)), T one of the temperatures that were measured"""
    return replace(links, lengths=links.lengths * (1 + np.outer(views.since_first(TEMPERATURES[round(T)]), g)))


@effect("links", needs=("joints",), prefers=("robot_temperature_c",), g=number("1/°C", typical=2e-5, limit=2e-4))
def robot_thermal_growth(links: Links, views: Views, g: float) -> Links:
    """DH lengths ×(1+g·ΔT), ΔT from robot_temperature_c; without it g per hour"""
    return replace(links, scale=links.scale * (1 + g * warmer(views, "robot_temperature_c")))


def warmer(views: Views, covariate: str) -> Array:
    """Return a temperature (V,) less that of the first view, °C; hours since then where it was not measured."""
    return views.since_first(covariate) if covariate in views.covariates else views.hours


@effect("mount", needs=("time",), xi=twist("/h", 1e-3, 0.4))
def mount_drift(views: Views, xi: Array) -> Array:
    """M·exp(ξ (t−t₀)/3600 s)"""
    return np.outer(views.hours, xi)


@effect(
    "mount",
    needs=("time",),
    xi=twist("", 6e-4, 0.2),
    T_c=number("s", typical=600.0, limit=1e5, grid=(150.0, 300.0, 600.0, 1200.0)),
)
def mount_warmup(views: Views, xi: Array, T_c: float) -> Array:
    """M·exp(ξ (1−e^(−(t−t₀)/T_c)))"""
    return np.outer(1 - np.exp(-views.time / max(T_c, 1.0)), xi)


@effect(
    "mount",
    needs=("time",),
    prior=_ALIKE,
    xi=twist("", 2e-4, 0.07),
    tau=number("s", 60.0, 1e5, grid=(10.0, 60.0, 300.0)),
)
def mount_creep(views: Views, xi: Array, tau: float) -> Array:
    """M·exp(ξ log(1+(t−t₀)/τ))"""
    return np.outer(np.log1p(views.time / max(tau, 1.0)), xi)


@effect("mount", prior=_RARE, xi=twist("", 6e-4, 0.2), v=event())
def mount_step(views: Views, xi: Array, v: float) -> Array:
    """M·exp(ξ) from view v on (counted from 0)"""
    return np.outer(views.number >= v, xi)


@effect("part", needs=("time",), xi=twist("/h", 1e-3, 0.4))
def fixture_drift(views: Views, xi: Array) -> Array:
    """exp(ξ (t−t₀)/3600 s) in the reference frame"""
    return np.outer(views.hours, xi)


@effect("part", xi=twist("", 6e-4, 0.2), v=event())
def part_slip(views: Views, xi: Array, v: float) -> Array:
    """from view v on (counted from 0), the part sits displaced by ξ"""
    return np.outer(views.number >= v, xi)


@effect(
    "shape",
    prefers=("part_temperature_c",),
    g=number("1/°C", typical=3e-5, limit=5e-4),
    c=offset("mm/°C", typical=3e-3, limit=0.2),
)
def part_growth(points: Array, view: ScanView, g: float, c: Array) -> Array:
    """x = x* + ((x*−o)·g + c)·ΔT, o the flange or the middle of the scans; ΔT of part_temperature_c, else hours

    The point o − c/g stands still: a part is seldom clamped exactly at o.
    """
    return points + ((points - view.origin) * g + c) * float(warmer(view.views, "part_temperature_c")[view.index])


@effect("shape", kappa=number("1/mm", typical=5e-6, limit=1e-3))
def part_sag(points: Array, view: ScanView, kappa: float) -> Array:
    """point at distance h from the clamp plane (part z=0) moves κ·h² along gravity"""
    return points + kappa * points[:, 2:] ** 2 * view.gravity


@effect("sensor", needs=("optics",), s=number("1", typical=1e-3, limit=0.02))
def range_scale(points: Array, view: ScanView, s: float) -> Array:
    """x = (1+s) x*"""
    return points * (1 + s)


@effect("sensor", needs=("optics",), k=number("mm", typical=5.0, limit=100.0), s=offset("mm", 0.5, 10.0, axes=("",)))
def range_nonlinearity(points: Array, view: ScanView, k: float, s: Array) -> Array:
    """x = x* + u·(k·d² + s·d), d = r/r₀−1, r₀ the standoff: right at d = −s/2k, which need not be the standoff"""
    away = view.away(points)
    r = np.sqrt(np.einsum("ij,ij->i", away, away))
    d = r / view.views.standoff - 1
    return points + away * ((k * d**2 + s * d) / r)[:, None]


@effect("sensor", needs=("surfaces",), b=number("mm", typical=0.1, limit=1.0))
def incidence_bias(points: Array, view: ScanView, b: float) -> Array:
    """x = x* + u·b·(1/cos α − 1)"""
    return points + view.along(points) * (b * (1 / view.cosine - 1))[:, None]


@effect("sensor", needs=("intensity", "surfaces"), k=number("mm", typical=0.1, limit=1.0))
def intensity_bias(points: Array, view: ScanView, k: float) -> Array:
    """x = x* + u·k·(I−Ī)/σ_I"""
    assert view.intensity is not None
    return points + view.along(points) * (k * view.intensity)[:, None]


@effect("sensor", needs=("optics",), k=number("mm", typical=5.0, limit=100.0))
def field_curvature(points: Array, view: ScanView, k: float) -> Array:
    """x = x* + u·k·ρ²"""
    return points + view.along(points) * (k * view.rho2(points))[:, None]


@effect("sensor", needs=("optics",), k1=number("1", typical=0.05, limit=1.0))
def lens_distortion(points: Array, view: ScanView, k1: float) -> Array:
    """(a,b) → (a,b)(1+k₁ρ²), z kept"""
    out = points.copy()
    out[:, :2] *= (1 + k1 * view.rho2(points))[:, None]
    return out


@effect("sensor", needs=("scanner_temperature_c", "optics"), k=number("1/°C", typical=2e-4, limit=5e-3))
def scanner_thermal_scale(points: Array, view: ScanView, k: float) -> Array:
    """x = (1+k(T−T₀)) x*, T = scanner_temperature_c"""
    return points * (1 + k * view.since_first("scanner_temperature_c"))


@effect("mount", needs=("gravity_at_mount",), s=_SHIFT, w=_TILT, a=_UNEVEN)
def mount_droop(views: Views, s: float, w: Array, a: Array) -> Array:
    """M tilts by w×g + A·g and moves by s·(g_x, g_y, 0), g the direction of gravity less z, flange frame

    A is symmetric without a trace: a bracket that is stiffer about one axis than about another has one.
    """
    return views.at_scanner(_droop(views.gravity_at_mount, s, w, a))


@effect("part", needs=("gravity_at_part",), s=_SHIFT, w=_TILT, a=_UNEVEN)
def fixture_droop(views: Views, s: float, w: Array, a: Array) -> Array:
    """the part tilts by w×g + A·g and moves by s·(g_x, g_y, 0), g the direction of gravity less z, flange frame"""
    return _droop(views.gravity_at_part, s, w, a)


@effect("mount", needs=("gravity_at_mount",), prior=_ALIKE, S=_BENT, w=_TILT, a=_UNEVEN)
def mount_bend(views: Views, S: Array, w: Array, a: Array) -> Array:
    """M tilts by w×g + A·g and moves by S·g, S symmetric, g the direction of gravity less z, flange frame"""
    return views.at_scanner(_bend(views.gravity_at_mount, S, w, a))


@effect("part", needs=("gravity_at_part",), prior=_ALIKE, S=_BENT, w=_TILT, a=_UNEVEN)
def fixture_bend(views: Views, S: Array, w: Array, a: Array) -> Array:
    """the part tilts by w×g + A·g and moves by S·g, S symmetric, g the direction of gravity less z, flange frame"""
    return _bend(views.gravity_at_part, S, w, a)


def _droop(gravity: Array, s: float, w: Array, a: Array) -> Array:
    """Return `_bend` of a bracket along the flange's axis, as soft to all sides of it."""
    return _bend(gravity, np.array([s, s, 0.0, 0.0, 0.0, 0.0]), w, a)


def _bend(gravity: Array, S: Array, w: Array, a: Array) -> Array:
    """Return twists (V, 6) of a fixture under its load, about the flange's origin and in the flange frame.

    Elastic deflections are linear in the direction of gravity g: rotation w×δ + A·δ, translation S·δ, with δ = g − z.
    A, symmetric, has no trace, since a rotation K·(d×g) by a weight at lever d, K symmetric, has none. Counted from
    g = z, the flange looking down, the deflection is zero there: so the hand-eye is that of a usual pose.

    Args:
        gravity: (V, 3) unit vectors g, flange frame.
        S: (6,) length_unit: xx, yy, zz, xy, xz, yz.
        w: (3,) rad.
        a: (5,) rad, of A: xx, yy, xy, xz, yz.
    """
    turned = gravity - [0.0, 0.0, 1.0]
    tilt = _symmetric(a[0], a[1], -a[0] - a[1], *a[2:])
    return np.hstack([np.cross(w, turned) + turned @ tilt, turned @ _symmetric(*S)])


def _symmetric(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> Array:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
