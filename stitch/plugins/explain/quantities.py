"""What a formula may be made of: what a cell knows of its views, as quantities with a text, a code and values.

Waves of a joint's angle, bumps, teeth, what stays behind, swings and warming up have parameters that a formula may
move (Nonlinear); powers of a torque stand beside their line.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from stitch.numerics.frames import Array
from stitch.session.measurement import Views

_DIGITS = 4  # of a nonlinear parameter in a formula
# What effects call that of which a quantity of a kind is made; a covariate goes by its own name.
_MADE_OF = {
    **dict.fromkeys(("angle", "gear", "teeth", "direction", "move"), "joints"),
    **dict.fromkeys(("time", "course"), "time"),
    "torque": "torque",
    "speed": "velocity",
}
# By about what share the true width, play or time constant may differ from one that is tried; how far a bump's middle
# may lie off, in its widths; by how many swings in the session there may be more or fewer, and rad of their phase.
_WIDTH_SPREAD = 0.4
_PLAY_SPREAD = 0.2
_CONSTANT_SPREAD = 0.7
_MIDDLE_SPREAD = 0.5
_PERIOD_SPREAD = 0.25
_PHASE_SPREAD = 0.8
# By what share of itself a tooth, and by what share of a tooth its jump, may lie off.
_TOOTH, _JUMP = 0.05, 0.1
# Share of what a power changes, below which rounding may be all that is beside its line; torques that any power may
# have on a line, or nearly.
_MIN_CURVATURE, _AS_A_LINE = 1e-6, 3
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


@dataclass(frozen=True)
class Nonlinear:
    """A parameter of a quantity that is no factor before it: a place, a width, a period."""

    value: float
    spread: float  # by about how much the true one may lie off; as a share of it where it is positive
    positive: bool = False
    within: tuple[float, float] = (-np.inf, np.inf)

    def at(self, steps: float) -> float:
        """So many spreads off."""
        moved = self.value * np.exp(self.spread * steps) if self.positive else self.value + self.spread * steps
        return float(np.clip(moved, *self.within))

    def near(self, value: float) -> bool:
        """True of a value that is no more than a spread off."""
        steps = np.log(value / self.value) if self.positive else value - self.value
        return bool(abs(steps) <= self.spread)


@dataclass(frozen=True)
class Quantity:
    """A number a view."""

    text: str  # for people
    code: str  # of numpy, of `views`
    unit: str  # "" without one
    kind: str  # constant, angle, gear, teeth, direction, move, torque, speed, time, course or covariate
    joint: int | None  # that it belongs to, counted from 0
    values: Array  # (V,)
    together: tuple[str, ...] = ()  # addends that it is a part of, where it is not one alone
    columns: tuple[str, ...] = ()  # covariates that its code reads
    nonlinear: tuple[Nonlinear, ...] = ()
    family: "Family | None" = None  # of the nonlinear parameters' values

    @property
    def needs(self) -> tuple[str, ...]:
        """Return what its code reads of `views`, as effects call it."""
        made_of = [_MADE_OF[kind] for kind in self.kind.split("·") if kind in _MADE_OF]
        return tuple(dict.fromkeys([*made_of, *self.columns]))

    @property
    def slow(self) -> bool:
        """True if it follows time, or something that may move with it."""
        return any(kind in self.kind.split("·") for kind in ("time", "course", "covariate"))

    @property
    def bounded(self) -> bool:
        """True if it is one at the most, in views that nobody has measured too."""
        return set(self.kind.split("·")) <= {"constant", "angle", "gear", "teeth", "direction"}

    def times(self, other: "Quantity") -> "Quantity":
        """The product; it belongs to no joint."""
        unit = " ".join(sorted(u for u in (self.unit, other.unit) if u))
        text, code = f"{self.text}·{other.text}", f"{self.code} * {other.code}"
        kind, columns = f"{self.kind}·{other.kind}", self.columns + other.columns
        return Quantity(text, code, unit, kind, None, self.values * other.values, columns=columns)

    def moved(self, steps: Array) -> "Quantity":
        """Return the quantity with its nonlinear parameters moved by so many spreads."""
        return self._of([p.at(float(s)) for p, s in zip(self.nonlinear, steps, strict=True)])

    def nearly(self, other: "Quantity") -> bool:
        """True of the same, with nonlinear parameters no farther off than they may lie from the true ones."""
        own = (self.kind, self.joint, len(self.nonlinear))
        if not self.nonlinear or own != (other.kind, other.joint, len(other.nonlinear)):
            return self.text == other.text
        return all(a.near(b.value) for a, b in zip(self.nonlinear, other.nonlinear, strict=True))

    def rounded(self) -> "Quantity":
        """Return the quantity with nonlinear parameters rounded for people."""
        return self._of([float(f"{p.value:.{_DIGITS}g}") for p in self.nonlinear])

    def _of(self, parameters: list[float]) -> "Quantity":
        return self if self.family is None else self.family(*parameters)


Family = Callable[..., Quantity]


def bump_of_joint(views: Views, k: int, middle: float, width: float) -> Quantity:
    """exp(−((q − middle) / width)² / 2) of joint k, from 0; rad."""
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    text = f"bump of q{k + 1} at {np.degrees(middle):.0f}°, {np.degrees(width):.2g}° wide"
    return _bump(text, q, at, middle, width, kind="gear", joint=k, family=partial(bump_of_joint, views, k))


def saw_of_joint(views: Views, k: int, tooth: float, jump: float) -> Quantity:
    """Return −1/2 to 1/2 along each tooth of so many rad, back at once where joint k passes `jump`; rad.

    Of its jumps the one next to the middle of the joint's range is told: there tooth and jump hardly depend on each
    other.
    """
    q, at = views.joints[:, k], f"views.joints[:, {k}]"
    jump += tooth * round((0.5 * float(q.min() + q.max()) - jump) / tooth)
    return Quantity(
        f"saw of q{k + 1}, a tooth {np.degrees(tooth):.3g}° and a jump at {np.degrees(jump):.3g}°",
        f"(({at} - {jump:.6g}) / {tooth:.6g} % 1 - 0.5)",
        "",
        "teeth",
        k,
        (q - jump) / tooth % 1 - 0.5,
        nonlinear=(Nonlinear(tooth, _TOOTH, positive=True), Nonlinear(jump, _JUMP * tooth)),
        family=partial(saw_of_joint, views, k),
    )


def nonlinear_torque(torque: Quantity, power: Callable[[Array], Array], text: str, code: str) -> Quantity | None:
    """Return what a power of a torque does that no line does, in these views: the line is the part of the zero and of a
    spring that does not stiffen, and far from zero nearly all of the power. None where the views show nothing of it.

    Args:
        power: of the torque as a share of the largest.
        text: of it, and `code`: of `x`.
    """
    largest = float(f"{np.abs(torque.values).max():.3g}")
    share = torque.values / largest
    slope, zero = np.polyfit(share, power(share), 1)
    values = power(share) - slope * share - zero
    if np.abs(values).max() < _MIN_CURVATURE * np.ptp(power(share)) or len(np.unique(share)) <= _AS_A_LINE:
        return None
    x = f"({torque.code} / {largest:g})"
    return replace(
        torque,
        text=f"({text.replace('x', f'({torque.text}/{largest:g} {torque.unit})')} beside its line)",
        code=f"({code.replace('x', x)} - {slope:.15g} * {x} - {zero:.15g})",
        unit="",
        values=values,
    )


def bump_in_time(views: Views, middle: float, width: float) -> Quantity:
    """exp(−((t − middle) / width)² / 2); h."""
    text = f"bump of t at {middle:.2g} h, {width:.2g} h wide"
    family = partial(bump_in_time, views)
    return _bump(text, views.hours, "views.hours", middle, width, kind="course", joint=None, family=family)


def backlash_lag(views: Views, k: int, play: float) -> Quantity:
    """Return what stays behind joint k, from 0, within a play of so many rad."""
    return Quantity(
        f"stays ({np.degrees(play):.2g}° of play) behind q{k + 1}",
        f"views.behind({k}, {play:.6g})",
        "",
        "move",
        k,
        views.behind(k, play),
        nonlinear=(Nonlinear(play, _PLAY_SPREAD, positive=True),),
        family=partial(backlash_lag, views, k),
    )


def oscillation(views: Views, period: float, late: float) -> Quantity:
    """cos(2π t/period − late); h, rad."""
    whole = float(views.hours[-1]) or 1.0
    return Quantity(
        f"cos(2π t/{period:.2g} h − {np.degrees(late):.3g}°)",
        f"np.cos(2 * np.pi * views.hours / {period:.6g} - {late:.6g})",
        "",
        "course",
        None,
        np.cos(2 * np.pi * views.hours / period - late),
        nonlinear=(Nonlinear(period, _PERIOD_SPREAD * period / whole, positive=True), Nonlinear(late, _PHASE_SPREAD)),
        family=partial(oscillation, views),
    )


def warm_up(views: Views, constant: float) -> Quantity:
    """1 − exp(−t/constant); h."""
    return Quantity(
        f"(1 − exp(−t/{constant:.2g} h))",
        f"(1 - np.exp(-views.hours / {constant:.6g}))",
        "",
        "time",
        None,
        1 - np.exp(-views.hours / constant),
        nonlinear=(Nonlinear(constant, _CONSTANT_SPREAD, positive=True),),
        family=partial(warm_up, views),
    )


def _bump(
    text: str, x: Array, at: str, middle: float, width: float, *, kind: str, joint: int | None, family: Family
) -> Quantity:
    code = f"np.exp(-0.5 * (({at} - {middle:.6g}) / {width:.6g}) ** 2)"
    # A bump of whose flank alone is seen could be of any height.
    there = float(x.min()), float(x.max())
    free = Nonlinear(middle, _MIDDLE_SPREAD * width, within=there), Nonlinear(width, _WIDTH_SPREAD, positive=True)
    values = np.exp(-0.5 * ((x - middle) / width) ** 2)
    return Quantity(text, code, "", kind, joint, values, nonlinear=free, family=family)


def view_quantities(views: Views) -> list[Quantity]:
    """All factors: what differs from view to view, and one that does not."""
    quantities = [*_joint_quantities_of(views), *_time_quantities(views)]
    for name in views.covariates:
        code = f'views.since_first("{name}")'
        values = views.since_first(name)
        quantities.append(Quantity(name, code, name, "covariate", None, values, columns=(name,)))
    # Where the law of a joint has its zero nobody knows.
    varying = [q for q in quantities if np.isfinite(q.values).all() and np.ptp(q.values) > _STILL]
    springs = tuple(label for q in varying for label in q.together if label.startswith(_SPRING))
    zero = Quantity(
        "1", "np.ones(views.count)", "", "constant", None, np.ones(views.count), ("1", *dict.fromkeys(springs))
    )
    return [zero, *varying]


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
