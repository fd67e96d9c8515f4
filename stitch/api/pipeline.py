"""Stitch sessions (coarse → correct → fit → register → fuse), change a run's effects, and find what is missing.

The steps stand in `stages`: `surface_steps` for clouds, `target_steps` for labelled points alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from stitch.effects.contract import find_effect, require_available
from stitch.errors import InputError
from stitch.fit.coarse import COARSE_GATE, CoarseHandEye
from stitch.fit.register_and_fuse import FittedRig, InitialModel, Pipeline
from stitch.fit.results import FitSummary, assemble_run, pipeline_for
from stitch.fit.rig import require_effects, require_measured_once, require_same_rig
from stitch.fusion.register import DEFAULT, method_named
from stitch.model.model_toml import ModelFile, arm_model, convert_unit
from stitch.recorder import Recorder, SilentRecorder
from stitch.run_data import RunData, StageResult
from stitch.screening.deep_check import refuse_explained_mistake
from stitch.screening.model_transfer import (
    ArmTransfer,
    check_arm_transfer,
    check_model_transfer,
    find_disagreeing_sessions,
)
from stitch.screening.view_screening import ScreenedFit, fit_screened_views, session_warnings
from stitch.session.capture import Capture, part_size, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin
from stitch.session.session import SessionData
from stitch.system.threads import Clock, library_threads_off

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis, Finding

# A run loads nothing of the diagnosis.


def run(
    session: SessionData,
    model: ModelFile | None = None,
    recorder: Recorder | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | None = None,
    register: str = DEFAULT,
) -> RunData:
    """Stitch one session; with `model`, use its hand-eye and effects as they are instead of correcting.

    Args:
        effects: names of effects to fit together with the hand-eye.
        arm: effects of joints and links that stay as they are, while everything else is fitted.
        keep: fuse also the views that do not belong.
        register: method by which single views are registered, `dpwvm` or `gicp`; labelled points need none.

    Raises:
        InputError: the model belongs to another mount, or the session cannot have an effect as the model has it.
        NoResultError: no hand-eye was found, or the views do not overlap.
    """
    return run_rig([session], model, [recorder or SilentRecorder()], effects, keep, arm, register=register)[0]


def run_rig(
    sessions: Sequence[SessionData],
    model: ModelFile | None = None,
    recorders: Sequence[Recorder] | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | None = None,
    *,
    register: str = DEFAULT,
    captures: Sequence[Future[Capture]] | None = None,
) -> list[RunData]:
    """Stitch several sessions of one rig with common effects and, of scans, one hand-eye; one run per session.

    Args:
        captures: what `prepare_capture` makes of the sessions, where that has begun already.
    """
    method_named(register)
    require_same_rig(sessions, model)
    recorders = recorders or [SilentRecorder() for _ in sessions]
    with library_threads_off():
        clock, steps = Clock(), pipeline_for(sessions[0])
        for session, recorder in zip(sessions, recorders, strict=True):
            recorder.start(session)
        prepared = (own.result() for own in captures) if captures else map(prepare_capture, sessions)
        measurements = [measurement_of(session, own) for session, own in zip(sessions, prepared, strict=True)]
        effects = list(dict.fromkeys(effects))
        model = convert_unit(model, sessions[0].length_unit) if model else None
        arm = convert_unit(arm, sessions[0].length_unit) if arm else None
        require_effects(measurements, [*effects, *(model.effects if model else ()), *(arm.effects if arm else ())])
        require_measured_once(sessions)
        begun = steps.initial_hand_eyes(sessions, measurements, model)
        measurements = [with_part_origin(m, own.T_mount) for m, own in zip(measurements, begun, strict=True)]
        seconds = clock.lap()
        before = []
        for session, measurement, own, recorder in zip(sessions, measurements, begun, recorders, strict=True):
            with refuse_explained_mistake(session):
                before.append(steps.initial_stage(measurement, own, seconds, recorder))
        clock.lap()

        def with_arm(arm: ModelFile | None) -> InitialModel | None:
            if not effects and not arm:
                return None
            from stitch.diagnosis.score import start_with_effects

            return partial(start_with_effects, sessions[0], effects, arm)

        if model:
            fit = partial(steps.apply, file=model)
        else:
            fit = partial(steps.fit, starts=begun, initial_model=with_arm(arm), recorder=recorders[0])
        fit = partial(_fit_and_report, fit, partial(steps.begin_to_register, register=register), sessions, recorders)
        found = fit_screened_views(sessions, measurements, fit, keep)
        end = FitSummary(begun, found.fitted, clock.lap(), model.effects_file if model else None)
        if model and not sessions[0].has_clouds:
            found = check_model_transfer(found, partial(_fit_own_model, steps, found, with_arm(arm_model(model))))
        if len(sessions) > 1 and effects:
            alone = partial(_fit_single_session, steps, found, begun, with_arm(arm))
            apart = find_disagreeing_sessions([s.name for s in found.sessions], found.fitted, alone)
            end = replace(end, doubts=tuple(own.doubt(sessions[0].length_unit) for own in apart))
        if arm:
            again = partial(steps.fit, found.sessions, found.measurements, begun, recorder=SilentRecorder())
            here = check_arm_transfer(lambda other: again(initial_model=with_arm(other)), arm, found.fitted)
            end = _note_arm_transfer(end, here, sessions[0].length_unit)
        return _assemble_runs(sessions, found, end, before, recorders, keep)


def _fit_and_report(
    fit: Callable[[Sequence[SessionData], Sequence[Measurement]], FittedRig],
    begin_to_register: Callable[[FittedRig, Sequence[SessionData]], FittedRig],
    whole: Sequence[SessionData],
    recorders: Sequence[Recorder],
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
) -> FittedRig:
    """Fit the views that are left, tell the recorders where these are fewer, and begin to register and to fuse.

    Nearly always all views belong: they are registered and fused while they are screened.
    """
    for before, session, recorder in zip(whole, sessions, recorders, strict=True):
        if len(session.views) < len(before.views):
            recorder.start(session)
    return begin_to_register(fit(sessions, measurements), sessions)


def _note_arm_transfer(end: FitSummary, here: ArmTransfer, length_unit: str) -> FitSummary:
    """Return the fit with a note that the arm of another run holds here, or a doubt that it does not."""
    told = (here.sentence(length_unit),)
    return replace(end, notes=told) if here.holds else replace(end, doubts=(*end.doubts, *told))


def _fit_single_session(
    pipeline: Pipeline, found: ScreenedFit, starts: Sequence[CoarseHandEye], initial_model: InitialModel | None, i: int
) -> FittedRig:
    """Fit one session of a rig by itself."""
    return pipeline.fit([found.sessions[i]], [found.measurements[i]], [starts[i]], initial_model, SilentRecorder())


def _fit_own_model(pipeline: Pipeline, found: ScreenedFit, initial_model: InitialModel | None) -> FittedRig:
    """Fit hand-eye and targets from the sessions themselves."""
    begun = pipeline.initial_hand_eyes(found.sessions, found.measurements, None)
    return pipeline.fit(found.sessions, found.measurements, begun, initial_model, SilentRecorder())


def _assemble_runs(
    sessions: Sequence[SessionData],
    found: ScreenedFit,
    end: FitSummary,
    before: Sequence[StageResult],
    recorders: Sequence[Recorder],
    keep: bool,
) -> list[RunData]:
    """Return one run per session, with its own notes."""
    runs = []
    for i, (session, own) in enumerate(zip(found.sessions, found.screenings, strict=True)):
        left_out = tuple(sorted(own.left_out, key=lambda item: sessions[i].names.index(item.view)))
        out, kept = ((), left_out) if keep else (left_out, ())
        last = replace(end, left_out=out, kept=kept, suspected=own.suspected, links=own.links)
        last = replace(last, doubts=(*end.doubts, *own.doubts))
        runs.append(assemble_run(session, i, last, before[i], recorders[i]))
    return runs


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


def change(state: RunData, effects: Sequence[str], recorder: Recorder | None = None) -> RunData:
    """Fit a run again with these effects in its model: matches, hand-eye and all effects.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
        NoResultError: no two views overlap.
    """
    from stitch.diagnosis.score import start_with_effects

    recorder = recorder or SilentRecorder()
    with library_threads_off():
        clock, steps = Clock(), pipeline_for(state.session)
        session, measurement, effects = state.session, state.measurement, list(dict.fromkeys(effects))
        recorder.start(session)
        require_effects([measurement], effects)
        new = [name for name in effects if name not in state.model.effects]
        model = start_with_effects(session, new, None, measurement, state.model, state.gate)
        model = model.with_terms([term for term in model.terms if term.name in effects])
        gate = COARSE_GATE * part_size([measurement.capture]) if session.has_clouds else float("nan")
        begun = CoarseHandEye(state.T_mount_coarse, gate, "of the first run", ())
        before = steps.initial_stage(measurement, begun, clock.lap(), recorder)
        clock.lap()
        fitted = steps.refit([session], [measurement], model, [state.gate], recorder)
        fitted = steps.begin_to_register(fitted, [session], state.register_method or DEFAULT)
        own = fitted.sessions[0].measurement
        end = FitSummary(
            starts=[begun],
            fitted=fitted,
            seconds=clock.lap(),
            effects_file=state.effects_file,
            ledger=state.ledger,
            left_out=state.left_out,
            links=state.links,
            doubts=session_warnings(session, own, fitted.correction, 0),
        )
        tried = {name: why for name, why in state.tried.items() if name not in effects}
        return replace(assemble_run(session, 0, end, before, recorder), tried=tried)


def diagnose(run: RunData) -> Diagnosis:
    """Find which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    from stitch.diagnosis.diagnose import diagnose_state
    from stitch.diagnosis.next_view import propose_measurements

    found = diagnose_state(run)
    return replace(found, next=propose_measurements(found))


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
    lines, given, left = list[str](), set(state.model.effects), at_most
    result: RunData | None = None
    while True:
        found = None if known is not None and left else diagnose(state)
        finding = known if found is None else _finding_of(found)
        assert finding is not None
        lines += finding.lines
        if found is not None and (why := _reason_to_stop(found, left, at_most)) is not None:
            return result, [*lines, *why], found
        before, known = result, None
        result, told = _add_found(state, finding, left, given, recorder)
        lines += told
        if not set(result.effects) - set(state.effects):
            return before, lines, replace(found or diagnose(state), tried=result.tried)
        left -= min(len(set(result.effects) - set(state.effects)), left)
        if set(state.effects) - given:
            result, told = _exchange_added(result, given, recorder)
            lines += told
        state = result
        # Of thousands of poses a diagnosis holds half a gigabyte of columns: gone before the next has its own.
        del found


def _finding_of(found: Diagnosis) -> Finding:
    from stitch.diagnosis.diagnosis import Finding

    notes = (f"{note}." for note in found.notes if note not in found.sentence)
    validations = {c.name: c.cross_validation for c in found.candidates if c.cross_validation is not None}
    return Finding((*_finding_and_evidence(found), *notes), found.together, validations)


def _reason_to_stop(found: Diagnosis, left: int, at_most: int) -> list[str] | None:
    """Return why nothing is added after a diagnosis, in lines; None where something is."""
    if found.verdict != "missing_effect":
        return []
    name = found.effects[0]
    if not found.likelier_than_not:
        return [f"{name} was not added: chance is more likely. To add it anyway: stitch add RUN {name}."]
    if found.dropped_before is not None:
        return [f"{name} was dropped in this run before. To add it all the same: stitch add RUN {name}."]
    effects = "1 effect" if at_most == 1 else f"{at_most} effects"
    return None if left else [f"Stopped after {effects}; run it again to go on."]


def _add_found(
    state: RunData, found: Finding, at_most: int, given: set[str], recorder: Recorder | None
) -> tuple[RunData, list[str]]:
    """Return the run with what was found together, as far as it earns its place, and what happened.

    Args:
        given: effects that stay in any case.
    """
    from stitch.diagnosis.thresholds import FAINT_SIGMAS

    names = [name for name in found.names if name not in state.tried][:at_most]
    while names:
        tried, lines = _drop_unneeded(change(state, [*state.effects, *names], recorder), given, recorder)
        kept = [name for name in names if name in tried.effects]
        share = (tried.heldout_rms / state.heldout_or_fit_rms) ** 2
        validation = found.validations.get(names[0])
        zero = max((t.sigmas_from_zero for t in tried.terms if t.name in kept), default=0.0) < FAINT_SIGMAS
        reason = validation.fit_rejection_reason(" and ".join(kept), share, zero=zero) if validation and kept else None
        if kept and reason is None:
            return tried, [*lines, f"Added {' and '.join(kept)}. With it:"]
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

    found = diagnose(state)
    if found.verdict != "cannot_tell":
        return (
            None,
            [*_finding_and_evidence(found), "These views leave no group of effects undecided."],
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
    tried = change(state, [*state.model.effects, *found.effects], recorder)
    told = (
        f"{names} are fitted as one group: {judged}, and together they stand for what is missing; these views do not "
        "tell its parts apart, so that none of their values means anything alone"
    )
    tried = tried.with_fit(notes=(f"{told}.", *tried.notes))
    return tried, [*_finding_and_evidence(found), f"{told}."], diagnose(tried)


def _finding_and_evidence(found: Diagnosis) -> list[str]:
    """Return the plain finding and the evidence, as `stitch diagnose` prints them."""
    from stitch.output.plain_finding import plain_finding

    return [plain_finding(found, found.linear.measurement.length_unit), found.sentence]


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
