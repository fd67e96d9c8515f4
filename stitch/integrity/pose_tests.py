"""Tests of the poses of all views: which one is off under the scatter of the others, and from where on all are."""

from dataclasses import dataclass, field

from stitch.integrity.blunders import Blunder, Found, find_blunders, off_anyway
from stitch.integrity.step import Step
from stitch.integrity.steps import CHANCE, MANY_VIEWS, find_steps
from stitch.integrity.usual_effects import UsualEffects
from stitch.integrity.view_model import ViewModel
from stitch.observations.surfaces.free_poses import FreePoses


@dataclass(frozen=True)
class PoseTests:
    """What the poses of the views say by themselves."""

    homeless: list[int]
    off: list[Blunder]  # stand off whatever the others scatter
    found: Found  # the rest of them, under the scatter of the others
    steps: tuple[Step, ...]
    sure: set[int] = field(
        default_factory=set
    )  # of `off`, what effects of the arm do not explain in sizes that the others show

    @property
    def alone(self) -> list[int]:
        """Views that take no part in the tests of the others."""
        return [*self.homeless, *(b.view for b in self.off)]


def pose_tests(
    model: ViewModel,
    freed: FreePoses,
    unlinked: tuple[list[int], list[int]],
    usual: UsualEffects | None,
    chance: float = CHANCE,
) -> PoseTests:
    """Single views off and steps; where there is a step, single views once more beside it.

    Args:
        unlinked: views that nothing holds, and those that were placed by their surfaces.
        usual: what may happen to views beside white scatter; of many views it takes minutes to hold it against a step.
        chance: that a session without a step shows one.
    """
    homeless, placed = unlinked
    off = off_anyway(model, homeless, placed)
    found = find_blunders(model, [*homeless, *(b.view for b in off)])
    erring = model if usual is None or model.count >= MANY_VIEWS else model.with_errors(usual.errors(freed))
    steps = find_steps(erring, model.columns(homeless), (found.further, len(off) + len(found.blunders)), chance)
    if steps:
        # A view at the step may stand for one of its sides.
        off = off_anyway(model, homeless, placed, steps)
        found = find_blunders(model, [*homeless, *(b.view for b in off)], steps)
    sure = off_anyway(erring, homeless, [b.view for b in off], steps)
    return PoseTests(homeless, off, found, steps, {b.view for b in sure})
