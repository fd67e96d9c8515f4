"""A displacement that all views from one on share: what moved, by how much, and what to say of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stitch.frames import Array
from stitch.integrity.amounts import DisplacementSize, displacement_text
from stitch.integrity.smallest import rotation_shift_lower_bounds
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import hstack_columns, test_alternative

MovedBody = Literal["part", "scanner"]
MOVED_BODIES: tuple[MovedBody, MovedBody] = ("part", "scanner")
# −2 log likelihood of part against scanner at odds of 20 to 1; closer ones these views do not tell apart.
_DISTINGUISHABLE_DEVIANCE = 2 * np.log(20)


@dataclass(frozen=True)
class PoseStep:
    """From view `start` on all views share one displacement."""

    start: int
    moved: MovedBody
    distinguishable: bool  # the other one of the two is clearly less likely
    size: DisplacementSize  # of the displacement, of the middle of the part as it is seen
    at_least: DisplacementSize  # the smallest that is likely: along itself a part slides unseen
    p_value: float  # all change points counted

    def describe(self, names: Sequence[str], length_unit: str) -> str:
        """What happened and what to do, in words."""
        before, after = names[self.start - 1], names[self.start]
        off = displacement_text(self.size, self.at_least, length_unit)
        by = f"{off} off at the part" if off else "by how much these surfaces do not tell"
        other = "scanner" if self.moved == "part" else "part"
        unsure = "" if self.distinguishable else f" (or the {other}: these views do not tell which)"
        further = ", or add the effect part_slip" if self.moved == "part" and self.distinguishable else ""
        return (
            f"From view {after} on the {self.moved} sits elsewhere{unsure}, {by}: no hand-eye holds "
            f"before and after. Make two sessions of it, one up to {before} and one from {after} on{further}."
        )

    def columns(self, model: ViewModel) -> Array:
        """(n, 6) of the displacement."""
        return step_columns(model, self.start, self.moved)


def step_columns(model: ViewModel, start: int, moved: str) -> Array:
    """(n, 6) of a displacement that views from `start` on have in common."""
    return np.asarray((model.views if moved == "part" else model.mounts)[start:].sum(axis=0))


def likelier_step(model: ViewModel, columns: Array | None, best: dict[MovedBody, int], tests: int) -> PoseStep:
    """The likelier one of a step of the part and one of the scanner, with its size.

    Args:
        columns: (n, K) of what else there is.
        best: the view from which on each of the two would have moved.
        tests: how many steps were looked at.
    """
    own = {moved: hstack_columns(columns, step_columns(model, best[moved], moved)) for moved in MOVED_BODIES}
    deviance = {moved: model.deviance(own[moved]) for moved in MOVED_BODIES}
    likelier = min(MOVED_BODIES, key=lambda moved: deviance[moved])
    told = bool(abs(deviance["part"] - deviance["scanner"]) > _DISTINGUISHABLE_DEVIANCE)
    start = best[likelier]
    displaced = step_columns(model, start, likelier)
    p = test_alternative(projector(model, model.fit(columns), columns), displaced).p_value * tests
    under = projector(model, model.fit(own[likelier]), columns)
    tested = test_alternative(under, displaced)
    carried = model.mount_twists[start:] if likelier == "scanner" else np.eye(6)[None]
    least = [rotation_shift_lower_bounds(tested, under.degrees, own) for own in carried]
    turn, shift = np.median(least, axis=0)
    at_least = (float(turn) / model.lever, float(shift))
    return PoseStep(start, likelier, told, _median_size(carried @ tested.estimate, model.lever), at_least, p)


def _median_size(moved: Array, lever: float) -> DisplacementSize:
    """Of twists (S, 6), rotations in 1/lever, the usual one."""
    turn, shift = (float(np.median(np.linalg.norm(half, axis=1))) for half in (moved[:, :3], moved[:, 3:]))
    return turn / lever, shift
