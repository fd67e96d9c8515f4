"""Diagnose, add, and again, until nothing is left to add; then drop what later effects have made idle.

Or add a whole group of effects that the views cannot tell apart, where that helps.
"""

from dataclasses import replace

from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.selection.backward_elimination import find_effect_to_drop
from stitch.diagnosis.thresholds import HELDOUT_RISE, MANY_VIEWS
from stitch.diagnosis.validation.group_validation import group_helps, group_share
from stitch.pipeline import diagnose
from stitch.revision import change
from stitch.runs.run import Run
from stitch.runs.state import RunState, state_of
from stitch.writing.plain_finding import plain_finding


def suggest(state: RunState, at_most: int) -> tuple[Run | None, list[str], Diagnosis]:
    """The run with everything that the diagnosis names, the way in lines, and the last diagnosis.

    The run is None where nothing is named.

    An effect stays unless the held-out residual rises: the diagnosis has asked already whether it predicts the poses
    of views left out, and a small effect moves them by less than the sensor's noise shows in a residual. What is less
    likely than nothing being missing is not added. At the end
    effects that came early go, if those that came later explain the same; what was in the model before stays.
    """
    lines: list[str] = []
    result: Run | None = None
    found: Diagnosis | None = None
    given = set(state.model.effects)
    for _ in range(at_most):
        found = diagnose(state)
        lines += [*_finding_and_evidence(found), *(f"{note}." for note in found.notes if note not in found.sentence)]
        if found.verdict != "missing_effect":
            break
        if not found.likelier_than_not:
            name = found.effects[0]
            lines.append(f"{name} was not added: that it is chance is likelier. All the same: stitch add RUN {name}.")
            break
        tried = change(state, [*state.model.effects, found.effects[0]])
        if not _improves_heldout(state, tried):
            lines.append(f"{found.effects[0]} was tried and did not earn its place: the held-out residual rose.")
            break
        result, state = tried, state_of(tried)
        lines.append(f"Added {found.effects[0]}. With it:")
        # Of thousands of poses a diagnosis holds half a gigabyte of columns: gone before the next has its own.
        found = None
    else:
        lines.append(f"Stopped after {at_most} effects; run it again to go on.")
    if result is not None and not state.session.has_clouds and state.measurement.views.count >= MANY_VIEWS:
        result, dropped = _drop_unneeded(result, given)
        lines += dropped
        state, found = (state_of(result), None) if dropped else (state, found)
    return result, lines, diagnose(state) if found is None else found


def suggest_group(state: RunState) -> tuple[Run | None, list[str], Diagnosis]:
    """The run with all effects of a group that these views cannot tell apart, what to say of it, and the diagnosis.

    The run is None where the diagnosis names no such group, or where the group does not help on views left out.
    """
    found = diagnose(state)
    if found.verdict != "cannot_tell":
        return (
            None,
            [*_finding_and_evidence(found), "There is no group of effects that these views cannot tell apart."],
            found,
        )
    names = " + ".join(found.effects)
    asked = [c.ranked.score for c in found.candidates if c.name in found.effects]
    share, sigma = group_share(found.linear, asked)
    judged = f"of the mean square error of poses left out they leave {share:.2f} ± {sigma:.2f}"
    if not group_helps(share, sigma):
        return (
            None,
            [*_finding_and_evidence(found), f"{names} together do not help on views left out: {judged}."],
            found,
        )
    tried = change(state, [*state.model.effects, *found.effects])
    told = (
        f"{names} are fitted as one group: {judged}, and together they stand for what is missing; these views do not "
        "tell its parts apart, so that none of their values means anything alone"
    )
    tried = replace(tried, notes=(f"{told}.", *tried.notes))
    return tried, [*_finding_and_evidence(found), f"{told}."], diagnose(state_of(tried))


def _finding_and_evidence(found: Diagnosis) -> list[str]:
    """For everybody first, then the evidence, as `stitch diagnose` says it."""
    return [plain_finding(found, found.linear.measurement.length_unit), found.sentence]


def _drop_unneeded(result: Run, given: set[str]) -> tuple[Run, list[str]]:
    """The run without added effects that do not hold their place beside the others, and why each went."""
    lines: list[str] = []
    while (idle := find_effect_to_drop(state_of(result), set(result.effects) - given)) is not None:
        name, reason = idle
        lines.append(f"{reason}; it was dropped.")
        result = change(state_of(result), [other for other in result.effects if other != name])
    return result, lines


def _improves_heldout(state: RunState, tried: Run) -> bool:
    return not state.ledger or tried.heldout_rms < HELDOUT_RISE * state.ledger[-1].heldout_rms
