"""An effect in one session: its parameters there, and what it needs that the session may not have."""

from dataclasses import replace

from stitch.effects.contract import EFFECTS, Effect, Parameter
from stitch.effects.specs import EVERY_VIEW
from stitch.errors import InputError
from stitch.measurement.measurement import Measurement

_EVENT_PLACES = 50
_WHERE_FROM = {
    "joints": "joint angles in views.csv and the robot's DH rows or URDF",
    "torque": "joint angles and the robot's geometry",
    "velocity": "columns j1_velocity_deg_s … in views.csv",
    "time": "a column time_s in views.csv",
    "intensity": "an intensity for every point",
    "optics": "a sensor with optics that has all points ahead of it (kind area, line or camera under [scanner])",
    "surfaces": "a sensor that scans surfaces (kind area or line under [scanner])",
}


def describe_need(need: str) -> str:
    """What an effect needs, as somebody who writes a session knows it."""
    return _WHERE_FROM.get(need, f"a column {need} in views.csv")


def find_effect(name: str) -> Effect:
    """An effect of the library or of a user's file.

    Raises:
        InputError: no such effect.
    """
    if name not in EFFECTS:
        raise InputError(f"no effect {name!r}; there are {', '.join(EFFECTS)} (your own: --effects-file)")
    return EFFECTS[name]


def parameters_in(measurement: Measurement, effect: Effect) -> tuple[Parameter, ...]:
    """The parameters of an effect in a session, at zero; where time stands in for a temperature, rates are per hour."""
    views = measurement.views
    found = effect.parameters(views.joints.shape[1], views.torques.names, measurement.length_unit)
    timed = bool(effect.prefers) and not any(views.has(name) for name in effect.prefers)
    found = tuple(replace(p, unit=p.unit.replace("°C", "h")) for p in found) if timed else found
    return tuple(replace(p, grid=_grid(p, views.count), names=views.names if p.discrete else ()) for p in found)


def _grid(parameter: Parameter, views: int) -> tuple[float, ...]:
    if parameter.grid != EVERY_VIEW:
        return parameter.grid
    # An event can come before any view but the first two and the last: one view alone shows no event.
    places = range(2, views - 1)
    # Among hundreds of views the place of an event matters less than the time to try them all.
    return tuple(float(v) for v in places[:: max(len(places) // _EVENT_PLACES, 1)])


def missing_need(measurement: Measurement, effect: Effect) -> tuple[str, ...]:
    """What an effect needs and a session has not; time stands in for a covariate that the effect prefers."""
    views = measurement.views
    known_here = {
        "intensity": measurement.has_intensity,
        "optics": measurement.has_optics,
        "surfaces": measurement.has_surfaces,
    }
    missing = [need for need in effect.needs if not known_here.get(need, views.has(need))]
    if effect.prefers and not any(views.has(name) for name in (*effect.prefers, "time")):
        missing.append("time")
    return tuple(missing)


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
