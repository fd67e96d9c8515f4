"""A displacement that all views from one on share: what moved, by how much, and what to say of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stitch.frames import Array
from stitch.integrity.amounts import Size, off_by
from stitch.integrity.smallest import smallest_parts
from stitch.integrity.view_model import ViewModel, projector
from stitch.integrity.view_test import beside, test

What = Literal["part", "scanner"]
BOTH: tuple[What, What] = ("part", "scanner")
# −2 log likelihood of part against scanner at odds of 20 to 1; closer ones these views do not tell apart.
_TOLD = 2 * np.log(20)


@dataclass(frozen=True)
class Step:
    """From view `start` on all views share one displacement."""

    start: int
    moved: What
    told: bool  # the other one of the two is clearly less likely
    size: Size  # of the displacement, of the middle of the part as it is seen
    at_least: Size  # the smallest that is likely: along itself a part slides unseen
    p_value: float  # all change points counted

    def said(self, names: Sequence[str], length_unit: str) -> str:
        """What happened and what to do, in words."""
        before, after = names[self.start - 1], names[self.start]
        off = off_by(self.size, self.at_least, length_unit)
        by = f"{off} off at the part" if off else "by how much these surfaces do not tell"
        other = "scanner" if self.moved == "part" else "part"
        unsure = "" if self.told else f" (or the {other}: these views do not tell which)"
        further = ", or add the effect part_slip" if self.moved == "part" and self.told else ""
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


def likelier_step(model: ViewModel, columns: Array | None, best: dict[What, int], tests: int) -> Step:
    """The likelier one of a step of the part and one of the scanner, with its size.

    Args:
        columns: (n, K) of what else there is.
        best: the view from which on each of the two would have moved.
        tests: how many steps were looked at.
    """
    own = {moved: beside(columns, step_columns(model, best[moved], moved)) for moved in BOTH}
    deviance = {moved: model.deviance(own[moved]) for moved in BOTH}
    likelier = min(BOTH, key=lambda moved: deviance[moved])
    told = bool(abs(deviance["part"] - deviance["scanner"]) > _TOLD)
    start = best[likelier]
    displaced = step_columns(model, start, likelier)
    p = test(projector(model, model.fit(columns), columns), displaced).p_value * tests
    under = projector(model, model.fit(own[likelier]), columns)
    tested = test(under, displaced)
    carried = model.mount_twists[start:] if likelier == "scanner" else np.eye(6)[None]
    least = [smallest_parts(tested, under.degrees, own) for own in carried]
    turn, shift = np.median(least, axis=0)
    at_least = (float(turn) / model.lever, float(shift))
    return Step(start, likelier, told, _size(carried @ tested.estimate, model.lever), at_least, p)


def _size(moved: Array, lever: float) -> Size:
    """Of twists (S, 6), rotations in 1/lever, the usual one."""
    turn, shift = (float(np.median(np.linalg.norm(half, axis=1))) for half in (moved[:, :3], moved[:, 3:]))
    return turn / lever, shift
