"""Tests of the poses of all views: which one is off under the scatter of the others, and from where on all are."""

from dataclasses import dataclass, field

from stitch.integrity.blunders import Blunder, BlunderSearch, find_blunders, find_unlinked_blunders
from stitch.integrity.step import PoseStep
from stitch.integrity.steps import MAX_VIEWS_WITH_EFFECTS, STEP_CHANCE, find_steps
from stitch.integrity.usual_effects import UsualEffects
from stitch.integrity.view_model import ViewModel
from stitch.observations.surfaces.free_poses import UnconstrainedPoses


@dataclass(frozen=True)
class PoseTests:
    """What the poses of the views say by themselves."""

    unplaced: list[int]
    displaced: list[Blunder]  # stand off whatever the others scatter
    blunder_search: BlunderSearch  # the rest of them, under the scatter of the others
    steps: tuple[PoseStep, ...]
    sure: set[int] = field(
        default_factory=set
    )  # of `off`, what effects of the arm do not explain in sizes that the others show

    @property
    def excluded(self) -> list[int]:
        """Views that take no part in the tests of the others."""
        return [*self.unplaced, *(b.view for b in self.displaced)]


def pose_tests(
    model: ViewModel,
    unconstrained: UnconstrainedPoses,
    unlinked: tuple[list[int], list[int]],
    usual: UsualEffects | None,
    chance: float = STEP_CHANCE,
) -> PoseTests:
    """Single views off and steps; where there is a step, single views once more beside it.

    Args:
        unlinked: views that nothing holds, and those that were placed by their surfaces.
        usual: what may happen to views beside white scatter; of many views it takes minutes to hold it against a step.
        chance: that a session without a step shows one.
    """
    homeless, placed = unlinked
    off = find_unlinked_blunders(model, homeless, placed)
    found = find_blunders(model, [*homeless, *(b.view for b in off)])
    erring = (
        model
        if usual is None or model.count >= MAX_VIEWS_WITH_EFFECTS
        else model.with_errors(usual.errors(unconstrained))
    )
    steps = find_steps(erring, model.columns(homeless), (found.mean_columns, len(off) + len(found.blunders)), chance)
    if steps:
        # A view at the step may stand for one of its sides.
        off = find_unlinked_blunders(model, homeless, placed, steps)
        found = find_blunders(model, [*homeless, *(b.view for b in off)], steps)
    sure = find_unlinked_blunders(erring, homeless, [b.view for b in off], steps)
    return PoseTests(homeless, off, found, steps, {b.view for b in sure})
