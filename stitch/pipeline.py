"""The run: coarse → correct → register → fuse, for one session or several of one rig."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from stitch.diagnosis.initial_values import evidence_at, evidence_of_state, start_values
from stitch.frames import Array
from stitch.measurement.capture import Capture, capture
from stitch.measurement.measurement import Measurement, about_part, measurement_of
from stitch.measurement.session import Session
from stitch.model.forward import corrected
from stitch.model.model_toml import Model, in_unit
from stitch.model.terms import known, sigmas_of, terms_of
from stitch.observations.surfaces.match import sample
from stitch.observations.surfaces.overlaps import collect
from stitch.observations.surfaces.scanner_field import field_scatters
from stitch.runs.recorder import Recorder, Silent
from stitch.runs.run import Run, StageResult, Step
from stitch.runs.sentences import coarse_note
from stitch.runs.target_sentences import beside_notes
from stitch.stages.coarse import COARSE_GATE, REUSED, STATED, Coarse, coarse, given, part_size
from stitch.stages.correct import COARSE_SAMPLES, Correction, correct
from stitch.stages.finish import finish, show
from stitch.stages.joint_fit import refine
from stitch.stages.mixed_fit import Beside, fitted_beside, weighed
from stitch.stages.reuse import reuse
from stitch.stages.rig import require_effects, require_same_rig
from stitch.stages.target_run import change_labelled, run_labelled
from stitch.stored.load_state import State
from stitch.system.threads import Clock, library_threads_off


def run(
    session: Session, model: Model | None = None, recorder: Recorder | None = None, effects: Sequence[str] = ()
) -> Run:
    """Stitch one session; with `model`, use its hand-eye and effects as they are instead of correcting.

    Args:
        effects: names of effects to fit together with the hand-eye.

    Raises:
        InputError: the model belongs to another mount, or the session cannot have an effect as the model has it.
        NoResultError: no hand-eye was found, or the views do not overlap.
    """
    return run_rig([session], model, [recorder or Silent()], effects)[0]


def run_rig(
    sessions: Sequence[Session], model: Model | None = None, recorders: Sequence[Recorder] | None = None,
    effects: Sequence[str] = (),
) -> list[Run]:  # fmt: skip
    """Stitch several sessions of one rig with one common hand-eye and common effects; one run per session."""
    require_same_rig(sessions, model)
    recorders = recorders or [Silent() for _ in sessions]
    with library_threads_off():
        clock = Clock()
        for session, recorder in zip(sessions, recorders, strict=True):
            recorder.start(session)
        measurements = [measurement_of(session, capture(session)) for session in sessions]
        effects = list(dict.fromkeys(effects))
        model = in_unit(model, sessions[0].length_unit) if model else None
        require_effects(measurements, [*effects, *(model.effects if model else ())])
        if not sessions[0].has_clouds:
            found = run_labelled(sessions[0], measurements[0], model, effects, recorders[0])
            return [_in_ledger(found, (), model.effects_file if model else None, recorders[0])]
        start = _start(sessions, measurements, model)
        measurements = [about_part(measurement, start.T_mount) for measurement in measurements]
        seconds = clock.lap()
        before = [_begin(c, start, seconds, r) for c, r in zip(measurements, recorders, strict=True)]
        clock.lap()
        correction, both = fitted_beside(measurements, lambda own: _correct(own, start, model, effects, recorders[0]))
        seconds = clock.lap()
        place = _Place(start, correction, (), model.effects_file if model else None)
        return [
            _finish(session, own, i, place, before[i], recorders[i], seconds)
            for i, (session, own) in enumerate(zip(sessions, both, strict=True))
        ]


def change(state: State, effects: Sequence[str], recorder: Recorder | None = None) -> Run:
    """The run with these effects in its model: hand-eye and all effects fitted together, matched anew.

    Raises:
        InputError: an effect that is not known, or that the session cannot have.
        NoResultError: no two views overlap.
    """
    recorder = recorder or Silent()
    with library_threads_off():
        clock = Clock()
        measurement = state.measurement
        recorder.start(state.session)
        effects = list(dict.fromkeys(effects))
        require_effects([measurement], effects)
        kept = [t for t in state.terms if t.effect.name in effects]
        used = [t.effect.name for t in kept]
        new = [known(name) for name in effects if name not in used]
        terms = [*kept, *start_values(measurement, new, partial(evidence_of_state, state))]
        if not state.session.has_clouds:
            found = change_labelled(state.session, measurement, terms, state.T_mount, state.T_mount_coarse, recorder)
            found = replace(found, poses_before=corrected(measurement, state.terms, state.T_mount).poses(state.T_mount))
            return _in_ledger(found, state.ledger, state.effects_file, recorder)
        start = Coarse(state.T_mount_coarse, part_size([measurement.capture]) * COARSE_GATE, "of the first run", ())
        before = _begin(measurement, start, clock.lap(), recorder)
        clock.lap()
        correction, both = fitted_beside(
            [measurement], lambda own: refine(own, terms, state.T_mount, [state.gate]).as_correction()
        )
        place = _Place(start, correction, state.ledger, state.effects_file)
        poses_before = corrected(measurement, state.terms, state.T_mount).poses(state.T_mount)
        return _finish(state.session, both[0], 0, place, before, recorder, clock.lap(), poses_before)


@dataclass(frozen=True)
class _Place:
    """What all sessions of a rig have in common at the end of the correction."""

    start: Coarse
    correction: Correction
    ledger: tuple[Step, ...]
    effects_file: str | None


def _start(sessions: Sequence[Session], measurements: Sequence[Measurement], model: Model | None) -> Coarse:
    captures = [measurement.capture for measurement in measurements]
    if model:
        return given(captures, model.T_mount, REUSED)
    stated = next((s.scanner.T_mount for s in sessions if s.scanner.T_mount is not None), None)
    return coarse(captures) if stated is None else given(captures, stated, STATED)


def _correct(
    measurements: Sequence[Measurement], start: Coarse, model: Model | None, effects: Sequence[str], recorder: Recorder
) -> Correction:
    """The hand-eye from the scans; with effects, both; with a model, neither is changed."""
    captures: list[Capture] = [measurement.capture for measurement in measurements]
    if model:
        terms = terms_of(model, measurements[0])
        captures = [corrected(measurement, terms, model.T_mount) for measurement in measurements]
        return reuse(captures, model, terms, sigmas_of(model, measurements[0]))
    repeating = partial(field_scatters, measurements)
    first = correct(captures, start.T_mount, start.gate, recorder, repeating)
    if not effects:
        return first
    T_mount, gates = first.hand_eye.T_mount, [overlaps.gate for overlaps in first.overlaps]
    measurements = [
        weighed(measurement, own.noise_factor) for measurement, own in zip(measurements, first.captures, strict=True)
    ]
    # An event or a time constant is one for the whole rig: the first session says where it begins.
    evidence = partial(evidence_at, measurements[0], (), T_mount, gates[0])
    terms = start_values(measurements[0], [known(name) for name in effects], evidence)
    return refine(measurements, terms, T_mount, gates).as_correction()


def _begin(measurement: Measurement, start: Coarse, seconds: float, recorder: Recorder) -> StageResult:
    """How well the views of one session meet under the coarse hand-eye."""
    own, poses = measurement.capture, measurement.capture.poses(start.T_mount)
    g = collect(own, poses, start.gate, [sample(scan, COARSE_SAMPLES) for scan in own.scans]).gram
    stage = StageResult("coarse", g.rms, int(g.count.sum()), len(start.candidates), seconds, coarse_note(start))
    show(recorder, stage, own, poses, g.rms)
    return stage


def _finish(
    session: Session, both: Beside, index: int, place: _Place, before: StageResult, recorder: Recorder, seconds: float,
    poses_before: Array | None = None,
) -> Run:  # fmt: skip
    result = finish(session, both.measurement, index, place.start, place.correction, before, recorder, seconds)
    if both.found is not None:
        notes = (*result.notes, *beside_notes(both.found, both.outliers, session))
        result = replace(result, labelled=both.found, outliers=both.outliers, notes=notes)
    return _in_ledger(replace(result, poses_before=poses_before), place.ledger, place.effects_file, recorder)


def _in_ledger(result: Run, ledger: Sequence[Step], effects_file: str | None, recorder: Recorder) -> Run:
    """The result with its own line in the history, shown to the recorder."""
    step = Step(tuple(result.effects), result.residual_rms, result.heldout_rms, result.noise_floor, result.T_mount)
    result = replace(result, ledger=(*ledger, step), effects_file=effects_file)
    recorder.finish(result)
    return result
