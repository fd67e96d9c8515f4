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
        """True if it is known from where to start."""
        return self.direction is not None and (self.point is not None or not self.is_rotary)

    def columns(self, length_unit: str) -> dict[str, float]:
        """Return the columns of views.csv in which its readings may stand, and how much one of them is."""
        if self.is_rotary:
            return {f"{self.name}_deg": np.pi / 180}
        return {f"{self.name}_{unit}": metres / METRES[length_unit] for unit, metres in METRES.items()}

    @property
    def frame(self) -> Array:
        """(4, 4) with z along the axis, about which errors of the axis are counted."""
        assert self.direction is not None
        z = self.direction
        # The world's axis that is farthest from it: a table's frame stands as the base's.
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x = x / np.linalg.norm(x)
        return frames.make(np.column_stack([x, np.cross(z, x), z]), np.zeros(3) if self.point is None else self.point)


@dataclass(frozen=True)
class AxisMotion:
    """How K axes move in V views: effects change it."""

    readings: Array  # (V, K) rad or length_unit
    placement: Array  # (K, 6) twist of the axis in its frame
    along: Array  # (K, 3) rad by which a carriage turns per length_unit of its way, axis frame
    error: Array  # (V, K, 6) twist beside the axis' own motion, axis frame


@dataclass(frozen=True)
class Axes:
    """All axes of a session and their readings; empty without any."""

    axes: tuple[Axis, ...] = ()
    readings: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (V, K) rad or length_unit
    approach: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (V, K) −1, 0, +1
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
        """Lengths in a metre."""
        return 1 / METRES[self.length_unit]

    @property
    def own(self) -> int:
        """Index of the axis whose frame is that of the others, where there is no robot; −1 with one."""
        if self.has_robot or not self.axes:
            return -1
        return next((k for k, axis in enumerate(self.axes) if axis.is_rotary), 0)

    @property
    def are_placed(self) -> bool:
        """True if it is known of all axes from where to start."""
        return all(axis.is_placed for axis in self.axes)

    def stands_right(self, axis: Axis) -> bool:
        """Return whether an axis is a factor of A_right."""
        return axis.carries == ("robot" if self.has_robot else "part")

    def as_read(self) -> AxisMotion:
        """Return the motion without errors."""
        V, K = self.readings.shape
        return AxisMotion(self.readings, np.zeros((K, 6)), np.zeros((K, 3)), np.zeros((V, K, 6)))

    def sides(self, motion: AxisMotion | None = None) -> tuple[Array, Array]:
        """Return A_left and A_right, (V, 4, 4) each; an axis that nobody has placed yet stands still in them."""
        motion = motion or self.as_read()
        count = len(motion.readings)
        left = np.tile(np.eye(4), (count, 1, 1))
        right = left
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
        """Return the twists (V, 6) by which an axis moves, in its frame."""
        twist = np.zeros((len(motion.readings), 6))
        twist[:, 2 if self.axes[k].is_rotary else 5] = motion.readings[:, k]
        twist[:, :3] += motion.readings[:, k, None] * motion.along[k]
        return twist

    def carried(self, motion: AxisMotion | None = None) -> Array:
        """Return A_left⁻¹ · A_right (V, 4, 4), by which T_base_flange becomes the effective one."""
        left, right = self.sides(motion)
        return frames.inverse(left) @ right

    def correction(self, motion: AxisMotion) -> Array:
        """Return (V, 4, 4) from the left by which the effective poses change where the axes move otherwise."""
        return self.carried(motion) @ frames.inverse(self.carried())

    def only(self, keep: Sequence[int]) -> "Axes":
        """Return the axes in some of the views."""
        return take_rows(self, list(keep), "readings", "approach")

    def standing(self, count: int) -> "Axes":
        """Return the axes in so many views in which they stand as in the last one."""
        approach = np.zeros((count, len(self.axes)))
        return replace(self, readings=np.repeat(self.readings[-1:], count, axis=0), approach=approach)

    def with_more(self, more: "Axes") -> "Axes":
        """Return the axes in these views and then in others."""
        readings = np.concatenate([self.readings, more.readings])
        return replace(self, readings=readings, approach=np.concatenate([self.approach, more.approach]))

    def placed(self, motion: AxisMotion) -> tuple[Axis, ...]:
        """Return the axes where a placement puts them."""
        out = []
        for k, axis in enumerate(self.axes):
            F = axis.frame @ frames.exp(motion.placement[k])
            out.append(replace(axis, direction=F[:3, 2], point=F[:3, 3] if axis.is_rotary else None))
        return tuple(out)
