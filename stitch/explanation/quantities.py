"""What a cell knows of its views, as factors of a formula: each with its text, its code and its values."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stitch.explanation.quantity import Quantity
from stitch.explanation.shapes import (
    backlash_lag,
    bump_in_time,
    bump_of_joint,
    nonlinear_torque,
    oscillation,
    saw_of_joint,
    warm_up,
)
from stitch.frames import Array
from stitch.measurement.views import Views

# Time constants of warming up that are tried, h; instants of a step, as a share of the session; swings in it, half a
# swing apart, at the most and from view to view (teeth of a belt likewise), and their phases; stretches as wide
# (standard deviation) as these shares of it.
_WARMING = (0.25, 1.0)
_STEPS = (0.2, 0.35, 0.5, 0.65, 0.8)
_SWINGS, _FASTEST, _PHASES = 20, 0.45, (0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5)
_STRETCHES = (0.06, 0.12, 0.2)
# Periods a turn of gears beyond two; how wide a damaged tooth is, rad, and how far apart its places are tried.
_PERIODS = (3, 4, 5, 6, 7, 8)
_WIDTH, _APART = 0.2, 0.15
# Teeth of a belt's pulley: rad from one to the next, how many of them more a range may hold, and places of the jump.
_TEETH, _MORE, _JUMPS = (0.17, 0.52), 0.5, 6
# Play of a gear with friction, as a share of the range that the joint was driven over.
_PLAYS = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4)
_STILL = 1e-9
_SPRING = "spring under"  # label of what comes together: its zero, its pull, and how that stiffens


def view_quantities(views: Views) -> list[Quantity]:
    """All factors: what differs from view to view, and one that does not."""
    found = [*_joint_quantities_of(views), *_time_quantities(views)]
    for name in views.covariates:
        code, values = f'views.since_first("{name}")', views.since_first(name)
        found.append(Quantity(name, code, name, "covariate", None, values, columns=(name,)))
    # Where the law of a joint has its zero nobody knows.
    told = [q for q in found if np.isfinite(q.values).all() and np.ptp(q.values) > _STILL]
    springs = tuple(label for q in told for label in q.together if label.startswith(_SPRING))
    zero = Quantity(
        "1", "np.ones(views.count)", "", "constant", None, np.ones(views.count), ("1", *dict.fromkeys(springs))
    )
    return [zero, *told]


def _joint_quantities_of(views: Views) -> Iterator[Quantity]:
    for k in range(views.joints.shape[1]):
        q, at = views.joints[:, k], f"views.joints[:, {k}]"
        for periods in (1, 2):
            angle, inner = (f"q{k + 1}", at) if periods == 1 else (f"2q{k + 1}", f"2 * {at}")
            yield from _wave_quantities(angle, inner, "angle", k, periods * q)
        yield from _gear_quantities(views, k)
        yield Quantity(
            f"approach{k + 1}", f"views.approach[:, {k}]", "", "direction", k, views.approach[:, k].astype(float)
        )
        moved = q - views.previous[:, k]
        yield Quantity(f"move{k + 1}", f"({at} - views.previous[:, {k}])", "", "move", k, moved)
        for share in _PLAYS:
            yield backlash_lag(views, k, float(f"{share * np.ptp(views.path[:, k]):.3g}"))
        if views.velocity is not None:
            yield Quantity(f"speed{k + 1}", f"views.velocity[:, {k}]", "rad/s", "speed", k, views.velocity[:, k])
    for k, (name, joint) in enumerate(zip(views.torques.names, views.torques.joint, strict=True)):
        torque, at = views.torques.values[:, k], f"views.torques.values[:, {k}]"
        yield from _torque_quantities(Quantity(f"τ{name}", at, "N m", "torque", joint, torque))


def _torque_quantities(plain: Quantity) -> Iterator[Quantity]:
    """A spring's pull, how it yields more one way, and how it stiffens."""
    torque, text = plain.values, plain.text
    spring = f"{_SPRING} {text}"
    yield replace(plain, together=(text, spring))
    if np.ptp(torque) > _STILL:
        square = nonlinear_torque(plain, lambda x: x * np.abs(x), "x|x|", "x * np.abs(x)")
        cube = nonlinear_torque(plain, lambda x: x**3, "x³", "x**3")
        if square is not None:
            yield square
        if cube is not None:
            yield replace(cube, together=(cube.text, spring))


def _gear_quantities(views: Views, k: int) -> Iterator[Quantity]:
    """Higher harmonics of a joint's angle, bumps at places of its range, and teeth of a belt."""
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    for n in _PERIODS:
        yield from _wave_quantities(f"{n}q{k + 1}", f"{n} * {at}", "gear", k, n * q)
    for middle in np.arange(q.min(), q.max() + _APART, _APART).round(3):
        yield bump_of_joint(views, k, float(middle), _WIDTH)
    whole = float(np.ptp(q))
    most = min(whole / _TEETH[0], _FASTEST * (views.count - 1))
    for teeth in np.arange(max(whole / _TEETH[1], 1.5), most, _MORE):
        for jump in np.arange(_JUMPS) / _JUMPS:
            yield saw_of_joint(views, k, float(f"{whole / teeth:.4g}"), float(f"{whole / teeth * jump:.4g}"))


def _time_quantities(views: Views) -> Iterator[Quantity]:
    if not views.has("time"):
        return
    yield Quantity("t", "views.hours", "h", "time", None, views.hours)
    for hours in _WARMING:
        yield warm_up(views, hours)
    whole = float(views.hours[-1]) or 1.0
    most = min(_SWINGS, _FASTEST * (views.count - 1))
    for swings in np.arange(1.0, most, 0.5):
        for phase in _PHASES:
            yield oscillation(views, float(f"{whole / swings:.6g}"), float(f"{np.radians(phase):.6g}"))
    for width in _STRETCHES:
        for middle in np.arange(width, 1.0, width):
            yield bump_in_time(views, float(f"{middle * whole:.4g}"), float(f"{width * whole:.4g}"))
    for share in _STEPS:
        since = float(f"{share * whole:.4g}")
        text, code = f"(t > {since:.2g} h)", f"(views.hours > {since:g})"
        yield Quantity(text, code, "", "time", None, (views.hours > since).astype(float))


def _wave_quantities(of: str, code: str, kind: str, joint: int, angle: Array) -> Iterator[Quantity]:
    """Sine and cosine of an angle (V,): of any phase a wave takes both."""
    yield Quantity(f"sin {of}", f"np.sin({code})", "", kind, joint, np.sin(angle), together=(of,))
    yield Quantity(f"cos {of}", f"np.cos({code})", "", kind, joint, np.cos(angle), together=(of,))
