"""The chain of frames with effects in it: everything that a model needs to place the points.

    x_ref = part⁻¹( robot(q*) · mount* · sensor⁻¹(x) )

A capture keeps this form: `T_reference_mount` holds what stands left of the hand-eye, `T_behind_mount`
what stands right of it, and the points are those that sensor and part would have shown without effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.robot import Robot
from stitch.measurement.session import Mount, SensorKind, Session
from stitch.measurement.views import ScanView, Views, views_of

# Beyond 84° of incidence 1/cos α is noise of the normal; such points are not used anyway.
MIN_COSINE = 0.1
# Cosine of the angle from the axis beyond which no lens shows anything that measures, 75°.
_WIDEST = 0.26
# Points of a view that say where a sensor looks.
_ENOUGH = 1000


@dataclass(frozen=True)
class Measurement:
    """What was measured: everything that a model needs to place the points."""

    capture: Capture  # without any effect
    T_base_flange: Array  # (V, 4, 4) reported
    eye_to_hand: bool
    robot: Robot | None
    views: Views
    scan_views: tuple[ScanView, ...]
    length_unit: str
    target_views: tuple[ScanView, ...] = ()  # the same as `scan_views` for labelled points
    sensor: SensorKind | None = None  # as the session states it

    @property
    def mount(self) -> Mount:
        """eye_to_hand | eye_in_hand"""
        return "eye_to_hand" if self.eye_to_hand else "eye_in_hand"

    @property
    def has_intensity(self) -> bool:
        """True if every point has an intensity."""
        return bool(self.scan_views) and all(view.intensity is not None for view in self.scan_views)

    @cached_property
    def has_optics(self) -> bool:
        """True unless the sensor has no lens: a tracker, or the probe that it follows; if it is not stated, one that
        shows points where no lens looks, beside it or behind."""
        if self.sensor is not None:
            return self.sensor not in ("tracker", "probe")
        some = [points[:: 1 + len(points) // _ENOUGH] for points in self.capture.point_sets]
        if not some:
            return True
        shown = np.concatenate(some)
        ahead = shown[:, 2] / np.maximum(np.linalg.norm(shown, axis=1), 1e-300)
        # A stray point in a hundred says nothing.
        least, most = np.quantile(ahead, [0.01, 0.99])
        return bool(least > _WIDEST or most < -_WIDEST)

    @property
    def has_surfaces(self) -> bool:
        """True unless the sensor is known to see no surfaces, at no slant: a camera sees marks."""
        return self.sensor in (None, "area", "line")

    def without(self, left_out: Sequence[int]) -> "Measurement":
        """The measurement less some views; of the others numbers, rows before and first values stay as they were."""
        keep = [v for v in range(self.views.count) if v not in set(left_out)]
        views = self.views.only(keep)
        scan_views, target_views = (
            tuple(replace(own[v], index=i, views=views) for i, v in enumerate(keep)) if own else ()
            for own in (self.scan_views, self.target_views)
        )
        return replace(
            self,
            capture=self.capture.without(np.array(sorted(left_out), np.int64)),
            T_base_flange=self.T_base_flange[keep],
            views=views,
            scan_views=scan_views,
            target_views=target_views,
        )

    def __repr__(self) -> str:
        return f"Measurement({self.capture.name!r}, {self.views.count} views)"


def measurement_of(session: Session, capture: Capture) -> Measurement:
    """Collect a session and its prepared scans."""
    views = views_of(session)
    eye_to_hand = session.mount == "eye_to_hand"
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    down = downwards(session.robot, T_base_flange, eye_to_hand)
    intensity = _intensities(session)
    size = float(np.median([np.ptp(points, axis=0).max() for points in capture.point_sets])) or 1.0
    like = [ScanView(v, views, np.zeros(0), intensity[v], gravity=down[v], size=size) for v in range(views.count)]
    scan_views = [
        replace(like[v], cosine=np.maximum(scan.confidence, MIN_COSINE), eye=scan.eye)
        for v, scan in enumerate(capture.scans)
    ]
    target_views: list[ScanView] = []
    if capture.sightings is not None:
        # Nobody knows at what slant a target was seen, or how bright: effects of these have nothing to say about it.
        straight = np.ones(capture.sightings.used.shape[1])
        usual = None if intensity[0] is None else np.zeros(len(straight))
        target_views = [replace(view, cosine=straight, intensity=usual) for view in like]
    return Measurement(
        capture=capture,
        T_base_flange=T_base_flange,
        eye_to_hand=eye_to_hand,
        robot=session.robot,
        views=views,
        scan_views=tuple(scan_views),
        length_unit=session.length_unit,
        target_views=tuple(target_views),
        sensor=session.scanner.kind,
    )


def downwards(robot: Robot | None, T_base_flange: Array, eye_to_hand: bool) -> Array:
    """(V, 3) unit vector of gravity in the reference frame."""
    gravity = np.array([0.0, 0.0, -1.0])
    if robot is not None and np.linalg.norm(robot.gravity) > 0:
        gravity = robot.gravity / np.linalg.norm(robot.gravity)
    if not eye_to_hand:
        return np.tile(gravity, (len(T_base_flange), 1))
    return np.asarray(frames.rotate(frames.inverse(T_base_flange), gravity[None])[:, 0])


def with_part_origin(measurement: Measurement, T_mount: Array) -> Measurement:
    """The measurement with the origin about which a part grows; a coarse hand-eye is enough.

    On the flange that is the flange, which holds it; in the cell it is the middle of what the views show.
    """
    if measurement.eye_to_hand:
        return measurement
    views = zip(measurement.capture.poses(T_mount), measurement.capture.visible_points, strict=True)
    origin = np.mean([frames.transform(T, points).mean(axis=0) for T, points in views if len(points)], axis=0)
    scan_views, target_views = (
        tuple(replace(v, origin=origin) for v in w) for w in (measurement.scan_views, measurement.target_views)
    )
    return replace(measurement, scan_views=scan_views, target_views=target_views)


def intensity_scale(session: Session) -> tuple[float, float] | None:
    """Mean and standard deviation over all points in memory; None where some have none, or all the same."""
    raw = [None if v.cloud is None else v.cloud.scalars.get("intensity") for v in session.views]
    if any(values is None for values in raw):
        return None
    everything = np.concatenate([values for values in raw if values is not None])
    # One value that is not finite would spoil the mean of all: intensity then counts as absent, in every view.
    if not np.isfinite(everything).all() or everything.std() <= 0:
        return None
    return float(everything.mean()), float(everything.std())


def _intensities(session: Session) -> list[Array | None]:
    """Standardised over the session: (I − Ī)/σ_I."""
    scale = intensity_scale(session)
    clouds = [None if scale is None else view.cloud for view in session.views]
    return [None if c is None or scale is None else (c.scalars["intensity"] - scale[0]) / scale[1] for c in clouds]
