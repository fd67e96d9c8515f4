"""Is the scale of a session right? Metres read as millimetres, or the reverse, are off by 1000.

Sizes and motions are judged, and how far things can lie; not how near: the origin of many structured-light and line
scanners lies in the middle of what they measure. A few clouds of another size than the others are wrong by themselves,
not by the session's unit.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stitch.errors import InputError, ScaleError
from stitch.numerics.frames import Array
from stitch.numerics.units import CLOUD_METRES, METRES
from stitch.session.session import SessionData

Limits = tuple[float, float]
# What one scan of a robot's scanner shows, in metres: from a borescope to a hull.
_SIZE_M = (3e-3, 20.0)
# How far the middle of a scan may lie from the sensor's origin, and any single point.
_RANGE_M = (0.0, 20.0)
_FARTHEST_M = 1000.0
# Trackers see as far as a hall is long.
_SIGHT_M = (0.0, 100.0)
# Reach of robots, in metres.
_REACH_M = (0.03, 60.0)
# A target moves about as far as the flange: not a few hundred times more or less.
_MOTION_RATIO = 300.0
# Fields of view over the working distance; a 1000 times less or more is another unit.
_FIELD_SIZE = (2e-3, 30.0)
_LISTED_CLOUDS = 4


def check_scale(session: SessionData, cloud_unit: str) -> None:
    """Refuse a session whose clouds, targets or poses are of a size that only makes sense in another unit.

    Args:
        cloud_unit: of the files of clouds, for messages; the clouds themselves are in length_unit.

    Raises:
        ScaleError: names the quantity, its size and the key to change.
    """
    metres = METRES[session.length_unit]
    toml = session.path / "session.toml"
    clouds = {view.name: view.cloud.points for view in session.views if view.cloud is not None}
    distances = {name: metres * _median_distance(points) for name, points in clouds.items()}
    extents = {name: metres * _trimmed_extent(points) for name, points in clouds.items()}
    for sizes, limits, predicate in ((distances, _RANGE_M, "lie {} away"), (extents, _SIZE_M, "extend over {}")):
        _require_one_unit(toml, sizes, limits, predicate, cloud_unit)
        for name, size in sizes.items():
            subject = f"{toml}: the points of view {name}"
            _require_plausible(size, limits, subject, predicate, "cloud_unit", cloud_unit)
    for view in session.views:
        if view.sighting is not None:
            distance = _median_distance(view.sighting.points) * metres
            subject = f"{toml}: the targets of view {view.name}"
            _require_plausible(distance, _SIGHT_M, subject, "lie {} away", "length_unit", session.length_unit)
    flange = np.array([view.T_base_flange[:3, 3] for view in session.views]) * metres
    if session.has_poses:
        # Axes alone may pass through the base's origin, and then nothing is far away.
        reach = float(np.linalg.norm(flange, axis=1).max())
        _require_plausible(
            reach, _REACH_M, f"{toml}: the flange", "stands at most {} away", "length_unit", session.length_unit
        )
    _compare_motions(session, flange)
    _compare_standoff(session, cloud_unit)


def require_near(where: str, points: Array) -> None:
    """Refuse points farther along an axis than any sensor measures: one would stretch every grid over the cloud.

    Args:
        where: file or scan, for the message.
        points: (N, 3) m, scanner frame; at least one.

    Raises:
        InputError: how many, and the number of the first, from 1.
    """
    if np.abs(points).max() > _FARTHEST_M:
        far = np.abs(points).max(axis=1) > _FARTHEST_M
        raise InputError(
            f"{where}: {far.sum()} of {len(points)} points lie more than {_FARTHEST_M:g} m from the scanner, the first "
            f"is point {int(far.argmax()) + 1}; to fix: remove them from the cloud, or check cloud_unit"
        )


def _require_one_unit(toml: Path, sizes: Mapping[str, float], limits: Limits, predicate: str, cloud_unit: str) -> None:
    """Refuse a few clouds whose size only makes sense in another unit, where most others have a plausible one.

    Args:
        toml: session.toml, for the message.
        sizes: view -> size of its cloud, m.
        limits: lowest and highest plausible size, m.
        predicate: words for the message with {} for the size, as "extend over {}".
        cloud_unit: of the files.

    Raises:
        ScaleError: names these views.
    """
    odd = {name: size for name, size in sizes.items() if not _is_plausible(size, limits)}
    others = [size for name, size in sizes.items() if name not in odd]
    if not odd or len(odd) > len(others):
        return
    names = ", ".join([*odd][:_LISTED_CLOUDS]) + (" …" if len(odd) > _LISTED_CLOUDS else "")
    size = _length_text(float(np.median([*odd.values()])))
    usual = _length_text(float(np.median(others)))
    one = "view", "that cloud alone is", "it"
    view, clouds_are, them = one if len(odd) == 1 else ("views", "those clouds are", "them")
    raise ScaleError(
        f"{toml}: the points of {view} {names} {predicate.format(size)}, those of the others (usually) {usual}, with "
        f'cloud_unit = "{cloud_unit}": {clouds_are} in another unit than the others; to fix: export {them} again in '
        f"{cloud_unit}",
        tuple(odd),
    )


def _require_plausible(size_m: float, limits: Limits, subject: str, predicate: str, key: str, unit: str) -> None:
    """Refuse a size that is not plausible.

    Args:
        size_m: m.
        limits: lowest and highest plausible size, m.
        subject, predicate: of the message, the latter with {} for the size, as "extend over {}".
        key, unit: the key of session.toml that may be wrong, and what it says now.

    Raises:
        ScaleError: with the other unit as the fix.
    """
    if not _is_plausible(size_m, limits):
        factors = {other: CLOUD_METRES[other] / CLOUD_METRES[unit] for other in METRES if other != unit}
        # What seems too small is in the largest other unit, what seems too large in the smallest.
        choose = max if size_m < limits[0] else min
        other = choose(factors, key=lambda name: factors[name])
        times = max(factors[other], 1 / factors[other])
        hint = f'the scale looks off by {times:.4g}: set {key} = "{other}"'
        raise ScaleError(f'{subject} {predicate.format(_length_text(size_m))} with {key} = "{unit}"; {hint}')


def _is_plausible(size_m: float, limits: Limits) -> bool:
    """Return whether a size, m, can be; 0 says nothing."""
    return limits[0] <= size_m <= limits[1] or size_m == 0


def _length_text(size_m: float) -> str:
    return f"{size_m * 1e3:.3g} mm" if size_m < 1 else f"{size_m:.3g} m"


def _compare_motions(session: SessionData, flange: Array) -> None:
    """Refuse a session of labelled points that move much more or less than the arm: the unit of one looks wrong.

    Single points have no size, but a target that several views see moves about as far as the arm. Passed over where
    there are clouds, or fewer than three views with points.

    Args:
        flange: (V, 3) positions of the flange, base frame, m.

    Raises:
        ScaleError: names both motions.
    """
    sightings = [view.sighting for view in session.views if view.sighting is not None]
    if len(sightings) < 3 or session.has_clouds:
        return
    names = np.concatenate([sighting.targets for sighting in sightings])
    points = np.concatenate([sighting.points for sighting in sightings]) * METRES[session.length_unit]
    moved = max(_extent(points[names == name]) for name in np.unique(names))
    arm = _extent(flange)
    # A target that one view sees has not moved at all.
    if min(moved, arm) > 0 and not 1 / _MOTION_RATIO < moved / arm < _MOTION_RATIO:
        raise ScaleError(
            f"{session.path / 'session.toml'}: the targets move over {moved * 1e3:.3g} mm, the flange over "
            f"{arm * 1e3:.3g} mm; the scale looks off by 1000: write poses and targets in length_unit "
            f'(is "{session.length_unit}")'
        )


def _compare_standoff(session: SessionData, cloud_unit: str) -> None:
    """Refuse scans whose size or distance contradicts the working distance that session.toml states, if it does.

    Raises:
        ScaleError: one of the two looks off by a factor of 1000.
    """
    clouds = [view.cloud.points for view in session.views if view.cloud is not None]
    standoff = session.scanner.standoff
    if not clouds or not standoff:
        return
    size = float(np.median([_trimmed_extent(points) for points in clouds]))
    distance = float(np.median([_median_distance(points) for points in clouds]))
    low, high = _FIELD_SIZE
    if size < low * standoff or max(size, distance) > high * standoff:
        raise ScaleError(
            f"{session.path / 'session.toml'}: points lie {distance:.3g} {session.length_unit} away over "
            f"{size:.3g}, but scanner.standoff is {standoff:.3g}; "
            f'the scale looks off by 1000: check cloud_unit (is "{cloud_unit}")'
        )


def _median_distance(points: Array) -> float:
    return float(np.median(np.linalg.norm(points, axis=1)))


def _extent(points: Array) -> float:
    """Return the longest side of the box around points (N, 3)."""
    return float(np.ptp(points, axis=0).max())


def _trimmed_extent(points: Array) -> float:
    """Return the longest side of the box around all but the outermost points (N, 3)."""
    low, high = np.percentile(points, (5, 95), axis=0)
    return float((high - low).max())
