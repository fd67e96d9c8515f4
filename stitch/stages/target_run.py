"""The run of a session with labelled points: coarse → correct → register; there is no cloud to fuse."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from stitch import frames
from stitch.diagnosis.initial_values import evidence_at, start_values
from stitch.frames import Array
from stitch.measurement.capture import Capture
from stitch.measurement.measurement import Measurement, Term, about_part
from stitch.measurement.session import Session
from stitch.model.model_toml import Model
from stitch.model.terms import known, terms_of
from stitch.observations.surfaces.pose_channel import scatter_from
from stitch.observations.targets.closed_form import closed_form
from stitch.observations.targets.landmarks import Drawing, drawing_of, initial_landmarks
from stitch.observations.targets.outliers import Outlier
from stitch.observations.targets.rows import Rows, evidence_of_rows, rows_of
from stitch.runs.recorder import Recorder
from stitch.runs.run import FusedCloud, Run, StageResult
from stitch.runs.target_sentences import notes_of, sentence
from stitch.stages.coarse import REUSED, STATED
from stitch.stages.observability import unobservable
from stitch.stages.reuse_targets import evaluate
from stitch.stages.target_fit import LabelledFit, rms_of
from stitch.stages.without_outliers import robust_fit, without_outliers
from stitch.system.threads import Clock


def run_labelled(
    session: Session, measurement: Measurement, model: Model | None, effects: Sequence[str], recorder: Recorder
) -> Run:
    """Find hand-eye, targets and effects; with a model, judge the session by it.

    Raises:
        InputError: the session cannot have an effect of the model.
        NoResultError: the views do not show the hand-eye, or contradict each other.
    """
    clock = Clock()
    stated = model.T_mount if model else session.scanner.T_mount
    T_mount = closed_form(measurement.capture) if stated is None else stated
    measurement = about_part(measurement, T_mount)
    source = REUSED if model else STATED if stated is not None else "found in closed form"
    before = _begin(measurement, T_mount, source, clock.lap(), recorder)
    if model:
        terms: list[Term] = terms_of(model, measurement)
        found, measurement, outliers = without_outliers(measurement, lambda c: evaluate(c, model, terms))
    else:
        found, measurement, outliers = robust_fit(measurement, (), T_mount, _drawing(session, measurement))
        if effects:
            evidence = partial(evidence_at, measurement, (), found.T_mount, float("nan"), session.nominal)
            terms = start_values(measurement, [known(name) for name in effects], evidence)
            found, measurement, outliers = robust_fit(measurement, terms, found.T_mount, _drawing(session, measurement))
    return finish_labelled(session, measurement, T_mount, found, outliers, before, recorder, clock.lap())


def change_labelled(
    session: Session,
    measurement: Measurement,
    terms: Sequence[Term],
    T_mount: Array,
    T_coarse: Array,
    recorder: Recorder,
) -> Run:
    """The run with these effects in its model, everything fitted anew from where the old model stands."""
    clock = Clock()
    before = _begin(measurement, T_coarse, "of the first run", clock.lap(), recorder)
    found, measurement, outliers = robust_fit(measurement, terms, T_mount, _drawing(session, measurement))
    return finish_labelled(session, measurement, T_coarse, found, outliers, before, recorder, clock.lap())


def _drawing(session: Session, measurement: Measurement) -> Drawing | None:
    assert measurement.capture.sightings is not None
    return drawing_of(session.nominal, measurement.capture.sightings)


def _begin(measurement: Measurement, T_mount: Array, note: str, seconds: float, recorder: Recorder) -> StageResult:
    rows = rows_of(measurement.capture, T_mount, initial_landmarks(measurement.capture, T_mount))
    distances = rows.distances(rows.residual)
    stage = StageResult("coarse", rms_of(distances), int(np.isfinite(distances).sum()), 1, seconds, note)
    recorder.stage(stage, measurement.capture.poses(T_mount), list(distances))
    return stage


def finish_labelled(
    session: Session, measurement: Measurement, T_coarse: Array, found: LabelledFit, outliers: Sequence[Outlier],
    before: StageResult, recorder: Recorder, seconds: float,
) -> Run:  # fmt: skip
    """Register single views, collect the result, and show it to the recorder."""
    clock, rows = Clock(), found.rows
    own = rows.capture
    poses_model = own.poses(found.T_mount)
    distances = rows.distances(rows.residual)
    count = int(np.isfinite(distances).sum())
    poses, after = registered(rows, found.variances, poses_model)
    corrections = frames.log(poses @ frames.inverse(poses_model))
    stages = [
        before,
        StageResult(
            "correct", found.rms, count, len(found.history), seconds, "3D distance of targets from their place"
        ),
        StageResult("register", rms_of(after), count, 1, clock.lap(), "each view moved by its own most likely error"),
    ]
    recorder.stage(stages[1], poses_model, list(distances))
    recorder.stage(stages[2], poses, list(after))
    scatter = scatter_from(found.variances)
    with_joints = session.robot is not None and all(view.joints is not None for view in session.views)
    joints = np.array([view.joints for view in session.views]) if with_joints else None
    per_view = np.sqrt(np.nansum(distances**2, axis=1) / np.maximum(np.isfinite(distances).sum(axis=1), 1))
    return Run(
        session=session, measurement=measurement, T_mount=found.T_mount, T_mount_coarse=T_coarse,
        mount_covariance=found.covariance,
        unobservable=unobservable([own], found.T_mount, session.robot, joints),
        stages=tuple(stages), poses_model=poses_model, poses=poses, corrections=corrections, view_rms=per_view,
        residual_rms=found.rms, heldout_rms=found.heldout_rms, noise_floor=found.noise_floor,
        fused=_targets_as_cloud(own, found), repeatability=scatter, overlaps=None,
        verdict=sentence(found, rms_of(after), found.noise_floor, scatter, session.length_unit),
        terms=found.terms, sigmas=found.sigmas,
        convergence={"correct": list(found.history), "register": [rms_of(after)]},
        notes=notes_of(found, outliers, session), labelled=found, outliers=tuple(outliers),
    )  # fmt: skip


def registered(rows: Rows, variances: Array, poses: Array) -> tuple[Array, Array]:
    """Poses (V, 4, 4) moved by each view's most likely error, and what is left of its targets, (V, S).

    The most likely twist of a view is C·leverᵀ·V⁻¹·(−left) (best linear unbiased prediction, Robinson 1991).
    """
    V = len(rows.lever)
    to_centre = frames.make(np.eye(3), -rows.centre)
    carried = frames.adjoint(to_centre @ rows.capture.T_reference_flange)
    scatter = carried * np.repeat(variances[:2], 3) @ carried.transpose(0, 2, 1)
    covariance = evidence_of_rows(rows, rows.hand_eye).covariance(variances)[:V]
    pushed = np.linalg.solve(covariance, -rows.residual[:V, :, None])
    twist = (scatter @ rows.lever.transpose(0, 2, 1) @ pushed)[..., 0]
    moved = frames.inverse(to_centre) @ frames.exp(twist) @ to_centre @ poses
    left = rows.residual.copy()
    left[:V] += np.einsum("vmi,vi->vm", rows.lever, twist)
    return np.asarray(moved), rows.distances(left)


def _targets_as_cloud(own: Capture, found: LabelledFit) -> FusedCloud:
    """The targets in place of a fused cloud: position, rms distance of the views from it, number of views."""
    assert own.sightings is not None
    positions, seen = found.landmarks.positions, np.minimum(own.sightings.seen, 65535)
    return FusedCloud(positions, np.zeros_like(positions), found.target_rms, seen.astype(np.int32))
