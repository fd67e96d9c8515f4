"""The run: coarse → correct → register → fuse, for one session or several of one rig; and what is missing."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from stitch.diagnosis.diagnose import diagnose_state
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.initial_values import start_with_effects
from stitch.integrity.admitted_fit import ScreenedFit, fit_screened_views
from stitch.integrity.arm_here import ArmTransfer, check_arm_transfer
from stitch.integrity.model_here import check_model_transfer
from stitch.integrity.refusals import refuse_explained_mistake
from stitch.integrity.rig_apart import find_disagreeing_sessions
from stitch.measurement.capture import prepare_capture
from stitch.measurement.measurement import measurement_of, with_part_origin
from stitch.measurement.session import Session
from stitch.model.arm import arm_model
from stitch.model.bound import convert_unit
from stitch.model.model_toml import ModelFile
from stitch.runs.recorder import Recorder, SilentRecorder
from stitch.runs.run import Run, StageResult
from stitch.runs.state import RunState, state_of
from stitch.stages.coarse import CoarseHandEye
from stitch.stages.course import FitSummary, assemble_run, pipeline_for
from stitch.stages.fitted import FittedRig, InitialModel, Pipeline
from stitch.stages.register import DEFAULT, method_named
from stitch.stages.rig import require_effects, require_measured_once, require_same_rig
from stitch.system.threads import Clock, library_threads_off


def run(
    session: Session,
    model: ModelFile | None = None,
    recorder: Recorder | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | None = None,
    register: str = DEFAULT,
) -> Run:
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
    return run_rig([session], model, [recorder or SilentRecorder()], effects, keep, arm, register)[0]


def run_rig(
    sessions: Sequence[Session],
    model: ModelFile | None = None,
    recorders: Sequence[Recorder] | None = None,
    effects: Sequence[str] = (),
    keep: bool = False,
    arm: ModelFile | None = None,
    register: str = DEFAULT,
) -> list[Run]:
    """Stitch several sessions of one rig with one common hand-eye and common effects; one run per session."""
    method_named(register)
    require_same_rig(sessions, model)
    recorders = recorders or [SilentRecorder() for _ in sessions]
    with library_threads_off():
        clock, course = Clock(), pipeline_for(sessions[0])
        for session, recorder in zip(sessions, recorders, strict=True):
            recorder.start(session)
        measurements = [measurement_of(session, prepare_capture(session)) for session in sessions]
        effects = list(dict.fromkeys(effects))
        model = convert_unit(model, sessions[0].length_unit) if model else None
        arm = convert_unit(arm, sessions[0].length_unit) if arm else None
        require_effects(measurements, [*effects, *(model.effects if model else ()), *(arm.effects if arm else ())])
        require_measured_once(sessions)
        begun = course.initial_hand_eyes(sessions, measurements, model)
        measurements = [with_part_origin(m, own.T_mount) for m, own in zip(measurements, begun, strict=True)]
        seconds = clock.lap()
        before = []
        for session, measurement, own, recorder in zip(sessions, measurements, begun, recorders, strict=True):
            with refuse_explained_mistake(session):
                before.append(course.initial_stage(measurement, own, seconds, recorder))
        clock.lap()

        def with_arm(arm: ModelFile | None) -> InitialModel | None:
            return partial(start_with_effects, sessions[0], effects, arm) if effects or arm else None

        if model:
            fit = partial(course.apply, file=model)
        else:
            fit = partial(course.fit, starts=begun, initial_model=with_arm(arm), recorder=recorders[0])
        found = fit_screened_views(sessions, measurements, fit, keep)
        end = FitSummary(begun, found.fitted, clock.lap(), model.effects_file if model else None, register)
        if model and not sessions[0].has_clouds:
            found = check_model_transfer(found, partial(_fit_own_model, course, found, with_arm(arm_model(model))))
        if len(sessions) > 1 and effects:
            alone = partial(_fit_single_session, course, found, begun, with_arm(arm))
            apart = find_disagreeing_sessions([s.name for s in found.sessions], found.fitted, alone)
            end = replace(end, doubts=tuple(own.doubt(sessions[0].length_unit) for own in apart))
        if arm:
            again = partial(course.fit, found.sessions, found.measurements, begun, recorder=SilentRecorder())
            here = check_arm_transfer(lambda other: again(initial_model=with_arm(other)), arm, found.fitted)
            end = _note_arm_transfer(end, here, sessions[0].length_unit)
        return _assemble_runs(sessions, found, end, before, recorders, keep)


def _note_arm_transfer(end: FitSummary, here: ArmTransfer, length_unit: str) -> FitSummary:
    """A note that the arm of another run holds here, or the doubt that it does not."""
    told = (here.sentence(length_unit),)
    return replace(end, notes=told) if here.holds else replace(end, doubts=(*end.doubts, *told))


def _fit_single_session(
    pipeline: Pipeline, found: ScreenedFit, starts: Sequence[CoarseHandEye], initial_model: InitialModel | None, i: int
) -> FittedRig:
    """One session of a rig by itself."""
    return pipeline.fit([found.sessions[i]], [found.measurements[i]], [starts[i]], initial_model, SilentRecorder())


def _fit_own_model(pipeline: Pipeline, found: ScreenedFit, initial_model: InitialModel | None) -> FittedRig:
    """Hand-eye and targets from the sessions themselves."""
    begun = pipeline.initial_hand_eyes(found.sessions, found.measurements, None)
    return pipeline.fit(found.sessions, found.measurements, begun, initial_model, SilentRecorder())


def _assemble_runs(
    sessions: Sequence[Session],
    found: ScreenedFit,
    end: FitSummary,
    before: Sequence[StageResult],
    recorders: Sequence[Recorder],
    keep: bool,
) -> list[Run]:
    """One run per session, with what is said of it alone."""
    runs = []
    for i, (session, own) in enumerate(zip(found.sessions, found.screenings, strict=True)):
        if len(session.views) < len(sessions[i].views):
            recorders[i].start(session)
        out, kept = ((), own.left_out) if keep else (own.left_out, ())
        last = replace(end, left_out=out, kept=kept, suspected=own.suspected, links=own.links)
        last = replace(last, doubts=(*end.doubts, *own.doubts))
        runs.append(assemble_run(session, i, last, before[i], recorders[i]))
    return runs


def diagnose(run: Run | RunState) -> Diagnosis:
    """Find which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    return diagnose_state(state_of(run) if isinstance(run, Run) else run)
