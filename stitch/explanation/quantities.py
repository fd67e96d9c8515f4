"""What a cell knows of its views, as factors of a formula: each with its text, its code and its values."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.measurement.views import Views

# Time constants of warming up that are tried, h; cycles in the time of the session; instants of a step, as its share.
_WARMING = (0.25, 1.0)
_CYCLES = (1, 2, 3, 4, 6, 8)
_STEPS = (0.2, 0.35, 0.5, 0.65, 0.8)
# Periods a turn of gears beyond two; places in a joint's range where a tooth may be damaged, and how wide that is, rad.
_PERIODS = (3, 4, 5, 6, 7, 8)
_PLACES, _WIDTH = 12, 0.2
_STILL = 1e-9


@dataclass(frozen=True)
class Quantity:
    """A number a view."""

    text: str  # for people
    code: str  # of numpy, of `views`
    unit: str  # "" without one
    kind: str  # angle, gear, direction, move, torque, speed, time or covariate
    joint: int | None  # that it belongs to, counted from 0
    values: Array  # (V,)

    @property
    def slow(self) -> bool:
        """True if it follows time, or something that may move with it."""
        return any(kind in self.kind.split("·") for kind in ("time", "covariate"))

    def times(self, other: "Quantity") -> "Quantity":
        """The product; it belongs to no joint."""
        unit = " ".join(sorted(u for u in (self.unit, other.unit) if u))
        text, code = f"{self.text}·{other.text}", f"{self.code} * {other.code}"
        return Quantity(text, code, unit, f"{self.kind}·{other.kind}", None, self.values * other.values)


def quantities(views: Views) -> list[Quantity]:
    """All factors that differ from view to view."""
    found = [*_of_joints(views), *_of_time(views)]
    found += [
        Quantity(name, f'views.since_first("{name}")', name, "covariate", None, views.since_first(name))
        for name in views.covariates
    ]
    return [q for q in found if np.isfinite(q.values).all() and np.ptp(q.values) > _STILL]


def _of_joints(views: Views) -> Iterator[Quantity]:
    for k in range(views.joints.shape[1]):
        q, at = views.joints[:, k], f"views.joints[:, {k}]"
        for periods in (1, 2):
            angle, inner = (f"q{k + 1}", at) if periods == 1 else (f"2q{k + 1}", f"2 * {at}")
            yield Quantity(f"sin {angle}", f"np.sin({inner})", "", "angle", k, np.sin(periods * q))
            yield Quantity(f"cos {angle}", f"np.cos({inner})", "", "angle", k, np.cos(periods * q))
        yield from _of_gear(views, k)
        yield Quantity(
            f"approach{k + 1}", f"views.approach[:, {k}]", "", "direction", k, views.approach[:, k].astype(float)
        )
        moved = q - views.previous[:, k]
        yield Quantity(f"move{k + 1}", f"({at} - views.previous[:, {k}])", "", "move", k, moved)
        if views.velocity is not None:
            yield Quantity(f"speed{k + 1}", f"views.velocity[:, {k}]", "rad/s", "speed", k, views.velocity[:, k])
    for k, (name, joint) in enumerate(zip(views.torques.names, views.torques.joint, strict=True)):
        torque, at = views.torques.values[:, k], f"views.torques.values[:, {k}]"
        yield Quantity(f"τ{name}", at, "N m", "torque", joint, torque)
        code = f"({at} * np.abs({at}))"
        yield Quantity(f"τ{name}|τ{name}|", code, "(N m)²", "torque", joint, torque * np.abs(torque))


def _of_gear(views: Views, k: int) -> Iterator[Quantity]:
    """Higher harmonics of a joint's angle, and bumps at places of its range."""
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    for n in _PERIODS:
        yield Quantity(f"sin {n}q{k + 1}", f"np.sin({n} * {at})", "", "gear", k, np.sin(n * q))
        yield Quantity(f"cos {n}q{k + 1}", f"np.cos({n} * {at})", "", "gear", k, np.cos(n * q))
    for middle in np.linspace(q.min(), q.max(), _PLACES).round(3):
        text = f"bump of q{k + 1} at {np.degrees(middle):.0f}°"
        code = f"np.exp(-0.5 * (({at} - {middle:g}) / {_WIDTH}) ** 2)"
        yield Quantity(text, code, "", "gear", k, np.exp(-0.5 * ((q - middle) / _WIDTH) ** 2))


def _of_time(views: Views) -> Iterator[Quantity]:
    if not views.has("time"):
        return
    yield Quantity("t", "views.hours", "h", "time", None, views.hours)
    for hours in _WARMING:
        text, code = f"(1 − exp(−t/{hours:g} h))", f"(1 - np.exp(-views.hours / {hours:g}))"
        yield Quantity(text, code, "", "time", None, 1 - np.exp(-views.hours / hours))
    whole = float(views.hours[-1]) or 1.0
    for n in _CYCLES:
        code = f"2 * np.pi * {n} * views.hours / {whole:.6g}"
        turn = 2 * np.pi * n * views.hours / float(f"{whole:.6g}")
        yield Quantity(f"sin(2π t/{whole / n:.2g} h)", f"np.sin({code})", "", "time", None, np.sin(turn))
        yield Quantity(f"cos(2π t/{whole / n:.2g} h)", f"np.cos({code})", "", "time", None, np.cos(turn))
    for share in _STEPS:
        since = float(f"{share * whole:.4g}")
        text, code = f"(t > {since:.2g} h)", f"(views.hours > {since:g})"
        yield Quantity(text, code, "", "time", None, (views.hours > since).astype(float))
