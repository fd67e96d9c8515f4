"""The run of a session with labelled points: coarse → correct → register; there is no cloud to fuse."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from stitch import frames
from stitch.diagnosis.start import evidence_at, start_values
from stitch.effects.chain import Chain, Term, about_part
from stitch.effects.terms import known, terms_of
from stitch.frames import Array
from stitch.labelled.fit import LabelledFit, rms_of
from stitch.labelled.gross import Outlier
from stitch.labelled.landmarks import Drawing, drawing_of, settled
from stitch.labelled.reuse import judged
from stitch.labelled.robust import robust_fit, without_gross
from stitch.labelled.rows import Rows, evidence_of_rows, rows_of
from stitch.labelled.start import closed_form
from stitch.labelled.words import notes_of, sentence
from stitch.model import Model
from stitch.observability import unobservable
from stitch.overlap.capture import Capture
from stitch.recorder import Recorder
from stitch.repeatability import scatter_from
from stitch.result import FusedCloud, Run, StageResult
from stitch.session import Session
from stitch.stages.coarse import REUSED, STATED
from stitch.threads import Clock


def run_labelled(
    session: Session, chain: Chain, model: Model | None, effects: Sequence[str], recorder: Recorder
) -> Run:
    """Find hand-eye, targets and effects; with a model, judge the session by it.

    Raises:
        InputError: the session cannot have an effect of the model.
        NoResultError: the views do not show the hand-eye, or contradict each other.
    """
    clock = Clock()
    stated = model.T_mount if model else session.scanner.T_mount
    T_mount = closed_form(chain.capture) if stated is None else stated
    chain = about_part(chain, T_mount)
    source = REUSED if model else STATED if stated is not None else "found in closed form"
    before = _begin(chain, T_mount, source, clock.lap(), recorder)
    if model:
        terms: list[Term] = terms_of(model, chain)
        found, chain, outliers = without_gross(chain, lambda c: judged(c, model, terms))
    else:
        found, chain, outliers = robust_fit(chain, (), T_mount, _drawing(session, chain))
        if effects:
            evidence = partial(evidence_at, chain, (), found.T_mount, float("nan"), session.nominal)
            terms = start_values(chain, [known(name) for name in effects], evidence)
            found, chain, outliers = robust_fit(chain, terms, found.T_mount, _drawing(session, chain))
    return finish_labelled(session, chain, T_mount, found, outliers, before, recorder, clock.lap())


def change_labelled(
    session: Session, chain: Chain, terms: Sequence[Term], T_mount: Array, T_coarse: Array, recorder: Recorder
) -> Run:
    """The run with these effects in its model, everything fitted anew from where the old model stands."""
    clock = Clock()
    before = _begin(chain, T_coarse, "of the first run", clock.lap(), recorder)
    found, chain, outliers = robust_fit(chain, terms, T_mount, _drawing(session, chain))
    return finish_labelled(session, chain, T_coarse, found, outliers, before, recorder, clock.lap())


def _drawing(session: Session, chain: Chain) -> Drawing | None:
    assert chain.capture.sightings is not None
    return drawing_of(session.nominal, chain.capture.sightings)


def _begin(chain: Chain, T_mount: Array, note: str, seconds: float, recorder: Recorder) -> StageResult:
    rows = rows_of(chain.capture, T_mount, settled(chain.capture, T_mount))
    distances = rows.distances(rows.left)
    stage = StageResult("coarse", rms_of(distances), int(np.isfinite(distances).sum()), 1, seconds, note)
    recorder.stage(stage, chain.capture.poses(T_mount), list(distances))
    return stage


def finish_labelled(
    session: Session, chain: Chain, T_coarse: Array, found: LabelledFit, outliers: Sequence[Outlier],
    before: StageResult, recorder: Recorder, seconds: float,
) -> Run:  # fmt: skip
    """Register single views, collect the result, and show it to the recorder."""
    clock, rows = Clock(), found.rows
    own = rows.capture
    poses_model = own.poses(found.T_mount)
    distances = rows.distances(rows.left)
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
        session=session, chain=chain, T_mount=found.T_mount, T_mount_coarse=T_coarse, mount_covariance=found.covariance,
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
    pushed = np.linalg.solve(covariance, -rows.left[:V, :, None])
    twist = (scatter @ rows.lever.transpose(0, 2, 1) @ pushed)[..., 0]
    moved = frames.inverse(to_centre) @ frames.exp(twist) @ to_centre @ poses
    left = rows.left.copy()
    left[:V] += np.einsum("vmi,vi->vm", rows.lever, twist)
    return np.asarray(moved), rows.distances(left)


def _targets_as_cloud(own: Capture, found: LabelledFit) -> FusedCloud:
    """The targets in place of a fused cloud: position, rms distance of the views from it, number of views."""
    assert own.sightings is not None
    positions, seen = found.landmarks.positions, np.minimum(own.sightings.seen, 65535)
    return FusedCloud(positions, np.zeros_like(positions), found.target_rms, seen.astype(np.int32))
