"""Which way a run goes, from clouds or from labelled points, and its result collected at the end."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from stitch.fit import surface_steps, target_steps
from stitch.fit.coarse import REUSED, CoarseHandEye
from stitch.fit.register_and_fuse import FittedRig, Pipeline
from stitch.fit.sentences import view_notes
from stitch.model.model import Model
from stitch.observations.linear_model import LinearModel
from stitch.observations.observability import unknown_numbers, unobservable
from stitch.recorder import Recorder
from stitch.run_data import ExcludedView, LedgerStep, RunData, StageResult, ViewLinks
from stitch.session.measurement import Measurement, session_notes
from stitch.session.session import SessionData


def pipeline_for(session: SessionData) -> Pipeline:
    """How a run goes with what was observed."""
    return surface_steps if session.has_clouds else target_steps


def linearise(session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
    """What a session says about what a model lacks.

    Args:
        gate: largest distance between partners, length_unit; NaN without clouds.

    Raises:
        NoResultError: no two views overlap.
    """
    return pipeline_for(session).linearise(session, measurement, model, gate)


@dataclass(frozen=True)
class FitSummary:
    """What all sessions of a rig have in common at the end of the fit."""

    starts: Sequence[CoarseHandEye]  # of every session
    fitted: FittedRig
    seconds: float
    effects_file: str | None
    ledger: tuple[LedgerStep, ...] = ()
    left_out: tuple[ExcludedView, ...] = ()  # views of the session that do not belong
    kept: tuple[ExcludedView, ...] = ()  # such views that were fused all the same
    suspected: tuple[ExcludedView, ...] = ()  # views that stand out, and are fused
    links: ViewLinks = field(default_factory=ViewLinks)
    doubts: tuple[str, ...] = ()  # of the session as a whole
    notes: tuple[str, ...] = ()  # of the rig


def assemble_run(session: SessionData, index: int, end: FitSummary, before: StageResult, recorder: Recorder) -> RunData:
    """Register and fuse one session, collect its result with its line in the history, and show it."""
    course, fitted = pipeline_for(session), end.fitted
    found, step = course.finish(session, fitted, index, before, recorder, end.seconds)
    own, model, begun = fitted.sessions[index], fitted.model_of(index), end.starts[index]
    # Where several sessions share a hand-eye no joint has one place for all.
    shared = fitted.captures if session.has_clouds else [fitted.captures[index]]
    joints = session.joints if len(shared) == 1 else None
    found = replace(
        found,
        targets=own.targets,
        outliers=own.outliers,
        unobservable=unobservable(shared, model.T_mount, session.robot, joints),
        # A hand-eye of another run is as well known as it was there.
        unknown=() if begun.source == REUSED else unknown_numbers(shared, model.T_mount),
        notes=(
            *view_notes(end.left_out, end.kept, end.suspected),
            *course.notes(session, fitted, index, begun),
            *session_notes(session),
            *end.notes,
        ),
    )
    result = RunData(
        session=session,
        measurement=own.measurement,
        model=model,
        T_mount_coarse=begun.T_mount,
        gate=float("nan") if found.overlaps is None else found.overlaps.gate,
        residual_rms=step.residual_rms,
        heldout_rms=step.heldout_rms,
        noise_floor=step.noise_floor,
        source=found,
        register_method=next((stage.method for stage in found.stages if stage.method), ""),
        ledger=(*end.ledger, step),
        effects_file=end.effects_file,
        doubts=end.doubts,
        left_out=end.left_out,
        links=end.links,
    )
    recorder.finish(result)
    return result
