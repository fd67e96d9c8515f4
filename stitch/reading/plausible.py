"""Is the scale right? Metres read as millimetres, or the reverse, are off by 1000."""

import numpy as np

from stitch.errors import InputError
from stitch.measurement.session import Session
from stitch.units import METRES

# Working distances of scanners on robots, in metres: from a borescope to a hall.
_RANGE_M = (0.01, 20.0)
# Trackers see as far as a hall is long.
_SIGHT_M = (0.01, 100.0)
# Reach of robots, in metres.
_REACH_M = (0.03, 60.0)
_OTHER = {"mm": "m", "m": "mm"}


def check_scale(session: Session, cloud_unit: str) -> None:
    """Refuse clouds or poses whose size only makes sense in the other unit.

    Raises:
        InputError: names the quantity, its size and the key to change.
    """
    metres = METRES[session.length_unit]
    toml = session.path / "session.toml"
    for view in session.views:
        if view.cloud is not None:
            distance = float(np.median(np.linalg.norm(view.cloud.points, axis=1)))
            _refuse(
                distance * metres, _RANGE_M, f"{toml}: the points of view {view.name} lie", "cloud_unit", cloud_unit
            )
        if view.sighting is not None:
            distance = float(np.median(np.linalg.norm(view.sighting.points, axis=1)))
            what = f"{toml}: the targets of view {view.name} lie"
            _refuse(distance * metres, _SIGHT_M, what, "length_unit", session.length_unit)
    reach = float(np.max([np.linalg.norm(view.T_base_flange[:3, 3]) for view in session.views]))
    _refuse(reach * metres, _REACH_M, f"{toml}: the flange stands at most", "length_unit", session.length_unit)
    _compare(session, cloud_unit)


def _refuse(size_m: float, limits: tuple[float, float], what: str, key: str, unit: str) -> None:
    if limits[0] <= size_m <= limits[1] or size_m == 0:
        return
    shown = f"{size_m * 1e3:.3g} mm" if size_m < 1 else f"{size_m:.3g} m"
    hint = f'the scale looks off by 1000: set {key} = "{_OTHER[unit]}"'
    raise InputError(f'{what} {shown} away with {key} = "{unit}"; {hint}')


def _compare(session: Session, cloud_unit: str) -> None:
    """Against the sizes that the session itself states."""
    clouds = [view.cloud.points for view in session.views if view.cloud is not None]
    if not clouds or not session.scanner.standoff:
        return
    distance = float(np.median([np.median(np.linalg.norm(points, axis=1)) for points in clouds]))
    ratio = distance / session.scanner.standoff
    if not 0.03 < ratio < 30:
        raise InputError(
            f"{session.path / 'session.toml'}: points lie {distance:.3g} {session.length_unit} away, but "
            f"scanner.standoff is {session.scanner.standoff:.3g}; "
            f'the scale looks off by 1000: check cloud_unit (is "{cloud_unit}")'
        )
