"""What an effect is: a name, parameters with units and plausible sizes, a place in the chain, a function.

    @effect("sensor", k=number("mm", typical=0.05, limit=1.0))
    def field_curvature(points, view, k):
        \"\"\"x = x* + u·k·ρ²\"\"\"
        return points + view.along(points) * (k * view.rho2(points))[:, None]

The function says what nature does; that it must be undone, its Jacobian, its test and its fit come by
themselves. What a function receives and returns depends on the place, `PLACES`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stitch.errors import InputError, did_you_mean
from stitch.numerics.units import MILLIMETRES, Amount, format_amount, length_power
from stitch.session.axes import KINDS, Axis
from stitch.session.measurement import TEMPERATURES, Measurement, Views

# Usual sizes beyond which something that is stated is likelier to be wrong than a parameter so large (custom).
BELIEVABLE_SIZES = 10.0
# Stand in a grid for all views of the session, and for all of its temperatures.
EVERY_VIEW, EVERY_TEMPERATURE = (-1.0,), (-2.0,)
# Places that are tried for an event among hundreds of views.
_EVENT_PLACES = 50
PLACES = {
    "base": "(views: Views, parameters) → twists (V, 6): the robot's base stands displaced by exp(twist), base frame",
    "sensor": "(points (N, 3) at x*, view: ScanView, parameters) → points (N, 3) that the scanner reports",
    "robot": "(joints (V, n) reported, views: Views, parameters) → true joints (V, n)",
    "links": "(links: Links, views: Views, parameters) → Links",
    "axis": "(motion: AxisMotion, views: Views, parameters) → AxisMotion of the external axes",
    "mount": "(views: Views, parameters) → twists (V, 6): the mount is M·exp(twist)",
    "part": "(views: Views, parameters) → twists (V, 6): the part sits displaced by exp(twist), reference frame",
    "shape": "(points (N, 3) of the part in the reference frame, view: ScanView, parameters) → displaced points",
}
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")
# What a link and all that it carries may well weigh, kg, where nobody states it; and how much more than is
# believable for a known mass the product of mass and compliance may be, for light and soft arms too.
_LINK_MASS, _LINK_MASS_LIMIT = 10.0, 100.0
_WHERE_FROM = {
    "joints": "joint angles in views.csv and the robot's DH rows or URDF",
    "torque": "joint angles and the robot's geometry",
    "moment": "joint angles and the robot's geometry",
    "temperature": "a column such as robot_temperature_c or ambient_c in views.csv",
    "velocity": "columns j1_velocity_deg_s … in views.csv",
    "time": "a column time_s in views.csv that rises",
    "intensity": "an intensity for every point",
    "optics": "a sensor with optics that has all points ahead of it (kind area, line or camera under [scanner])",
    "surfaces": "a sensor that scans surfaces (kind area or line under [scanner])",
    "axis": "an external axis ([[axis]] in session.toml)",
    "rotary_axis": "a rotary axis ([[axis]] in session.toml)",
    "linear_axis": "a linear axis ([[axis]] in session.toml)",
    "scanners": "sessions of several scanners ([scanner] name in session.toml)",
    "gravity_at_mount": "a scanner that the robot turns against gravity",
    "gravity_at_part": "a part that the robot turns against gravity",
}


@dataclass(frozen=True)
class Spec:
    """Which parameters an argument of an effect's function stands for; lengths in mm, angles in rad."""

    kind: str  # number | vector | offset | joint | torque | moment | twist | rotary | linear | scanner
    unit: str
    typical: float  # size that a real cell may well have; the prior's sigma
    limit: float  # a larger value is not believed
    grid: tuple[float, ...] = ()  # values that are tried one by one, in place of a fit; (): it is fitted
    unit_shift: str = ""  # of a twist's translation
    typical_shift: float = 0.0
    limit_shift: float = 0.0
    axes: Sequence[str] = "xyz"  # of a vector or an offset: what follows its name


def number(unit: str, typical: float, limit: float, grid: Sequence[float] = ()) -> Spec:
    """Return the spec of an argument that is one number.

    Args:
        unit: with mm and rad, as "rad/°C"; "1" without one.
        typical: size that a real cell may well have: the prior's sigma.
        limit: a larger value is not believed.
        grid: values that are tried one by one; empty: it is fitted.
    """
    return Spec("number", unit, typical, limit, tuple(grid))


def vector(unit: str, typical: float, limit: float, axes: Sequence[str] = "xyz") -> Spec:
    """Return the spec of an argument that is a vector (3,): parameters cx, cy, cz for c.

    Args:
        unit, typical, limit: of each component, as for `number`.
        axes: what follows the argument's name, one component each, where they are not x, y, z.
    """
    return Spec("vector", unit, typical, limit, axes=tuple(axes))


def offset(unit: str, typical: float, limit: float, axes: Sequence[str] = "xyz") -> Spec:
    """Return the spec of a vector, as `vector`, that may well be zero where the effect's other parameters are not.

    So the effect is also tried without it.
    """
    return Spec("offset", unit, typical, limit, axes=tuple(axes))


def event() -> Spec:
    """Return the spec of an event: the number, from 0, of the first view after it; possible views are tried in turn.

    Of hundreds of views some fifty are tried.
    """
    return Spec("number", "view", 1.0, float("inf"), EVERY_VIEW)


def temperature() -> Spec:
    """Return the spec of the temperature that an effect follows: its index in `TEMPERATURES`.

    Each temperature that was measured is tried.
    """
    return Spec("number", "column", 1.0, float("inf"), EVERY_TEMPERATURE)


def per_joint(unit: str, typical: float, limit: float) -> Spec:
    """Return the spec of an array (n,) with one number for each joint: c1 … cn for c; arguments as for `number`."""
    return Spec("joint", unit, typical, limit)


def per_torque(unit: str, typical: float, limit: float) -> Spec:
    """Return the spec of an array (m,) with one number for each torque that bends a joint, as `Views.sag` takes it.

    Of c with masses c1 … cn; without them c2_3 for joint 2 and link 3. Arguments as for `number`.
    """
    return Spec("torque", unit, typical, limit)


def per_axis(kind: str, unit: str, typical: float, limit: float, axes: Sequence[str] = ("",)) -> Spec:
    """Return the spec of an array (K·a,) with a numbers for each of the K external axes of a kind: Au_table for A.

    Args:
        kind: rotary | linear.
        unit, typical, limit: of each number, as for `number`.
        axes: a names that follow the argument's name.
    """
    return Spec(kind, unit, typical, limit, axes=tuple(axes))


def per_scanner(unit: str, typical: float, limit: float) -> Spec:
    """Return the spec of an array (3·(K − 1),) with a vector for each of K scanners but the first: rx_right for r.

    The first has none: its place is the model's hand-eye.
    """
    return Spec("scanner", unit, typical, limit)


def per_moment(unit: str, typical: float, limit: float) -> Spec:
    """Return the spec of an array (k,) with one number for each moment that tilts the base, as `Views.tilt` takes it.

    Of c with masses c_x, c_y; without them c_x_2 for link 2. Arguments as for `number`.
    """
    return Spec("moment", unit, typical, limit)


def twist(
    unit: str, rotation: float, translation: float, limit_rotation: float = 0.02, limit_translation: float = 10.0
) -> Spec:
    """Return the spec of an argument that is a twist (6,): parameters rx, ry, rz, tx, ty, tz.

    Args:
        unit: follows rad and mm, such as "/h"; empty for a plain twist.
        rotation, translation: typical sizes, rad and mm.
        limit_rotation, limit_translation: larger values are not believed, rad and mm.
    """
    return Spec(
        "twist",
        f"rad{unit}",
        rotation,
        limit_rotation,
        unit_shift=f"mm{unit}",
        typical_shift=translation,
        limit_shift=limit_translation,
    )


@dataclass(frozen=True)
class Parameter:
    """One number of an effect in a session's own unit: what is plausible, its value, and how well that is known."""

    name: str
    unit: str
    typical: float = float("nan")  # the size a real cell may well have; the prior's sigma
    limit: float = float("inf")  # beyond this something that is stated is likelier to be wrong
    grid: tuple[float, ...] = ()  # values tried one by one: time constants, the view of an event
    argument: str = ""  # of the effect's function that it is, or is a part of
    value: float = 0.0
    sigma: float = float("nan")  # NaN where the views do not show it: it is held at its value
    kept: bool = False  # of an arm that another run fitted: not fitted again
    names: tuple[str, ...] = ()  # of the session's views or of temperatures, where it is the number of one

    @property
    def discrete(self) -> bool:
        """True for the view of an event: it is tried, never fitted."""
        return self.unit == "view"

    @property
    def formatted(self) -> Amount:
        """The value as people read it, with its sigma if it was fitted; a view or a temperature by its name."""
        if self.view:
            return Amount(self.view, "–", "")
        return format_amount(self.value, self.sigma if self.fitted else None, self.unit)

    @property
    def view(self) -> str:
        """Name of the view or temperature whose number the value is, the first view after an event; else empty."""
        number = int(np.ceil(self.value))
        return self.names[number] if 0 <= number < len(self.names) else ""

    @property
    def held(self) -> bool:
        """True if it stays at its value, even where the views could show another."""
        return bool(self.grid) or self.kept

    @property
    def fitted(self) -> bool:
        """True if views showed it, of this session or of the run that its arm comes from."""
        return bool(np.isfinite(self.sigma))

    def beyond_belief(self, value: float, sigma: float) -> bool:
        """Return True if a value is, by two sigmas, above what is believed: the limit, or 10 times the typical size."""
        return abs(value) - 2 * sigma > min(BELIEVABLE_SIZES * self.typical, self.limit)

    @property
    def status(self) -> str:
        """Whether the parameter was fitted, or why it was held, in words."""
        if self.kept:
            return "of another run's arm, as it is"
        if self.fitted:
            return "fitted"
        return "held: the best of those tried" if self.grid else "held: these views do not show it"


@dataclass(frozen=True)
class Effect:
    """One effect of the library, of the empirical tier or of a user."""

    name: str
    place: str
    specs: dict[str, Spec]
    function: Callable[..., Any]
    needs: tuple[str, ...]  # inputs without which it is left out: keys of `_WHERE_FROM`, or names of covariates
    prefers: tuple[str, ...]  # covariates that it uses where the views have them; else it counts per hour
    tier: str  # physical | empirical | user | geometry: in every model of a session that has it, and no candidate
    group: str = ""  # covariate that an empirical effect follows
    prior: float = 1.0  # prior odds relative to an effect that every arm, mount or part may have
    origin: str = ""  # of a user's: the file that it was loaded from, or `package …`; empty for one of this program
    scanner: str = ""  # the only scanner that has it, of several; empty: all
    # Of the sensor, where parameters act in proportion: (points (N, 3), view, direction (N, 3) or (3,)) → (P, N), how
    # far points move along it per unit; None: not known.
    per_unit: Callable[..., Any] | None = None

    @property
    def formula(self) -> str:
        """The first line of the function's docstring."""
        function = getattr(self.function, "of_all", self.function)
        return (function.__doc__ or "").strip().splitlines()[0]

    def at_scanner(self, scanner: str) -> "Effect":
        """Return the effect as one of a single scanner among several, named EFFECT@SCANNER: nothing in other views."""
        function = _AtScanner(self.function, self.place, scanner)
        return replace(self, name=f"{self.name}@{scanner}", function=function, scanner=scanner, per_unit=None)

    def parameters(
        self,
        joints: int,
        torques: Sequence[str],
        length_unit: str,
        axes: Sequence[Axis] = (),
        moments: Sequence[str] = (),
        scanners: Sequence[str] = (),
    ) -> tuple[Parameter, ...]:
        """Return all parameters of the effect in a cell, at value 0, in the session's length unit.

        Args:
            joints: number of the arm's joints.
            torques: names of the torques that bend its joints.
            length_unit: of the session.
            axes: external axes.
            moments: names of the moments that tilt its base.
            scanners: names of all scanners; () of a single one.
        """
        # What follows the argument in the names of its parameters, by its kind.
        endings: dict[str, Sequence[str]] = {
            "number": [""],
            "joint": [str(i + 1) for i in range(joints)],
            "torque": torques,
            "moment": moments,
        }
        # The first scanner's place is the hand-eye: it has no parameters.
        owners = {kind: [axis.name for axis in axes if axis.kind == kind] for kind in KINDS} | {"scanner": scanners[1:]}
        parameters = list[Parameter]()
        for key, spec in self.specs.items():
            names = [key + ending for ending in endings.get(spec.kind, spec.axes)]
            if spec.kind == "twist":
                names = [*TWIST]
            elif spec.kind in owners:
                names = [f"{name}_{owner}" for owner in owners[spec.kind] for name in names]
            parameters += [_parameter(key, spec, name, length_unit) for name in names]
        return tuple(parameters)

    def arguments(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Return the keyword arguments of the effect's function, from all of its parameters in their order.

        A number for an argument of kind `number`, an array for any other.
        """
        values: dict[str, list[float]] = {key: [] for key in self.specs}
        for p in parameters:
            values[p.argument].append(p.value)
        single = {key for key, spec in self.specs.items() if spec.kind == "number"}
        return {key: float(given[0]) if key in single else np.array(given, float) for key, given in values.items()}


def _parameter(key: str, spec: Spec, name: str, length_unit: str) -> Parameter:
    """Return a parameter of an argument, at value 0, with its unit and plausible sizes in the session's length unit.

    Args:
        key: the argument of the effect's function.
        spec: what that argument is, with lengths in mm.
        name: of the parameter.
        length_unit: of the session.
    """
    unit, typical, limit = spec.unit, spec.typical, spec.limit
    if spec.kind == "twist" and name.startswith("t"):
        unit, typical, limit = spec.unit_shift, spec.typical_shift, spec.limit_shift
    if spec.kind in ("torque", "moment") and "_" in name[len(key) :].lstrip("_"):
        # A torque between two joints, or a moment of one link, is that of 1 kg there: the coefficient holds its mass.
        unit, typical, limit = f"kg {unit}", _LINK_MASS * typical, _LINK_MASS_LIMIT * limit
    # Units are written for millimetres; a session in metres has the same unit with m.
    factor = MILLIMETRES[length_unit] ** -length_power(unit, "mm")
    return Parameter(name, unit.replace("mm", length_unit), typical * factor, limit * factor, spec.grid, argument=key)


@dataclass(frozen=True)
class _AtScanner:
    """The function of an effect of mount or sensor that acts in the views of one scanner alone."""

    of_all: Callable[..., Any]
    place: str
    scanner: str

    def __call__(self, known: Any, view: Any = None, **arguments: Any) -> Any:
        """Return what the effect's function returns, with no change in the views of other scanners.

        An effect of the mount is called with all views and returns twists (V, 6). One of the sensor is called with the
        points (N, 3) of a view and returns them moved.

        Args:
            known: all views, or the points (N, 3) of one view.
            view: of these points; None: `known` are views.
        """
        views = known if self.place == "mount" else view.views
        index = views.scanners.names.index(self.scanner)
        has_it = views.scanners.of_view == index
        # Each scanner has a hand-eye, a standoff and a first view of its own.
        of_scanner = views.by_scanner[index]
        if self.place == "mount":
            return has_it[:, None] * self.of_all(of_scanner, **arguments)
        return self.of_all(known, replace(view, views=of_scanner), **arguments) if has_it[view.index] else known


EFFECTS: dict[str, Effect] = {}


def effect(
    place: str,
    *,
    needs: Sequence[str] = (),
    prefers: Sequence[str] = (),
    tier: str = "",
    prior: float = 1.0,
    **specs: Spec,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that registers a function in EFFECTS as an effect, under the function's name.

    A user's effect replaces one of the same name that a user defined before.

    Args:
        place: where in the chain of frames it acts, a key of PLACES: it says what the function receives and returns.
        needs: inputs without which it is left out: keys of `_WHERE_FROM`, as "joints", or names of covariates.
        prefers: covariates that the function uses where the views have them; where they have none, time stands in.
        tier: physical | user | geometry; empty: physical for functions of this package, user for others.
        prior: prior odds relative to an effect that every arm, mount or part may have.
        specs: one per argument of the function, by its name: `number`, `vector`, `per_joint` and so on.

    Raises:
        InputError: unknown place, a name that is taken, no docstring, or no parameter that can be fitted.
    """
    if place not in PLACES:
        raise InputError(f"effect at {place!r}: places are {', '.join(PLACES)}")

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        """Put a function into the library as an effect, and return it unchanged."""
        name = function.__name__
        if name in EFFECTS and EFFECTS[name].tier != "user":
            raise InputError(f"effect {name!r} is in the library already; give yours another name")
        if not (function.__doc__ or "").strip():
            raise InputError(f"effect {name!r} has no docstring; its first line says what nature does")
        if all(isinstance(spec, Spec) and spec.grid for spec in specs.values()):
            raise InputError(
                f"effect {name!r} has nothing to fit; give it a parameter that is not tried value by value"
            )
        of_library = (function.__module__ or "").startswith("stitch.effects.")
        known_tier = tier or ("physical" if of_library else "user")
        EFFECTS[name] = Effect(
            name, place, specs, function, needs=tuple(needs), prefers=tuple(prefers), tier=known_tier, prior=prior
        )
        return function

    return register


def find_effect(name: str) -> Effect:
    """Return a registered effect by its name, or by EFFECT@SCANNER the same of one scanner.

    Raises:
        InputError: no such effect.
    """
    of_all, _, scanner = name.partition("@")
    if scanner and of_all in EFFECTS:
        return EFFECTS[of_all].at_scanner(scanner)
    if name not in EFFECTS:
        there = f"one of {', '.join(EFFECTS)}"
        raise InputError(
            f"no effect {name!r}{did_you_mean(name, EFFECTS)}",
            fix_cli=f"{there}; your own: --effects-file",
            fix_python=f"{there}; your own: import the file that defines it",
        )
    return EFFECTS[name]


def of_each_scanner(views: Views, effects: Iterable[Effect]) -> list[Effect]:
    """Return the effects; with several scanners, those of sensor and mount once per scanner, as EFFECT@SCANNER.

    The scanners' places, of tier geometry, stay one effect.
    """
    names = views.scanners.names
    return [
        each
        for effect in effects
        for each in (
            [effect.at_scanner(name) for name in names]
            if names and effect.place in ("sensor", "mount") and effect.tier != "geometry"
            else [effect]
        )
    ]


def parameters_in(measurement: Measurement, effect: Effect) -> tuple[Parameter, ...]:
    """Return the parameters of an effect in a session, at value 0, with the grids that depend on its views.

    Where the effect prefers a temperature that was not measured, time stands in: units per °C become units per hour.
    """
    views = measurement.views
    # An event can come before any view but the first two and the last: one view alone shows no event. Among hundreds of
    # views its place matters less than the time to try them all.
    places = range(2, views.count - 1)
    events = tuple(float(v) for v in places[:: max(len(places) // _EVENT_PLACES, 1)])
    grids: dict[tuple[float, ...], tuple[float, ...]] = {
        EVERY_VIEW: events,
        EVERY_TEMPERATURE: tuple(map(float, views.temperatures)),
    }
    timed = bool(effect.prefers) and not any(views.has(name) for name in effect.prefers)
    return tuple(
        replace(
            p,
            unit=p.unit.replace("°C", "h") if timed else p.unit,
            grid=grids.get(p.grid, p.grid),
            names=views.names if p.discrete else TEMPERATURES if p.unit == "column" else (),
        )
        for p in effect.parameters(
            views.joints.shape[1],
            views.torques.names,
            measurement.length_unit,
            views.axes.axes,
            views.torques.base_names,
            views.scanners.names,
        )
    )


def missing_need(measurement: Measurement, effect: Effect) -> tuple[str, ...]:
    """Return the needs of an effect that a session lacks; () if it can have the effect.

    An effect that prefers covariates needs one of them or time.
    """
    views = measurement.views
    known_here = {
        "intensity": measurement.has_intensity,
        "optics": measurement.has_optics,
        # A camera sees marks: no surface, at no slant.
        "surfaces": measurement.sensor in (None, "area", "line"),
    }
    missing = [need for need in effect.needs if not known_here.get(need, views.has(need))]
    if effect.scanner and effect.scanner not in views.scanners.names:
        missing.append(f"scanner {effect.scanner}")
    if effect.prefers and not any(views.has(name) for name in (*effect.prefers, "time")):
        missing.append("time")
    return tuple(missing)


def is_asked(measurement: Measurement, effect: Effect) -> bool:
    """Return True if an effect is a candidate here, or one that is listed with what it lacks.

    Not those of tier geometry, of axes in a session without any, and of gravity where it cannot turn: at what stands
    still, the scanner with eye_to_hand, the part with eye_in_hand.
    """
    gravity_of_still = "gravity_at_mount" if measurement.eye_to_hand else "gravity_at_part"
    if effect.tier == "geometry" or gravity_of_still in effect.needs:
        return False
    return effect.place != "axis" or bool(measurement.views.axes)


def require_available(measurement: Measurement, effect: Effect) -> None:
    """Refuse an effect that a session cannot have.

    Raises:
        InputError: names what is missing.
    """
    missing = missing_need(measurement, effect)
    if missing:
        words = " and ".join(map(describe_need, missing))
        raise InputError(
            f"effect {effect.name} needs {words}, which session {measurement.capture.name} does not have"
            "; to fix: state it, or leave the effect out"
        )


def describe_need(need: str) -> str:
    """Return a need, a key of `_WHERE_FROM` or the name of a covariate, in words: where a session states it."""
    return need if need.startswith("scanner ") else _WHERE_FROM.get(need, f"a column {need} in views.csv")


def by_joint(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Return groups of indices of parameters, one for each joint or external axis; [] for an effect without them.

    Parameters that are tried value by value (`grid`) belong to no joint's group. Of an effect of joints, an argument
    that is no array over joints makes a group by itself.
    """
    groups: dict[str, list[int]] = {}
    if effect.place == "axis":
        for i, p in enumerate(parameters):
            axis = p.name.partition("_")[2]
            groups.setdefault(axis, []).append(i)
        return list(groups.values())
    if not any(spec.kind in ("joint", "torque") for spec in effect.specs.values()):
        return []
    for i, p in enumerate(parameters):
        if not p.grid:
            # Names are c2 of joint 2, or c2_3 of joint 2 and link 3.
            per_joint = effect.specs[p.argument].kind in ("joint", "torque")
            key = p.name[len(p.argument) :].split("_")[0] if per_joint else p.argument
            groups.setdefault(key, []).append(i)
    return list(groups.values())


def without_offset(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Return one group, the indices of all parameters that are not of kind `offset`, as a list of groups.

    [] where the effect has no offset, or would have nothing to fit without it.
    """
    others = [i for i, p in enumerate(parameters) if effect.specs[p.argument].kind != "offset"]
    fitted = any(not parameters[i].grid for i in others)
    return [others] if fitted and len(others) < len(parameters) else []


def separable_groups(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Return groups of indices of parameters, each of which may be in a model while the other groups are zero.

    - Effects of links, and empirical ones: each fitted parameter is a group.
    - Effects of joints or axes: one group for each joint or axis.
    - All others: the parameters without offsets, if there are any, and all parameters.

    Parameters that are tried value by value (`grid`) are not fitted: alone they are no hypothesis.
    """
    if effect.place == "links" or effect.tier == "empirical":
        # A wrong length or angle in a DH row leaves the others right, as does one term of a polynomial.
        return [[i] for i, p in enumerate(parameters) if not p.grid]
    return by_joint(effect, parameters) or [*without_offset(effect, parameters), list(range(len(parameters)))]
