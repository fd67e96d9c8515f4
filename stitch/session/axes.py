"""External axes: turntable, tilt-and-turn positioner, rail, gantry; what they do to the chain of frames.

An axis carries the robot, the part or the scanner. With A = A_1·A_2·… the product of exponentials of the axes of one
kind, in the order in which session.toml states them (Brockett 1984), each in the base frame with all axes at zero:

    x_ref = A_part⁻¹ · A_robot · T_base_flange · T_flange_scanner · x           eye_in_hand
    x_ref = T_base_flange⁻¹ · A_robot⁻¹ · A_scanner · T_base_scanner · x        eye_to_hand

Either is that of a robot with T_base_flange' = A_left⁻¹ · A_right · T_base_flange, the effective pose: a view holds
this one, and all that follows sees no difference. Without a robot the axes are the robot: T_base_flange = 1, and those
of the part stand right. Their frame then is that of the first rotary axis, along z at its zero, and the hand-eye says
where it stands.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.numerics.units import METRES
from stitch.system.values import take_rows

KINDS = ("rotary", "linear")


@dataclass(frozen=True)
class Axis:
    """One axis as the session states it; lengths in length_unit."""

    name: str
    kind: str  # rotary | linear
    carries: str  # part | robot | scanner
    direction: Array | None = None  # (3,) unit vector, base frame with all axes at zero; None: to be found
    point: Array | None = None  # (3,) on a rotary axis; None: to be found
    is_fixed: bool = False  # used as given

    @property
    def is_rotary(self) -> bool:
        """True if its readings are angles."""
        return self.kind == "rotary"

    @property
    def is_placed(self) -> bool:
        """True if direction, and point of a rotary axis, are known: at least a start for the fit."""
        return self.direction is not None and (self.point is not None or not self.is_rotary)

    def columns(self, length_unit: str) -> dict[str, float]:
        """Return the columns of views.csv that may hold its readings -> factor to rad or length_unit."""
        if self.is_rotary:
            return {f"{self.name}_deg": np.pi / 180}
        return {f"{self.name}_{unit}": metres / METRES[length_unit] for unit, metres in METRES.items()}

    @property
    def frame(self) -> Array:
        """T_base_axis (4, 4) of a placed axis: z along its direction, the origin at its point, or the base's origin."""
        assert self.direction is not None
        z = self.direction
        # x close to the axis of the base that is most across z: a table of vertical axis has the base's directions.
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x = x / np.linalg.norm(x)
        return frames.make(np.column_stack([x, np.cross(z, x), z]), np.zeros(3) if self.point is None else self.point)


@dataclass(frozen=True)
class AxisMotion:
    """How K axes move in V views, errors included: effects of the model change it."""

    readings: Array  # (V, K) rad or length_unit
    placement: Array  # (K, 6) twist of the axis from its stated place, axis frame
    along: Array  # (K, 3) rad by which a carriage turns per length_unit of its way, axis frame
    error: Array  # (V, K, 6) twist in addition to the axis' own motion, axis frame


@dataclass(frozen=True)
class Axes:
    """All axes of a session and their readings; empty without any."""

    axes: tuple[Axis, ...] = ()
    readings: Array = field(default_factory=partial(np.zeros, (0, 0)))  # (V, K) rad or length_unit
    approach: Array = field(default_factory=partial(np.zeros, (0, 0)))  # (V, K) −1, 0, +1: sign of the last move
    has_robot: bool = True
    length_unit: str = "mm"

    def __bool__(self) -> bool:
        return bool(self.axes)

    @property
    def rotary(self) -> Mask:
        """(K,) bool."""
        return np.array([axis.is_rotary for axis in self.axes], bool)

    @property
    def per_metre(self) -> float:
        """Length units per metre."""
        return 1 / METRES[self.length_unit]

    @property
    def frame_axis(self) -> int:
        """Index of the axis in whose frame all are given where there is no robot: the first rotary one, else the first.

        −1 with a robot: then all are given in its base frame.
        """
        if self.has_robot or not self.axes:
            return -1
        return next((k for k, axis in enumerate(self.axes) if axis.is_rotary), 0)

    def stands_right(self, axis: Axis) -> bool:
        """Return True if an axis is a factor of A_right in T_base_flange' = A_left⁻¹ · A_right · T_base_flange."""
        return axis.carries == ("robot" if self.has_robot else "part")

    def as_read(self) -> AxisMotion:
        """Return the motion of the axes as their readings say, without errors."""
        V, K = self.readings.shape
        return AxisMotion(self.readings, np.zeros((K, 6)), np.zeros((K, 3)), np.zeros((V, K, 6)))

    def sides(self, motion: AxisMotion | None = None) -> tuple[Array, Array]:
        """Return A_left and A_right (V, 4, 4) of T_base_flange' = A_left⁻¹ · A_right · T_base_flange, base frame.

        Each is the product F·exp(error)·exp(motion)·F⁻¹ of its axes, with F = T_base_axis. An axis whose place is not
        known yet counts as standing still.

        Args:
            motion: None: as read, without errors.
        """
        motion = motion or self.as_read()
        count = len(motion.readings)
        left = right = np.tile(np.eye(4), (count, 1, 1))
        for k, axis in enumerate(self.axes):
            if not axis.is_placed:
                continue
            F = axis.frame @ frames.exp(motion.placement[k])
            moved = F @ frames.exp(motion.error[:, k]) @ frames.exp(self._screw(motion, k)) @ frames.inverse(F)
            if self.stands_right(axis):
                right = right @ moved
            else:
                left = left @ moved
        return left, right

    def _screw(self, motion: AxisMotion, k: int) -> Array:
        """Return the twists (V, 6) of axis k by its readings: about or along z of its frame, with a carriage's tilt."""
        twist = np.zeros((len(motion.readings), 6))
        twist[:, 2 if self.axes[k].is_rotary else 5] = motion.readings[:, k]
        twist[:, :3] += motion.readings[:, k, None] * motion.along[k]
        return twist

    def carried(self, motion: AxisMotion | None = None) -> Array:
        """Return A_left⁻¹ · A_right (V, 4, 4): multiplied from the left it makes T_base_flange the effective pose."""
        left, right = self.sides(motion)
        return frames.inverse(left) @ right

    def correction(self, motion: AxisMotion) -> Array:
        """Return (V, 4, 4), multiplied from the left, from the effective poses as read to those under `motion`."""
        return self.carried(motion) @ frames.inverse(self.carried())

    def only(self, keep: Sequence[int]) -> "Axes":
        """Return the axes with the readings of some of the views, by index."""
        return take_rows(self, list(keep), "readings", "approach")

    def standing(self, count: int) -> "Axes":
        """Return the axes for `count` further views in which they stand where they do in the last view."""
        approach = np.zeros((count, len(self.axes)))
        return replace(self, readings=np.repeat(self.readings[-1:], count, axis=0), approach=approach)

    def with_more(self, more: "Axes") -> "Axes":
        """Return the axes with the readings of these views, followed by those of others."""
        readings = np.concatenate([self.readings, more.readings])
        return replace(self, readings=readings, approach=np.concatenate([self.approach, more.approach]))

    def placed(self, motion: AxisMotion) -> tuple[Axis, ...]:
        """Return the axes with direction and point moved by the placement of a motion; all must be placed."""
        out = []
        for k, axis in enumerate(self.axes):
            F = axis.frame @ frames.exp(motion.placement[k])
            out.append(replace(axis, direction=F[:3, 2], point=F[:3, 3] if axis.is_rotary else None))
        return tuple(out)
