"""Effects added to a run one after the other: by name, or what the diagnosis names as long as it earns its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

from stitch.api.pipeline import change, diagnose
from stitch.effects.contract import find_effect, require_available
from stitch.errors import InputError
from stitch.recorder import Recorder
from stitch.run_data import RunData

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis, Finding


def effects_with(run: RunData, further: Sequence[str], where: object) -> list[str]:
    """Return the effects of a run's model and further ones, for `change`.

    Args:
        where: name of the run, for messages.

    Raises:
        InputError: an effect that is not known, that the session cannot have, or that is in the model already.
    """
    for name in further:
        require_available(run.measurement, find_effect(name))
        if name in run.effects:
            raise InputError(f"{where}: {name} is in its model already; to fix: leave it out")
    return [*run.effects, *further]


def with_prediction(run: RunData, heldout_rms: float) -> RunData:
    """Return the run with the error that a diagnosis predicted of the last change of its model; NaN: it did not."""
    if not isfinite(heldout_rms):
        return run
    return replace(run, ledger=(*run.ledger[:-1], replace(run.ledger[-1], predicted=heldout_rms)))


def effects_without(run: RunData, dropped: Sequence[str], where: object) -> list[str]:
    """Return the effects of a run's model but some, for `change`.

    Raises:
        InputError: an effect that is not in the model.
    """
    for name in dropped:
        if name not in run.effects:
            has = f"name one of {', '.join(run.effects)}" if run.effects else "leave it out: the model has no effects"
            raise InputError(f"{where}: {name} is not in its model; to fix: {has}")
    return [name for name in run.effects if name not in dropped]


def suggest(
    state: RunData, at_most: int, known: Finding | None = None, recorder: Recorder | None = None
) -> tuple[RunData | None, list[str], Diagnosis]:
    """Return the run with everything that the diagnosis names, what happened in lines, and the last diagnosis.

    The run is None where nothing is named. What was found together is added together, and what does not hold its place
    beside the rest goes again. An effect stays if it lowers the error on views left out beyond its uncertainty
    (`CrossValidation.fit_rejection_reason`); one that was dropped in this run is not tried again. What is less likely
    than nothing being missing is not added. What was in the model before stays; what was added gives way to other
    effects that together do better.

    Args:
        known: what a diagnosis of this state has named to be added; None: it is diagnosed.
        recorder: told of every run that is tried, one after the other.
    """
    lines: list[str] = []
    given = set(state.model.effects)
    left = at_most
    result: RunData | None = None
    while True:
        diagnosis = None if known is not None and left else diagnose(state)
        finding = known if diagnosis is None else _finding_of(diagnosis)
        assert finding is not None
        lines += finding.lines
        if diagnosis is not None and (why := _reason_to_stop(diagnosis, left, at_most)) is not None:
            fewer, happened = (None, []) if result is None else _drop_idle(result, given, recorder)
            if fewer is None or not happened:
                return result, [*lines, *why], diagnosis
            # In their place others may be added.
            lines += happened
            left += len(happened)
            state = result = fewer
            continue
        known = None
        before = result
        result, happened = _add_found(state, finding, left, given, recorder)
        lines += happened
        added = set(result.effects) - set(state.effects)
        if not added:
            return before, lines, replace(diagnosis or diagnose(state), tried=result.tried)
        left -= min(len(added), left)
        if set(state.effects) - given:
            result, happened = _exchange_added(result, given, recorder)
            lines += happened
        state = result
        # Of thousands of poses a diagnosis holds half a gigabyte of columns: gone before the next has its own.
        del diagnosis


def _finding_of(diagnosis: Diagnosis) -> Finding:
    """Return what a diagnosis says in sentences, with what it says of several sessions and of views left out."""

    from stitch.diagnosis.diagnosis import Finding

    notes = (f"{note}." for note in diagnosis.notes if note not in diagnosis.sentence)
    validations = {c.name: c.cross_validation for c in diagnosis.candidates if c.cross_validation is not None}
    return Finding((*_finding_and_evidence(diagnosis), *notes), diagnosis.together, validations)


def _reason_to_stop(diagnosis: Diagnosis, left: int, at_most: int) -> list[str] | None:
    """Return why nothing is added after a diagnosis, in lines; None where something is."""
    if diagnosis.verdict != "missing_effect":
        return []
    name = diagnosis.effects[0]
    if not diagnosis.likelier_than_not:
        return [f"{name} was not added: chance is more likely. To add it anyway: stitch add RUN {name}."]
    if diagnosis.dropped_before is not None:
        return [f"{name} was dropped in this run before. To add it all the same: stitch add RUN {name}."]
    effects = "1 effect" if at_most == 1 else f"{at_most} effects"
    return None if left else [f"Stopped after {effects}; run it again to go on."]


def _add_found(
    state: RunData, finding: Finding, at_most: int, given: set[str], recorder: Recorder | None
) -> tuple[RunData, list[str]]:
    """Return the run with what was found together, as far as it earns its place, and what happened.

    Args:
        given: effects that stay in any case.
    """
    from stitch.diagnosis.thresholds import FAINT_SIGMAS

    names = [name for name in finding.names if name not in state.tried][:at_most]
    while names:
        tried, lines = _drop_unneeded(change(state, [*state.effects, *names], recorder), given, recorder)
        kept = [name for name in names if name in tried.effects]
        share = (tried.heldout_rms / state.heldout_or_fit_rms) ** 2
        validation = finding.validations.get(names[0])
        zero = max((t.sigmas_from_zero for t in tried.terms if t.name in kept), default=0.0) < FAINT_SIGMAS
        reason = validation.fit_rejection_reason(" and ".join(kept), share, zero=zero) if validation and kept else None
        if kept and reason is None:
            share_then = finding.validations[kept[0]].heldout if kept == [names[0]] and validation else float("nan")
            told = with_prediction(tried, state.heldout_or_fit_rms * share_then**0.5)
            return told, [*lines, f"Added {' and '.join(kept)}. With it:"]
        if len(names) == 1:
            why = reason or tried.tried[names[0]]
            dropped = replace(state, tried=state.tried | tried.tried | {names[0]: why})
            return dropped, [f"{names[0]} was tried and dropped: {why}."]
        # Together they do not earn their place: the one that is named is asked alone.
        names = names[:1]
    return state, []


def _exchange_added(state: RunData, given: set[str], recorder: Recorder | None = None) -> tuple[RunData, list[str]]:
    """Return the run with others in place of effects that were added in several rounds, where these do better, and
    what happened: what was found first may hold the parameters of what would have come later.

    Of labelled points alone, as where effects are dropped.
    """
    from stitch.diagnosis.stepwise_selection import find_better_effects
    from stitch.diagnosis.thresholds import HELDOUT_FALL

    added = [name for name in state.effects if name not in given]
    names = [] if state.session.has_clouds else find_better_effects(state, added)
    if not names:
        return state, []
    tried = change(state, [*(name for name in state.effects if name in given), *names], recorder)
    if tried.heldout_rms >= HELDOUT_FALL * state.heldout_or_fit_rms:
        return state, []
    gone = " and ".join(name for name in added if name not in names)
    return tried, [f"{' and '.join(names)}: views left out are predicted better than with {gone}, which went."]


def suggest_group(state: RunData, recorder: Recorder | None = None) -> tuple[RunData | None, list[str], Diagnosis]:
    """Return the run with all effects of an undecided group, what to say of it, and the diagnosis.

    The run is None where the diagnosis names no such group, or where the group does not help on views left out.
    """
    from stitch.diagnosis.validation import group_helps, group_share

    diagnosis = diagnose(state)
    evidence = _finding_and_evidence(diagnosis)
    if diagnosis.verdict != "cannot_tell":
        return None, [*evidence, "These views leave no group of effects undecided."], diagnosis
    names = " + ".join(diagnosis.effects)
    asked = [c.ranked.score for c in diagnosis.candidates if c.name in diagnosis.effects]
    share, sigma = group_share(diagnosis.linear, asked)
    judged = f"of the mean square error of poses left out they leave {share:.2f} ± {sigma:.2f}"
    if not group_helps(share, sigma):
        return None, [*evidence, f"{names} together do not help on views left out: {judged}."], diagnosis
    tried = change(state, [*state.model.effects, *diagnosis.effects], recorder)
    sentence = (
        f"{names} are fitted as one group: {judged}, and together they stand for what is missing; these views do not "
        "tell its parts apart, so that none of their values means anything alone"
    )
    tried = tried.with_fit(notes=(f"{sentence}.", *tried.notes))
    return tried, [*evidence, f"{sentence}."], diagnose(tried)


def _finding_and_evidence(diagnosis: Diagnosis) -> list[str]:
    """Return the plain finding and the evidence, as `stitch diagnose` prints them."""
    from stitch.output.plain_finding import plain_finding

    return [plain_finding(diagnosis, diagnosis.linear.measurement.length_unit), diagnosis.sentence]


def _drop_idle(result: RunData, given: set[str], recorder: Recorder | None) -> tuple[RunData, list[str]]:
    """Return the run without added effects of which in the end no parameter differs from zero, or without which views
    left out are predicted better, and what was dropped.

    Scans are matched anew without an effect, which alone changes what views left out say: there it must be clear.
    """
    from stitch.diagnosis.thresholds import FAINT_SIGMAS, HELDOUT_RISE

    lines: list[str] = []
    while True:
        added = [term for term in result.terms if term.name in result.model.effects and term.name not in given]
        fewer = {t.name: [name for name in result.effects if name != t.name] for t in added}
        faint = next((term.name for term in added if term.sigmas_from_zero < FAINT_SIGMAS), None)
        if faint is not None:
            without = {faint: change(result, fewer[faint])}
            reason = f"{faint} ends with no parameter that differs from zero"
        else:
            without = {name: change(result, others) for name, others in fewer.items()}
            faint = min(without, key=lambda name: without[name].heldout_or_fit_rms, default=None)
            least = 1.0 if faint is None else without[faint].heldout_or_fit_rms / result.heldout_or_fit_rms
            if faint is None or least * (HELDOUT_RISE if result.session.has_clouds else 1.0) >= 1.0:
                return result, lines
            reason = f"without {faint} views left out are predicted better in the end"
        lines.append(f"{reason}; it was dropped.")
        if recorder is not None:
            without[faint] = change(result, fewer[faint], recorder)
        result = replace(without[faint], tried=result.tried | {faint: reason})


def _drop_unneeded(result: RunData, given: set[str], recorder: Recorder | None) -> tuple[RunData, list[str]]:
    """Return the run without added effects that others made idle, which it remembers, and why each was dropped.

    Of labelled points alone: scans are matched anew for every effect that is asked.
    """
    from stitch.diagnosis.stepwise_selection import find_effect_to_drop

    lines: list[str] = []
    while not result.session.has_clouds and len(added := set(result.effects) - given) > 1:
        idle = find_effect_to_drop(result, added)
        if idle is None:
            break
        name, reason = idle
        lines.append(f"{reason}; it was dropped.")
        fewer = change(result, [other for other in result.effects if other != name], recorder)
        result = replace(fewer, tried=result.tried | {name: reason})
    return result, lines
