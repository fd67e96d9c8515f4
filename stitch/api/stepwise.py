"""Effects added to a run one after the other: by name, or what the diagnosis names as long as it earns its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING

from stitch.api.pipeline import change, diagnose, error_with
from stitch.effects.contract import find_effect, require_available
from stitch.errors import InputError
from stitch.recorder import Recorder
from stitch.run_data import RunData

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis, Finding


def effects_with(run: RunData, further: Sequence[str], where: object) -> list[str]:
    """Return the names of the effects in a run's model and further ones: the argument that `change` takes.

    Args:
        further: names of effects to add.
        where: name or folder of the run, the beginning of messages.

    Raises:
        InputError: an effect that is not known, that the session cannot have, or that is in the model already.
    """
    for name in further:
        require_available(run.measurement, find_effect(name))
        if name in run.effects:
            raise InputError(f"{where}: {name} is in its model already; to fix: leave it out")
    return [*run.effects, *further]


def with_prediction(run: RunData, heldout_rms: float) -> RunData:
    """Return the run with, in the last step of its ledger, the error on views left out that a diagnosis predicted.

    Args:
        heldout_rms: length_unit; NaN: the diagnosis predicted none, and the run is returned as it is.
    """
    if not isfinite(heldout_rms):
        return run
    return replace(run, ledger=(*run.ledger[:-1], replace(run.ledger[-1], predicted=heldout_rms)))


def effects_without(run: RunData, dropped: Sequence[str], where: object) -> list[str]:
    """Return the names of the effects in a run's model without some: the argument that `change` takes.

    Args:
        dropped: names of effects to take out.
        where: name or folder of the run, the beginning of messages.

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

    The run is None where nothing is named. Each round diagnoses, adds the effects that the diagnosis names together,
    and drops those that the others make unnecessary. An effect stays if it lowers the error on views left out beyond
    its uncertainty (`CrossValidation.fit_rejection_reason`); one that was dropped in this run is not tried again. An
    effect that is less likely than none is not added. Effects that were in the model at first stay; added ones are
    exchanged for others that predict better. The rounds end when the diagnosis names nothing new, when an addition
    fails, or when `at_most` effects are added.

    Args:
        at_most: number of effects that may be added.
        known: what an earlier diagnosis of this state has named to be added; None: it is diagnosed.
        recorder: told of every run that is tried, one after the other.
    """
    lines: list[str] = []
    given = set(state.model.effects)
    remaining = at_most
    # The last run to which something was added; `state` is the one that is diagnosed.
    result: RunData | None = None
    while True:
        diagnosis = None if known is not None and remaining else diagnose(state)
        finding = known if diagnosis is None else _finding_of(diagnosis)
        assert finding is not None
        lines += finding.lines
        if diagnosis is not None and (why := _reason_to_stop(diagnosis, remaining, at_most)) is not None:
            if result is None:
                return None, [*lines, *why], diagnosis
            result, drops = _drop_idle(result, given, recorder)
            if not drops:
                return result, [*lines, *why], diagnosis
            # Effects that turned out to be zero were dropped: the next diagnosis may name others in their place.
            lines += drops
            remaining += len(drops)
            state = result
            continue
        # What was known holds of the first state alone.
        known = None
        fitted, attempts = _add_found(state, finding, remaining, given, recorder)
        lines += attempts
        added = set(fitted.effects) - set(state.effects)
        if not added:
            return result, lines, replace(diagnosis or diagnose(state), tried=fitted.tried)
        remaining -= min(len(added), remaining)
        if set(state.effects) - given:
            fitted, exchanges = _exchange_added(fitted, given, recorder)
            lines += exchanges
        state = result = fitted
        # Of thousands of poses a diagnosis holds half a gigabyte of columns: gone before the next has its own.
        del diagnosis


def _finding_of(diagnosis: Diagnosis) -> Finding:
    """Return what adding effects needs of a diagnosis.

    That is its sentences, the effects it names together, and by effect how well views left out are predicted.
    """
    # A run that is only fitted loads nothing of the diagnosis.
    from stitch.diagnosis.diagnosis import Finding

    notes = (f"{note}." for note in diagnosis.notes if note not in diagnosis.sentence)
    validations = {c.name: c.cross_validation for c in diagnosis.candidates if c.cross_validation is not None}
    return Finding((*_finding_and_evidence(diagnosis), *notes), diagnosis.together, validations)


def _reason_to_stop(diagnosis: Diagnosis, remaining: int, at_most: int) -> list[str] | None:
    """Return why nothing is added after a diagnosis, as lines; None where an effect is to be added.

    The lines are empty where the diagnosis names no single effect: its own sentences say so.

    Args:
        remaining: number of effects that may still be added, of `at_most` at first.
    """
    if diagnosis.verdict != "missing_effect":
        return []
    name = diagnosis.effects[0]
    if not diagnosis.likelier_than_not:
        return [f"{name} was not added: chance is more likely. To add it anyway: stitch add RUN {name}."]
    if diagnosis.dropped_before is not None:
        return [f"{name} was dropped in this run before. To add it all the same: stitch add RUN {name}."]
    effects = "1 effect" if at_most == 1 else f"{at_most} effects"
    return None if remaining else [f"Stopped after {effects}; run it again to go on."]


def _add_found(
    state: RunData, finding: Finding, at_most: int, given: set[str], recorder: Recorder | None
) -> tuple[RunData, list[str]]:
    """Return the run with the effects that a diagnosis named together, as far as they earn their place, and lines.

    They are fitted at once; if they fail together, the first is fitted alone. If that fails too, the run comes back
    unchanged, with the reason in `tried`.

    Args:
        at_most: number of effects that may be added.
        given: effects that were in the model at first, which are never dropped.
    """
    from stitch.diagnosis.thresholds import FAINT_SIGMAS

    names = [name for name in finding.names if name not in state.tried][:at_most]
    while names:
        fitted, lines = _drop_unneeded(change(state, [*state.effects, *names], recorder), given, recorder)
        kept = [name for name in names if name in fitted.effects]
        validation = finding.validations.get(names[0])
        reason = None
        if validation is not None and kept:
            # Mean square error on views left out, with the effects over without.
            share = (fitted.heldout_rms / state.heldout_or_fit_rms) ** 2
            is_zero = max(t.sigmas_from_zero for t in fitted.terms if t.name in kept) < FAINT_SIGMAS
            reason = validation.fit_rejection_reason(" and ".join(kept), share, zero=is_zero)
        if kept and reason is None:
            # The diagnosis predicted the error with its first effect alone, so nothing of several.
            predicted_share = validation.heldout if validation is not None and kept == names[:1] else float("nan")
            fitted = with_prediction(fitted, state.heldout_or_fit_rms * predicted_share**0.5)
            return fitted, [*lines, f"Added {' and '.join(kept)}. With it:"]
        if len(names) == 1:
            why = reason or fitted.tried[names[0]]
            unchanged = replace(state, tried=state.tried | fitted.tried | {names[0]: why})
            return unchanged, [f"{names[0]} was tried and dropped: {why}."]
        # Together they do not earn their place: the one that is named is asked alone.
        names = names[:1]
    return state, []


def _exchange_added(state: RunData, given: set[str], recorder: Recorder | None = None) -> tuple[RunData, list[str]]:
    """Return the run with the added effects exchanged for others that predict views left out better, and a line on it.

    Effects added in several rounds may be wrong together: an early one can take up what a later one would explain. The
    run comes back as it is, without a line, where no other effects do better. Clouds are not asked: they would have to
    be matched anew for each set of effects.

    Args:
        given: effects that were in the model at first, which stay.
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
    """Return the run with all effects fitted that a diagnosis cannot tell apart, lines on it, and a diagnosis.

    The diagnosis is that of the new run. The run is None where nothing is undecided, or where the group of effects
    does not lower the error on views left out; the diagnosis is then that of `state`.
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
    """Return the run without added effects that are not needed in the end, and a line for each that was dropped.

    One at a time is dropped: first one whose every parameter is within `FAINT_SIGMAS` of zero. Otherwise every added
    effect is left out in turn, and the one without which views left out are predicted best goes, if they are predicted
    better. For clouds the error must fall by the factor `HELDOUT_RISE`, since matching them anew alone changes it.

    Args:
        given: effects that were in the model at first, which stay.
        recorder: told of the runs that remain, not of those that are only compared.
    """
    from stitch.diagnosis.thresholds import FAINT_SIGMAS, HELDOUT_RISE

    lines: list[str] = []
    while True:
        added = [term for term in result.terms if term.name in result.model.effects and term.name not in given]
        fewer = {t.name: [name for name in result.effects if name != t.name] for t in added}
        faint = next((term.name for term in added if term.sigmas_from_zero < FAINT_SIGMAS), None)
        if faint is not None:
            idle = faint
            reason = f"{idle} ends with no parameter that differs from zero"
        else:
            errors = {name: error_with(result, others) for name, others in fewer.items()}
            if not errors:
                return result, lines
            idle = min(errors, key=errors.__getitem__)
            ratio = errors[idle] / result.heldout_or_fit_rms
            if ratio * (HELDOUT_RISE if result.session.has_clouds else 1.0) >= 1.0:
                return result, lines
            reason = f"without {idle} views left out are predicted better in the end"
        lines.append(f"{reason}; it was dropped.")
        without = change(result, fewer[idle], recorder)
        result = replace(without, tried=result.tried | {idle: reason})


def _drop_unneeded(result: RunData, given: set[str], recorder: Recorder | None) -> tuple[RunData, list[str]]:
    """Return the run without added effects that the others make unnecessary, and a line on why for each of them.

    The reasons are also kept in `tried` of the run. Clouds are not asked: they would have to be matched anew for every
    effect.

    Args:
        given: effects that were in the model at first, which stay.
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
