"""Whether a name stands before the views that took no part in choosing it."""

from collections.abc import Callable
from dataclasses import replace

from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.selection.verdict import Selection
from stitch.diagnosis.thresholds import BEYOND_CHANCE, STEADY
from stitch.diagnosis.validation.cross_validation import CrossValidation
from stitch.diagnosis.validation.halves import Halves


def validated(
    selection: Selection,
    found: dict[str, CrossValidation | None],
    in_halves: dict[str, Halves | None],
    wrong_anyway: Callable[[], bool],
) -> tuple[Selection, tuple[str, ...]]:
    """An effect that does not hold on views left out or in halves, or that one view carries, is not named; a second
    one may be.

    What is left then is below what matters, unless the scatter is one that no arm has, or the one view stands out
    beyond chance.
    """
    if selection.verdict != "missing_effect":
        return selection, selection.notes
    wrong, notes = list[bool](), list(selection.notes)
    for named in (selection.named[0], selection.second):
        if named is None:
            continue
        refusal = _refused(named, found.get(named.name), in_halves.get(named.name))
        if refusal is None:
            if named is selection.named[0]:
                return selection, selection.notes
            return replace(selection, named=(named,), second=None), tuple(notes)
        wrong.append(refusal[0])
        notes.append(refusal[1])
    verdict = "unknown_effect" if wrong[0] or wrong_anyway() else "adequate"
    nothing = Selection(verdict, (), selection.ranked, selection.empirical)
    return nothing, tuple(notes[: len(selection.notes) + 1])


def _refused(named: Ranked, left_out: CrossValidation | None, halves: Halves | None) -> tuple[bool, str] | None:
    """Why an effect does not stand the test of views left out, and whether something is wrong all the same."""
    if left_out is not None and left_out.steadiness < STEADY:
        note = f"{named.name} rests on a single view: without it {max(left_out.steadiness, 0):.0%} of it remain"
        return named.adjusted < BEYOND_CHANCE, note
    if left_out is not None and not left_out.helps:
        share = f"{left_out.poses:.2f} ± {left_out.poses_sigma:.2f}"
        return False, f"{named.name} would not help on views left out (mean square pose error {share} of now)"
    objection = None if halves is None else halves.objection(named.name)
    return None if objection is None else (False, objection)
