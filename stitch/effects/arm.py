"""Effects of the arm: the true joint angles q* and the true links."""

from dataclasses import replace

import numpy as np

from stitch.effects.contract import effect
from stitch.effects.specs import number, per_joint, per_torque
from stitch.frames import Array
from stitch.measurement.imperfect_arm import Links
from stitch.measurement.views import Views


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
    """q*_i = q_i + c_i τ_i(q), τ the gravity torque"""
    return joints + views.sag(c)


@effect("robot", needs=("joints",), A=per_joint("rad", 4e-4, 0.01), B=per_joint("rad", 4e-4, 0.01))
def gear_eccentricity(joints: Array, views: Views, A: Array, B: Array) -> Array:
    """q*_i = q_i + A_i sin q_i + B_i cos q_i"""
    return np.asarray(joints + A * np.sin(views.joints) + B * np.cos(views.joints))


@effect("robot", needs=("joints",), A=per_joint("rad", 4e-4, 0.01), B=per_joint("rad", 4e-4, 0.01))
def gear_harmonic(joints: Array, views: Views, A: Array, B: Array) -> Array:
    """q*_i = q_i + A_i sin 2q_i + B_i cos 2q_i"""
    return np.asarray(joints + A * np.sin(2 * views.joints) + B * np.cos(2 * views.joints))


@effect("robot", needs=("joints",), b=per_joint("rad", 3e-4, 0.005))
def backlash(joints: Array, views: Views, b: Array) -> Array:
    """q*_i = q_i − b_i·approach_i"""
    return joints - b * views.approach


@effect("robot", needs=("joints",), s=per_joint("1", 5e-4, 0.02))
def settling(joints: Array, views: Views, s: Array) -> Array:
    """q*_i = q_i + s_i·(q_i − q_i of the previous row)"""
    return joints + s * (views.joints - views.previous)


@effect("links", needs=("joints",), prefers=("robot_temperature_c",), g=number("1/°C", typical=2e-5, limit=2e-4))
def robot_thermal_growth(links: Links, views: Views, g: float) -> Links:
    """DH lengths ×(1+g·ΔT), ΔT from robot_temperature_c; without it g per hour"""
    return replace(links, scale=links.scale * (1 + g * warmer(views, "robot_temperature_c")))


def warmer(views: Views, covariate: str) -> Array:
    """(V,) ΔT since the first view, or hours where nobody measured."""
    return views.since_first(covariate) if covariate in views.covariates else views.hours
