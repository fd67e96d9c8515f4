"""Stitch sessions (coarse → correct → fit → register → fuse), change a run's effects, diagnose what is missing.

The steps stand in `fit`: `surface_steps` for clouds, `target_steps` for labelled points alone. What of a
run's steps goes on beside the screening is started here, by `_Conductor`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import closing
from dataclasses import replace
from functools import partial
from threading import Event
from typing import TYPE_CHECKING, Any

from stitch.api.rig import require_effects, require_measured_once, require_same_arm, require_same_rig
from stitch.errors import NoResultError
from stitch.fit.coarse import COARSE_GATE, REUSED, CoarseHandEye
from stitch.fit.coarse_axes import locate_axes
from stitch.fit.correct import Correction
from stitch.fit.fit import FitStart, FittedRig, InitialModel
from stitch.fit.pipelines import coarse_stage, pipeline_for
from stitch.fit.sentences import view_notes
from stitch.fusion.register import DEFAULT, method_named
from stitch.model.model_toml import (
    ModelFile,
    arm_model,
    convert_unit,
    with_model_axes,
    with_model_scanners,
    without_events,
)
from stitch.numerics.frames import Array
from stitch.observations.observability import unknown_numbers, unobservable
from stitch.observations.scanner_places import ScannerAlone, contradictions
from stitch.recorder import Recorder, RecorderMemory, SilentRecorder
from stitch.run_data import Fit, LedgerStep, RunData, StageResult
from stitch.screening.deep_check import refuse_explained_mistake
from stitch.screening.hand_eye_anywhere import hand_eye_sigma_anywhere
from stitch.screening.hand_eye_transfer import hand_eye_transfer
from stitch.screening.model_transfer import check_arm_transfer, check_model_transfer, find_disagreeing_sessions
from stitch.screening.view_screening import ScreenedFit, ViewScreening, fit_screened_views, session_warnings
from stitch.session.capture import Capture, part_size, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin
from stitch.session.notes import session_notes
from stitch.session.scanners import join_sessions
from stitch.session.session import SessionData
from stitch.system.threads import Clock, begin, library_threads_off

# A run loads nothing of the diagnosis.
if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import Diagnosis


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
        register: method by which single views are registered, `dpwvm`, `gicp` or `vmm`; labelled points need none.

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
    effects_file: str | None = None,
    on_registered: Callable[[list[RunData]], None] | None = None,
) -> list[RunData]:
    """Stitch several sessions of one rig with common effects and, of scans, one hand-eye; one run per session.

    Args:
        sessions: of one mount and length unit; the runs come in their order.
        model: hand-eye and effects of another run, used as they are instead of being fitted.
        recorders: one a session, told of every stage; None: nobody is.
        effects, keep, arm, register: as of `run`.
        captures: what `prepare_capture` returns for each session, where that has begun already; None: it is made here.
        effects_file: path of the user's Python file of effects, where no `model` names one.
        on_registered: called with the runs while their views are still being fused: what needs the cloud waits for it.

    Raises:
        InputError, NoResultError: as of `run`, and sessions that cannot share a rig.
    """
    # Refuses an unknown method before anything is computed.
    method_named(register)
    require_same_rig(sessions, model)
    if model:
        sessions = [with_model_axes(session, model) for session in sessions]
    recorders = recorders or [SilentRecorder() for _ in sessions]
    with library_threads_off():
        clock = Clock()
        for session, recorder in zip(sessions, recorders, strict=True):
            recorder.start(session)
        effects = list(dict.fromkeys(effects))
        model = without_events(convert_unit(model, sessions[0].length_unit)) if model else None
        arm = convert_unit(arm, sessions[0].length_unit) if arm else None
        asked = [*effects, *(model.effects if model else ()), *(arm.effects if arm else ())]
        sessions, measurements = _measured(sessions, captures, asked)
        require_measured_once(sessions)
        hand_eyes, measurements = _start_hand_eyes(sessions, measurements, model)
        seconds = clock.lap()
        coarse = []
        for session, measurement, hand_eye, recorder in zip(sessions, measurements, hand_eyes, recorders, strict=True):
            with refuse_explained_mistake(session):
                coarse.append(_show_coarse_stage(session, measurement, hand_eye, seconds, recorder))
        start = FitStart(hand_eyes, _initial_model(sessions[0], effects, arm), given=model)
        with closing(_Conductor(sessions, start, coarse, recorders, register)) as conductor:
            # Fits again whenever it leaves views out; the views are registered and fused meanwhile.
            screened = fit_screened_views(sessions, measurements, conductor.fit, keep)
            if model and sessions[0].has_clouds:
                screened = _check_given_hand_eye(screened)
            elif model:
                screened = _check_against_own_model(screened, effects, model)
            notes, doubts = _check_common_model(screened, hand_eyes, effects, arm)
            alone = () if model else _each_alone(screened.sessions[0], arm)
            conductor.wait_for_covariance()
            limits = [_hand_eye_limits(s, i, screened.fitted, hand_eyes[i]) for i, s in enumerate(screened.sessions)]
            registered = conductor.registered()
            runs = []
            for i, screening in enumerate(screened.screenings):
                names = sessions[i].names
                left_out = sorted(screening.left_out, key=lambda item: names.index(item.view))
                screening = replace(screening, left_out=tuple(left_out), doubts=(*doubts, *screening.doubts))
                session, fitted = screened.sessions[i], screened.fitted
                found = registered[i], limits[i], screening
                run = _assemble_run(session, i, fitted, hand_eyes[i], *found, keep=keep, notes=notes, alone=alone)
                runs.append(replace(run, effects_file=model.effects_file if model else effects_file))
            if on_registered is not None:
                on_registered(runs)
            conductor.finish(runs)
        for run, recorder in zip(runs, recorders, strict=True):
            recorder.finish(run)
        return runs


def join_scanners(
    sessions: Sequence[SessionData],
    model: ModelFile | None = None,
    arm: ModelFile | None = None,
    captures: Sequence[Future[Capture]] | None = None,
) -> SessionData:
    """Return the sessions of several scanners in one cell joined into one, each scanner with a starting hand-eye.

    A scanner's `T_mount` is that of `model` if given, else a fit of its own views alone, else the one it states.

    Args:
        arm: effects of joints and links that stay as they are in these fits.
        captures: what `prepare_capture` returns for each session, where that has begun already.

    Raises:
        InputError: they share no arm, no unit, no axes or no mount; or a model of other scanners.
        NoResultError: a scanner's own views say nothing of it, and nobody states where it stands.
    """
    require_same_rig(sessions, model)
    require_measured_once(sessions)
    for session in sessions[1:]:
        require_same_arm(sessions[0], session)
    if model:
        return join_sessions(with_model_scanners(sessions, convert_unit(model, sessions[0].length_unit)))
    with library_threads_off():
        sessions, measurements = _measured(sessions, captures)
        placed = []
        for session, measurement in zip(sessions, measurements, strict=True):
            try:
                T_mount = _fit_alone(session, measurement, arm).geometry.T_mount
            except NoResultError as error:
                if session.scanner.T_mount is None:
                    raise NoResultError(f"scanner {session.scanner.name} alone: {error}") from None
                T_mount = session.scanner.T_mount
            placed.append(replace(session, scanner=replace(session.scanner, T_mount=T_mount)))
        return join_sessions(placed)


def _measured(
    sessions: Sequence[SessionData], captures: Sequence[Future[Capture]] | None, effects: Sequence[str] = ()
) -> tuple[Sequence[SessionData], Sequence[Measurement]]:
    """Return the sessions with their external axes located by the scans, and the measurement of each.

    Without axes the sessions come back as they are.

    Args:
        captures: what `prepare_capture` returns for each session, where that has begun already; None: it is made here.
        effects: names of effects that are to be fitted or used.

    Raises:
        InputError: a session cannot have one of these effects.
    """
    prepared = (capture.result() for capture in captures) if captures else map(prepare_capture, sessions)
    measurements = [measurement_of(session, capture) for session, capture in zip(sessions, prepared, strict=True)]
    require_effects(measurements, effects)
    return locate_axes(sessions, measurements) if sessions[0].axes else (sessions, measurements)


def _start_hand_eyes(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement], model: ModelFile | None
) -> tuple[list[CoarseHandEye], list[Measurement]]:
    """Return the hand-eye with which the fit of each session begins, and the measurements with the part's origin.

    Args:
        model: hand-eye of another run, used as it is; None: the one that the session states, or a search.

    Raises:
        NoResultError: no hand-eye was found.
    """
    hand_eyes = pipeline_for(sessions[0]).start(sessions, measurements, model)
    placed = [with_part_origin(m, start.T_mount) for m, start in zip(measurements, hand_eyes, strict=True)]
    return hand_eyes, placed


def _fit_alone(session: SessionData, measurement: Measurement, arm: ModelFile | None) -> Correction:
    """Return the hand-eye of one session corrected from its own views, the effects of `arm` staying as they are.

    Raises:
        NoResultError: the views give no hand-eye, or do not overlap.
    """
    hand_eyes, measurements = _start_hand_eyes([session], [measurement], None)
    correction = _fit_unseen([session], measurements, hand_eyes, (), arm).correction
    assert correction is not None
    return correction


def _fit_unseen(
    sessions: Sequence[SessionData],
    measurements: Sequence[Measurement],
    hand_eyes: Sequence[CoarseHandEye],
    effects: Sequence[str],
    arm: ModelFile | None,
) -> FittedRig:
    """Return a further fit of sessions, for comparison with that of the run; no recorder shows it.

    Args:
        hand_eyes: where the fit begins, one a session.
        effects: names of effects that are fitted with the hand-eye.
        arm: effects of joints and links that stay as they are.
    """
    start = FitStart(hand_eyes, _initial_model(sessions[0], effects, arm))
    return pipeline_for(sessions[0]).fit(sessions, measurements, start, SilentRecorder())


def _each_alone(session: SessionData, arm: ModelFile | None) -> tuple[ScannerAlone, ...]:
    """Return the hand-eye of each scanner, fitted from its own views alone; empty for a session of one scanner.

    A scanner whose views give no hand-eye is left out. `session` joins the sessions `parts`, one a scanner k, after
    screening; only the views that it still has are used. It names them VIEW@SCANNER.
    """
    found = []
    for k, whole in enumerate(session.parts):
        name = whole.scanner.name
        counted = {view.name.removesuffix(f"@{name}") for view in session.views if view.scanner == k}
        own = whole.without(set(whole.names) - counted)
        try:
            model = _fit_alone(own, measurement_of(own, prepare_capture(own)), arm).model
        except NoResultError:
            continue
        found.append(ScannerAlone(name, model.T_mount, model.covariance))
    return tuple(found)


def _show_coarse_stage(
    session: SessionData, measurement: Measurement, start: CoarseHandEye, seconds: float, recorder: Recorder
) -> StageResult:
    """Return the result of the coarse stage after showing it to a recorder.

    Args:
        start: the coarse hand-eye.
        seconds: wall time that it took.
    """
    stage = coarse_stage(session, measurement, start, seconds)
    recorder.stage(stage, measurement.capture.poses(start.T_mount))
    return stage


def _initial_model(session: SessionData, effects: Sequence[str], arm: ModelFile | None) -> InitialModel | None:
    """Return the function that builds the model from which the fit begins; None where it fits the hand-eye alone.

    The function is called by the fit once a hand-eye is known.

    Args:
        effects: names of effects that are fitted.
        arm: effects of joints and links of another run, which stay as they are.
    """
    if not effects and not arm and not session.axes and not session.parts:
        return None
    # A run without effects loads nothing of the diagnosis.
    from stitch.diagnosis.score import start_with_effects

    return partial(start_with_effects, session, effects, arm)


class _Conductor:
    """Fits the sessions of a rig; registers their views in other threads while they are screened, and fuses them.

    Nearly always all views belong, and the work is not in vain. What was begun for views that are then left out ends
    with its next iteration.
    """

    def __init__(
        self,
        sessions: Sequence[SessionData],
        start: FitStart,
        coarse: Sequence[StageResult],
        recorders: Sequence[Recorder],
        register: str,
    ) -> None:
        """Hold what the steps of a run begin with.

        Args:
            sessions: all sessions of the rig, with all their views.
            start: where the fit begins.
            coarse: results of the coarse stage, one a session.
            recorders: one a session, told of every stage.
            register: name of the method by which single views are registered.
        """
        self._sessions = sessions
        self._start = start
        self._coarse = coarse
        self._recorders = recorders
        self._register = register
        self._clock = Clock()
        self._seconds = 0.0
        self._memories: list[RecorderMemory] = []  # one a session, of the thread that registers now
        self._screened = Event()  # set when the screening is over, and when the thread is to stop

    def fit(self, sessions: Sequence[SessionData], measurements: Sequence[Measurement]) -> FittedRig:
        """Return the fit of these views, and begin in other threads to register and to fuse them.

        The screening calls this again each time it leaves views out; what was begun before is then stopped. This
        thread fits. One further thread registers the views and begins another that fuses them; one more computes the
        hand-eye's covariance.
        """
        self.close()
        # A recorder that was told of a session with more views starts again.
        for whole, session, recorder in zip(self._sessions, sessions, self._recorders, strict=True):
            if len(session.views) < len(whole.views):
                recorder.start(session)
        fitted = pipeline_for(sessions[0]).fit(sessions, measurements, self._start, self._recorders[0])
        self._seconds += self._clock.lap()
        self._memories = [RecorderMemory() for _ in sessions]
        self._screened = Event()
        until_screened = partial(_wait_until_screened, self._screened, self._memories[0])
        # The thread gets what it works with as arguments, since a later call of `fit` replaces the fields.
        arguments = sessions, fitted, self._memories, self._seconds, until_screened
        self._registered = begin(partial(self._register_sessions, *arguments))
        # `hand_eye` is a cached property: read here, it is at hand when the run is assembled.
        self._statistics = begin(lambda: None if fitted.correction is None else fitted.correction.hand_eye)
        return fitted

    def _register_sessions(
        self,
        sessions: Sequence[SessionData],
        fitted: FittedRig,
        memories: Sequence[RecorderMemory],
        seconds: float,
        until_screened: Callable[[], None],
    ) -> list[tuple[Fit, float]]:
        """Return, a session each, what the stages after the fit found and the rms that perfect poses would leave.

        Args:
            fitted: hand-eye and effects of the whole rig.
            memories: one a session; they store what recorders are told later: of views left out they never hear.
            seconds: time that the fit has taken.
            until_screened: called before whole clouds are read to fuse them, see `_wait_until_screened`.
        """
        steps = pipeline_for(sessions[0])
        finish = partial(steps.register_session, seconds=seconds, method=self._register, until_screened=until_screened)
        every = enumerate(zip(sessions, self._coarse, memories, strict=True))
        return [finish(session, fitted, i, coarse, memory) for i, (session, coarse, memory) in every]

    def registered(self) -> list[tuple[Fit, float]]:
        """Return, a session each, what the stages found and the rms that perfect poses would leave (length_unit).

        Waits for the registration, and tells the recorders what is done so far.
        """
        fits = self._registered.result()
        self._tell_recorders()
        return fits

    def wait_for_covariance(self) -> None:
        """Let fusion begin, as the views are screened, and wait until the hand-eye's covariance is known."""
        self._screened.set()
        self._statistics.result()

    def finish(self, runs: Sequence[RunData]) -> None:
        """Wait until the views of the runs are fused, and tell the recorders.

        Raises:
            InputError: a scan changed on disk since it was read.
        """
        for run in runs:
            _ = run.fit.fusion
        self._tell_recorders()

    def _tell_recorders(self) -> None:
        """Make the calls that the threads' memories hold on the recorders."""
        for memory, recorder in zip(self._memories, self._recorders, strict=True):
            memory.hand_over(recorder)

    def close(self) -> None:
        """Stop the threads that were begun: each ends at its next call of a recorder, or when it waits to fuse."""
        for memory in self._memories:
            memory.stopped = True
        self._screened.set()


def _wait_until_screened(screened: Event, memory: RecorderMemory) -> None:
    """Wait until the views are screened.

    Raises:
        CancelledError: views were left out meanwhile, and the memory's calls are not needed.
    """
    screened.wait()
    if memory.stopped:
        raise CancelledError


def _check_given_hand_eye(screened: ScreenedFit) -> ScreenedFit:
    """Return the fit with, for each session, how far the hand-eye of another run lies from what its scans show.

    Where the two contradict each other, the session gets a doubt.
    """
    correction = screened.fitted.correction
    assert correction is not None
    screenings = []
    for i, (screening, session) in enumerate(zip(screened.screenings, screened.sessions, strict=True)):
        measurement = screened.fitted.sessions[i].measurement
        capture, unconstrained = correction.captures[i], correction.unconstrained[i]
        transfer = hand_eye_transfer(measurement, capture, unconstrained, correction.model)
        doubts = () if transfer.holds else (transfer.sentence(session.length_unit),)
        screenings.append(replace(screening, doubts=(*screening.doubts, *doubts), hand_eye=transfer))
    return replace(screened, screenings=screenings)


def _check_against_own_model(screened: ScreenedFit, effects: Sequence[str], model: ModelFile) -> ScreenedFit:
    """Return the fit of labelled points with doubts where another run's model contradicts them.

    The comparison is a fit of hand-eye and targets from these points themselves, with the arm's effects of `model`. It
    is made only when the check asks for it.
    """
    sessions, measurements = screened.sessions, screened.measurements

    def fit() -> FittedRig:
        """Return the fit of these points themselves."""
        hand_eyes = pipeline_for(sessions[0]).start(sessions, measurements, None)
        return _fit_unseen(sessions, measurements, hand_eyes, effects, arm_model(model))

    return screened.with_doubts(check_model_transfer(sessions, screened.fitted, fit))


def _check_common_model(
    screened: ScreenedFit, hand_eyes: Sequence[CoarseHandEye], effects: Sequence[str], arm: ModelFile | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return notes, and doubts, on what the sessions share: their effects, and the arm of another run.

    Each session alone is fitted with `effects` to see whether the common values hold for it. The arm is judged by two
    fits of all sessions, with it and without. Both kinds of fit are made only when a check asks for them.

    Args:
        hand_eyes: where the fits begin, one a session.
    """
    sessions, measurements = screened.sessions, screened.measurements
    unit = sessions[0].length_unit
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    def fit_session(i: int) -> FittedRig:
        return _fit_unseen([sessions[i]], [measurements[i]], [hand_eyes[i]], effects, arm)

    if len(sessions) > 1 and effects:
        doubts = find_disagreeing_sessions([s.name for s in sessions], screened.fitted, fit_session, unit)
    if arm:
        fit_with_arm = partial(_fit_unseen, sessions, measurements, hand_eyes, effects)
        holds, sentence = check_arm_transfer(fit_with_arm, arm, screened.fitted, unit)
        if holds:
            notes = (sentence,)
        else:
            doubts = (*doubts, sentence)
    return notes, doubts


def _sigma_anywhere(fitted: FittedRig, index: int) -> Array | None:
    """Return the hand-eye's sigma (6,) at any pose the arm reaches, rotation first, rad and length_unit.

    It includes effects of usual size that these views cannot show. None without clouds, and for several scanners.
    """
    correction = fitted.correction
    if correction is None:
        return None
    measurement = replace(fitted.sessions[index].measurement, capture=correction.captures[index])
    if measurement.views.scanners:
        return None
    unconstrained = correction.unconstrained[index]
    return hand_eye_sigma_anywhere(measurement, fitted.model_of(index), unconstrained, correction.scatter[index])


def _assemble_run(
    session: SessionData,
    index: int,
    fitted: FittedRig,
    start: CoarseHandEye,
    registered: tuple[Fit, float],
    limits: dict[str, Any],
    screening: ViewScreening,
    *,
    keep: bool = False,
    notes: tuple[str, ...] = (),
    alone: tuple[ScannerAlone, ...] = (),
) -> RunData:
    """Return the run of one session of a rig: its fit and screening put together, with the first step of its ledger.

    Args:
        index: of the session in the rig.
        fitted: hand-eye and effects of the whole rig.
        start: the hand-eye before the correction, and where it is from.
        registered: the session registered, and the rms that perfect poses would leave, length_unit.
        limits: fields of `Fit` on what the views do not show of the hand-eye.
        screening: which of its views belong, and what is to be doubted.
        keep: views that do not belong were fused all the same: they are noted as kept, and none as left out.
        notes: sentences on what the sessions share.
        alone: of several scanners, the hand-eye of each from its own views; where they contradict the common fit, the
            run gets doubts.
    """
    fit, noise_floor = registered
    model = fitted.model_of(index)
    left_out, kept = ((), screening.left_out) if keep else (screening.left_out, ())
    notes_on_views = view_notes(left_out, kept, screening.suspected)
    notes_on_fit = pipeline_for(session).notes(session, fitted, index, start)
    fit = replace(
        fit,
        **limits,
        targets=fitted.sessions[index].targets,
        outliers=fitted.sessions[index].outliers,
        notes=(*notes_on_views, *notes_on_fit, *session_notes(session), *notes),
    )
    residual_rms = next(stage.rms for stage in fit.stages_before if stage.name == "correct")
    heldout_rms = fitted.heldout_rms(index)
    values = {term.name: {p.name: p.value for p in term.parameters} for term in model.terms}
    first_step = LedgerStep(tuple(model.effects), residual_rms, heldout_rms, noise_floor, model.T_mount, values)
    run = RunData(
        session=session,
        measurement=fitted.sessions[index].measurement,
        model=model,
        T_mount_coarse=start.T_mount,
        gate=float("nan") if fit.overlaps is None else fit.overlaps.gate,
        residual_rms=residual_rms,
        heldout_rms=heldout_rms,
        noise_floor=noise_floor,
        source=fit,
        register_method=next((stage.method for stage in fit.stages_before if stage.method), ""),
        ledger=(first_step,),
        doubts=screening.doubts,
        left_out=left_out,
        links=screening.links,
        alone=alone,
        hand_eye_transfer=screening.hand_eye,
    )
    if session.parts:
        run = replace(run, doubts=(*run.doubts, *contradictions(run.scanners, session.length_unit)))
    return run


def _hand_eye_limits(session: SessionData, index: int, fitted: FittedRig, start: CoarseHandEye) -> dict[str, Any]:
    """Return by field of `Fit` what the views do not show of the hand-eye: directions, numbers, and sigma anywhere.

    Args:
        index: of the session in the rig.
        fitted: hand-eye and effects of the whole rig.
        start: the hand-eye before the correction; that of another run is as well known as it was there.
    """
    T_mount = fitted.model_of(index).T_mount
    # Scans of all sessions show the one hand-eye that they share; labelled points have one for each session.
    captures = fitted.captures if session.has_clouds else [fitted.captures[index]]
    # Where several sessions share a hand-eye no joint has one place for all.
    joints = session.joints if len(captures) == 1 else None
    limits: dict[str, Any] = {"unobservable": unobservable(captures, T_mount, session.robot, joints)}
    if start.source == REUSED:
        return limits
    return limits | {"unknown": unknown_numbers(captures, T_mount), "sigma_anywhere": _sigma_anywhere(fitted, index)}


def change(state: RunData, effects: Sequence[str], recorder: Recorder | None = None) -> RunData:
    """Return a run fitted again with `effects` as all the effects of its model: matches, hand-eye, parameters.

    The ledger grows by one step. Effects that describe the geometry of the cell (external axes, scanners) always stay.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
        NoResultError: no two views overlap.
    """
    recorder = recorder or SilentRecorder()
    session, measurement = state.session, state.measurement
    index = 0  # of the session in its rig, which has no other
    with library_threads_off():
        clock = Clock()
        effects = list(dict.fromkeys(effects))
        recorder.start(session)
        start = _start_of_change(state, effects)
        (hand_eye,) = start.hand_eyes
        coarse = _show_coarse_stage(session, measurement, hand_eye, clock.lap(), recorder)
        register = state.register_method or DEFAULT
        with closing(_Conductor([session], start, [coarse], [recorder], register)) as conductor:
            fitted = conductor.fit([session], [measurement])
            warnings = session_warnings(session, fitted.sessions[index].measurement, fitted.correction, index)
            conductor.wait_for_covariance()
            limits = _hand_eye_limits(session, index, fitted, hand_eye)
            (registered,) = conductor.registered()
            screening = ViewScreening(left_out=state.left_out, links=state.links, doubts=warnings)
            run = _assemble_run(session, index, fitted, hand_eye, registered, limits, screening, alone=state.alone)
            conductor.finish([run])
        run = replace(run, ledger=(*state.ledger, *run.ledger), effects_file=state.effects_file)
        recorder.finish(run)
        tried = {name: why for name, why in state.tried.items() if name not in effects}
        return replace(run, tried=tried)


def error_with(state: RunData, effects: Sequence[str]) -> float:
    """Return the rms on views left out, length_unit, that `change` to these effects would have; unknown: in the fit.

    Only the fit is made, for effects that are compared and not kept.

    Raises:
        InputError, NoResultError: as of `change`.
    """
    session = state.session
    with library_threads_off():
        start = _start_of_change(state, effects)
        fitted = pipeline_for(session).fit([session], [state.measurement], start, SilentRecorder())
        return fitted.heldout_or_fit_rms(index=0)


def _start_of_change(state: RunData, effects: Sequence[str]) -> FitStart:
    """Return where the fit of a run with `effects` as all its effects begins.

    No search and no screening: the hand-eye to begin with and which views belong are known from the first run. The fit
    begins at the parameters of the run's model, a new effect at zero or at its best event.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
    """
    from stitch.diagnosis.score import start_with_effects

    session, measurement = state.session, state.measurement
    require_effects([measurement], effects)
    new = [name for name in effects if name not in state.model.effects]
    model = start_with_effects(session, new, None, measurement, state.model, state.gate)
    model = model.with_terms([term for term in model.terms if term.is_geometry or term.name in effects])
    gate = COARSE_GATE * part_size([measurement.capture]) if session.has_clouds else float("nan")
    hand_eye = CoarseHandEye(state.T_mount_coarse, gate, "of the first run", ())
    return FitStart([hand_eye], model=model, gate=state.gate)


def diagnose(run: RunData) -> Diagnosis:
    """Return which effect is missing in the model of a run, and what to measure next.

    Raises:
        NoResultError: no two views overlap.
    """
    from stitch.diagnosis.diagnose import diagnose_state
    from stitch.diagnosis.next_view import propose_measurements

    diagnosis = diagnose_state(run)
    return replace(diagnosis, next=propose_measurements(diagnosis))
