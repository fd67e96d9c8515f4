"""Is the scale right? Metres read as millimetres, or the reverse, are off by 1000.

Sizes and motions are judged, and how far things can lie; not how near: the origin of many structured-light and line
scanners lies in the middle of what they measure.
"""

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.session import Session
from stitch.reading.one_unit import is_plausible_size, length_message, require_one_unit
from stitch.units import METRES

# What one scan of a robot's scanner shows, in metres: from a borescope to a hull.
_SIZE_M = (3e-3, 20.0)
# How far the middle of a scan may lie from the sensor's origin, and any single point.
_RANGE_M, _FARTHEST_M = 20.0, 1000.0
# Trackers see as far as a hall is long.
_SIGHT_M = 100.0
# Reach of robots, in metres.
_REACH_M = (0.03, 60.0)
# A target moves about as far as the flange: not a few hundred times more or less.
_MOTION_RATIO = 300.0
# Fields of view over the working distance; a 1000 times less or more is another unit.
_FIELD_SIZE = (2e-3, 30.0)
_OTHER_UNIT = {"mm": "m", "m": "mm"}


def check_scale(session: Session, cloud_unit: str) -> None:
    """Refuse clouds or poses whose size only makes sense in the other unit.

    Raises:
        InputError: names the quantity, its size and the key to change.
    """
    metres = METRES[session.length_unit]
    toml = session.path / "session.toml"
    own = session.length_unit
    clouds = [(view.name, view.cloud) for view in session.views if view.cloud is not None]
    away = {name: metres * _median_distance(cloud.points) for name, cloud in clouds}
    over = {name: metres * _trimmed_extent(cloud.points) for name, cloud in clouds}
    for sizes, limits, does, how in ((away, (0.0, _RANGE_M), "lie", "away"), (over, _SIZE_M, "extend over", "")):
        require_one_unit(toml, sizes, limits, f"{does} {{}}{' ' * bool(how)}{how}", cloud_unit)
        for name, size in sizes.items():
            _refuse(size, limits, f"{toml}: the points of view {name} {does}", how, "cloud_unit", cloud_unit)
    for view in session.views:
        if view.sighting is not None:
            distance = _median_distance(view.sighting.points) * metres
            what = f"{toml}: the targets of view {view.name} lie"
            _refuse(distance, (0.0, _SIGHT_M), what, "away", "length_unit", own)
    flange = np.array([view.T_base_flange[:3, 3] for view in session.views]) * metres
    reach = float(np.linalg.norm(flange, axis=1).max())
    _refuse(reach, _REACH_M, f"{toml}: the flange stands at most", "away", "length_unit", own)
    _compare_motions(session, flange)
    _compare_standoff(session, cloud_unit)


def _median_distance(points: Array) -> float:
    return float(np.median(np.linalg.norm(points, axis=1)))


def _trimmed_extent(points: Array) -> float:
    """The longest side of the box around all but the outermost points."""
    low, high = np.percentile(points, (5, 95), axis=0)
    return float((high - low).max())


def require_near(what: str, points: Array) -> None:
    """Refuse single points (N, 3), m, that no sensor measures: one of them would stretch every grid over the cloud."""
    if np.abs(points).max() > _FARTHEST_M:
        far = np.abs(points).max(axis=1) > _FARTHEST_M
        raise InputError(
            f"{what}: {far.sum()} of {len(points)} points lie more than {_FARTHEST_M:g} m from the scanner, the first "
            f"is point {int(far.argmax()) + 1}; to fix: remove them from the cloud, or check cloud_unit"
        )


def _refuse(size_m: float, limits: tuple[float, float], what: str, how: str, key: str, unit: str) -> None:
    if is_plausible_size(size_m, limits):
        return
    shown = length_message(size_m)
    hint = f'the scale looks off by 1000: set {key} = "{_OTHER_UNIT[unit]}"'
    raise InputError(f'{what} {shown}{" " * bool(how)}{how} with {key} = "{unit}"; {hint}')


def _compare_motions(session: Session, flange: Array) -> None:
    """Labelled points have no size of their own, but a target that several views see moves with the arm."""
    seen = [view.sighting for view in session.views if view.sighting is not None]
    if len(seen) < 3 or session.has_clouds:
        return
    names = np.concatenate([sighting.targets for sighting in seen])
    points = np.concatenate([sighting.points for sighting in seen]) * METRES[session.length_unit]
    moved, arm = max(_extent(points[names == name]) for name in np.unique(names)), _extent(flange)
    # A target that one view sees has not moved at all.
    if min(moved, arm) > 0 and not 1 / _MOTION_RATIO < moved / arm < _MOTION_RATIO:
        raise InputError(
            f"{session.path / 'session.toml'}: the targets move over {moved * 1e3:.3g} mm, the flange over "
            f"{arm * 1e3:.3g} mm; the scale looks off by 1000: write poses and targets in length_unit "
            f'(is "{session.length_unit}")'
        )


def _extent(points: Array) -> float:
    """The longest side of the box around points."""
    return float(np.ptp(points, axis=0).max())


def _compare_standoff(session: Session, cloud_unit: str) -> None:
    """Against the working distance that the session itself states."""
    clouds = [view.cloud.points for view in session.views if view.cloud is not None]
    if not clouds or not session.scanner.standoff:
        return
    size = float(np.median([_trimmed_extent(points) for points in clouds]))
    distance = float(np.median([_median_distance(points) for points in clouds]))
    low, high = _FIELD_SIZE
    if size < low * session.scanner.standoff or max(size, distance) > high * session.scanner.standoff:
        raise InputError(
            f"{session.path / 'session.toml'}: points lie {distance:.3g} {session.length_unit} away over "
            f"{size:.3g}, but scanner.standoff is {session.scanner.standoff:.3g}; "
            f'the scale looks off by 1000: check cloud_unit (is "{cloud_unit}")'
        )
