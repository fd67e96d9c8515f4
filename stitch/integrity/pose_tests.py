"""Tests of the poses of all views: which one is off under the scatter of the others, and from where on all are."""

from dataclasses import dataclass

from stitch.integrity.blunders import Blunder, Found, find_blunders, off_anyway
from stitch.integrity.homes import Homes
from stitch.integrity.steps import CHANCE, MANY_VIEWS, Step, find_steps
from stitch.integrity.usual_effects import UsualEffects
from stitch.integrity.view_test import ViewModel


@dataclass(frozen=True)
class PoseTests:
    """What the poses of the views say by themselves."""

    homeless: list[int]
    off: list[Blunder]  # stand off whatever the others scatter
    found: Found  # the rest of them, under the scatter of the others
    steps: tuple[Step, ...]

    @property
    def alone(self) -> list[int]:
        """Views that take no part in the tests of the others."""
        return [*self.homeless, *(b.view for b in self.off)]


def pose_tests(model: ViewModel, homes: Homes, usual: UsualEffects | None) -> PoseTests:
    """Single views off and steps; where there is a step, single views once more beside it.

    Args:
        usual: what may happen to views beside white scatter; of many views it takes minutes to hold it against a step.
    """
    homeless, placed = homes.homeless, list(homes.placed)
    off = off_anyway(model, homeless, placed)
    tests = PoseTests(homeless, off, find_blunders(model, [*homeless, *(b.view for b in off)]), ())
    erring = model if usual is None or model.count >= MANY_VIEWS else model.with_errors(usual.errors(homes.freed))
    singles = (tests.found.further, len(off) + len(tests.found.blunders))
    steps = find_steps(erring, model.columns(homeless), singles, CHANCE)
    if not steps:
        return tests
    # A view at the step may stand for one of its sides.
    off = off_anyway(model, homeless, placed, steps)
    return PoseTests(homeless, off, find_blunders(model, [*homeless, *(b.view for b in off)], steps), steps)
