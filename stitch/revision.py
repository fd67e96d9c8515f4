"""Change the model of a run: put effects in or take them out, and fit everything again."""

from collections.abc import Sequence

from stitch.diagnosis.initial_values import start_with_effects
from stitch.integrity.admission import session_warnings
from stitch.measurement.capture import part_size
from stitch.runs.recorder import Recorder, SilentRecorder
from stitch.runs.run import Run
from stitch.runs.state import RunState, state_of
from stitch.stages.coarse import COARSE_GATE, CoarseHandEye
from stitch.stages.course import FitSummary, assemble_run, pipeline_for
from stitch.stages.register import DEFAULT
from stitch.stages.rig import require_effects
from stitch.system.threads import Clock, library_threads_off


def add(run: Run | RunState, *effects: str, recorder: Recorder | None = None) -> Run:
    """Fit a run again with further effects in its model: hand-eye and all effects together.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
        NoResultError: no two views overlap.
    """
    state = state_of(run) if isinstance(run, Run) else run
    return change(state, [*state.model.effects, *effects], recorder)


def drop(run: Run | RunState, *effects: str, recorder: Recorder | None = None) -> Run:
    """Fit a run again without some of its effects."""
    state = state_of(run) if isinstance(run, Run) else run
    return change(state, [name for name in state.model.effects if name not in effects], recorder)


def change(state: RunState, effects: Sequence[str], recorder: Recorder | None = None) -> Run:
    """Fit a run again with these effects in its model: matches, hand-eye and all effects.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
        NoResultError: no two views overlap.
    """
    recorder = recorder or SilentRecorder()
    with library_threads_off():
        clock, course = Clock(), pipeline_for(state.session)
        session, measurement, effects = state.session, state.measurement, list(dict.fromkeys(effects))
        recorder.start(session)
        require_effects([measurement], effects)
        new = [name for name in effects if name not in state.model.effects]
        model = start_with_effects(session, new, None, measurement, state.model, state.gate)
        model = model.with_terms([term for term in model.terms if term.name in effects])
        gate = COARSE_GATE * part_size([measurement.capture]) if session.has_clouds else float("nan")
        begun = CoarseHandEye(state.T_mount_coarse, gate, "of the first run", ())
        before = course.initial_stage(measurement, begun, clock.lap(), recorder)
        clock.lap()
        fitted = course.refit([session], [measurement], model, [state.gate], recorder)
        own = fitted.sessions[0].measurement
        end = FitSummary(
            starts=[begun],
            fitted=fitted,
            seconds=clock.lap(),
            effects_file=state.effects_file,
            register=state.register or DEFAULT,
            ledger=state.ledger,
            left_out=state.left_out,
            links=state.links,
            doubts=session_warnings(session, own, fitted.correction, 0),
        )
        return assemble_run(session, 0, end, before, recorder)
