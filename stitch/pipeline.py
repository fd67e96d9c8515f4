"""The run: coarse → correct → register → fuse, for one session or several of one rig; and what is missing."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from stitch.diagnosis.diagnose import diagnose_state
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.initial_values import with_effects
from stitch.integrity.admitted_fit import Admitted, admitted_fit
from stitch.integrity.arm_here import ArmHere, arm_here
from stitch.integrity.model_here import held_against_own
from stitch.integrity.refusals import mistakes_named
from stitch.integrity.rig_apart import sessions_apart
from stitch.measurement.capture import capture
from stitch.measurement.measurement import about_part, measurement_of
from stitch.measurement.session import Session
from stitch.model.arm import arm_in
from stitch.model.bound import in_unit
from stitch.model.model_toml import ModelFile
from stitch.runs.recorder import Recorder, Silent
from stitch.runs.run import Run, StageResult
from stitch.runs.state import State, state_of
from stitch.stages.coarse import Coarse
from stitch.stages.course import End, collected, course_of
from stitch.stages.fitted import BeginAt, Course, Fitted
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
    return run_rig([session], model, [recorder or Silent()], effects, keep, arm, register)[0]


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
    recorders = recorders or [Silent() for _ in sessions]
    with library_threads_off():
        clock, course = Clock(), course_of(sessions[0])
        for session, recorder in zip(sessions, recorders, strict=True):
            recorder.start(session)
        measurements = [measurement_of(session, capture(session)) for session in sessions]
        effects = list(dict.fromkeys(effects))
        model = in_unit(model, sessions[0].length_unit) if model else None
        arm = in_unit(arm, sessions[0].length_unit) if arm else None
        require_effects(measurements, [*effects, *(model.effects if model else ()), *(arm.effects if arm else ())])
        require_measured_once(sessions)
        begun = course.start(sessions, measurements, model)
        measurements = [about_part(m, own.T_mount) for m, own in zip(measurements, begun, strict=True)]
        seconds = clock.lap()
        before = []
        for session, measurement, own, recorder in zip(sessions, measurements, begun, recorders, strict=True):
            with mistakes_named(session):
                before.append(course.begin(measurement, own, seconds, recorder))
        clock.lap()

        def with_arm(arm: ModelFile | None) -> BeginAt | None:
            return partial(with_effects, sessions[0], effects, arm) if effects or arm else None

        if model:
            fit = partial(course.apply, file=model)
        else:
            fit = partial(course.fit, begun=begun, begin_at=with_arm(arm), recorder=recorders[0])
        found = admitted_fit(sessions, measurements, fit, keep)
        end = End(begun, found.fitted, clock.lap(), model.effects_file if model else None, register)
        if model and not sessions[0].has_clouds:
            found = held_against_own(found, partial(_fitted_here, course, found, with_arm(arm_in(model))))
        if len(sessions) > 1 and effects:
            alone = partial(_alone, course, found, begun, with_arm(arm))
            apart = sessions_apart([s.name for s in found.sessions], found.fitted, alone)
            end = replace(end, doubts=tuple(own.doubt(sessions[0].length_unit) for own in apart))
        if arm:
            again = partial(course.fit, found.sessions, found.measurements, begun, recorder=Silent())
            here = arm_here(lambda other: again(begin_at=with_arm(other)), arm, found.fitted)
            end = _with_arm_told(end, here, sessions[0].length_unit)
        return _of_each(sessions, found, end, before, recorders, keep)


def _with_arm_told(end: End, here: ArmHere, length_unit: str) -> End:
    """A note that the arm of another run holds here, or the doubt that it does not."""
    told = (here.sentence(length_unit),)
    return replace(end, notes=told) if here.holds else replace(end, doubts=(*end.doubts, *told))


def _alone(course: Course, found: Admitted, begun: Sequence[Coarse], begin_at: BeginAt | None, i: int) -> Fitted:
    """One session of a rig by itself."""
    return course.fit([found.sessions[i]], [found.measurements[i]], [begun[i]], begin_at, Silent())


def _fitted_here(course: Course, found: Admitted, begin_at: BeginAt | None) -> Fitted:
    """Hand-eye and targets from the sessions themselves."""
    begun = course.start(found.sessions, found.measurements, None)
    return course.fit(found.sessions, found.measurements, begun, begin_at, Silent())


def _of_each(
    sessions: Sequence[Session],
    found: Admitted,
    end: End,
    before: Sequence[StageResult],
    recorders: Sequence[Recorder],
    keep: bool,
) -> list[Run]:
    """One run per session, with what is said of it alone."""
    runs = []
    for i, (session, own) in enumerate(zip(found.sessions, found.admissions, strict=True)):
        if len(session.views) < len(sessions[i].views):
            recorders[i].start(session)
        out, kept = ((), own.left_out) if keep else (own.left_out, ())
        last = replace(end, left_out=out, kept=kept, suspected=own.suspected, links=own.links)
        last = replace(last, doubts=(*end.doubts, *own.doubts))
        runs.append(collected(session, i, last, before[i], recorders[i]))
    return runs


def diagnose(run: Run | State) -> Diagnosis:
    """Find which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    return diagnose_state(state_of(run) if isinstance(run, Run) else run)
