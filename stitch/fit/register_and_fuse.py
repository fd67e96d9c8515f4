"""The last steps of a run: register single views, fuse them, collect the result."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from stitch.fit.coarse import CoarseHandEye
from stitch.fit.correct import Correction
from stitch.fit.sentences import correct_note, register_note, support_note, surface_sentence, target_sentence
from stitch.fit.target_fit import FittedSession
from stitch.fusion.fuse import RegisteredSession, fuse_every_point, has_whole_clouds
from stitch.fusion.register import Method, Registration, register, register_targets, unseen_moves
from stitch.model.model import Model
from stitch.model.model_toml import ModelFile
from stitch.numerics import frames
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.hand_eye_fit import repeatability_from
from stitch.observations.surfaces.normal_equations import RMS_GATE, Overlaps
from stitch.observations.surfaces.view_poses import noise_floor
from stitch.observations.targets.target_model import TargetModelFit, rms_of
from stitch.recorder import IterationMemory, Recorder
from stitch.run_data import Fit, FusedCloud, LedgerStep, StageResult, Unsupported
from stitch.session.capture import Capture
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData
from stitch.system.threads import Clock, begin, take_mapped

# Places of the fused cloud that tell its rms to a part in a thousand.
_RMS_SAMPLES = 2_000_000


@dataclass(frozen=True)
class BegunRegistration:
    """One session's views, registered while something else goes on."""

    method: str
    registration: Future[tuple[Registration, float]]  # and its seconds
    # The same, where all points are in memory; None where they are read again, which takes time and room.
    fused: Future[tuple[FusedCloud, Unsupported, float]] | None
    iterations: IterationMemory


def begin_to_register_views(
    fitted: "FittedRig", sessions: Sequence[SessionData], method: Method
) -> tuple[BegunRegistration, ...]:
    """Begin to register and to fuse the views of every session under the common model, one session after the other."""
    correction = fitted.correction
    assert correction is not None
    coming = [
        BegunRegistration(method.name, Future(), None if has_whole_clouds(session) else Future(), IterationMemory())
        for session in sessions
    ]

    def register_one(i: int, session: SessionData, begun: BegunRegistration) -> None:
        clock, model, own = Clock(), correction.geometry, correction.captures[i]
        poses, scatter = own.poses(model.T_mount), correction.scatter[i]
        overlaps, start = correction.overlaps[i], correction.unconstrained[i].poses
        with _pass_errors_to(begun.registration):
            found = register(
                own, poses, scatter, overlaps.gate, begun.iterations, start, method=method, before=overlaps
            )
            begun.registration.set_result((found, clock.lap()))
            if begun.fused is not None and not begun.iterations.stopped:
                with _pass_errors_to(begun.fused):
                    registered = RegisteredSession(session, fitted.sessions[i].measurement, model, own, found.poses)
                    begun.fused.set_result((*fuse_every_point(registered), clock.lap()))

    def register_all() -> None:
        for i, (session, begun) in enumerate(zip(sessions, coming, strict=True)):
            register_one(i, session, begun)

    begin(register_all)
    return tuple(coming)


@contextmanager
def _pass_errors_to(future: Future[Any]) -> Iterator[None]:
    """Errors of the block are raised where the result is waited for."""
    try:
        yield
    except BaseException as error:
        future.set_exception(error)


def finish_surfaces(
    session: SessionData,
    measurement: Measurement,
    correction: Correction,
    *,
    index: int,
    before: StageResult,
    recorder: Recorder,
    seconds: float,
    begun: BegunRegistration,
) -> tuple[Fit, LedgerStep]:
    """Wait for session `index` of a rig to be registered and fused, and show it to the recorder.

    Raises:
        InputError: a scan changed on disk since it was read.
    """
    model, own, overlaps = correction.geometry, correction.captures[index], correction.overlaps[index]
    scatter = correction.scatter[index]
    poses_model = own.poses(model.T_mount)
    note = "" if correction.given else correct_note(before.rms, overlaps.gram.rms)
    corrected = _overlap_stage("correct", overlaps, len(correction.history), seconds, note)
    recorder.stage(corrected, poses_model)
    registration, taken = begun.registration.result()
    begun.iterations.tell(recorder)
    note = register_note(registration, session, unseen_moves(registration, poses_model))
    registered = _overlap_stage("register", registration.overlaps, len(registration.history), taken, note)
    registered = replace(registered, method=begun.method)
    recorder.stage(registered, registration.poses)
    if begun.fused is not None:
        fused, unsupported, taken = begun.fused.result()
    else:
        clock = Clock()
        fused, unsupported = fuse_every_point(RegisteredSession(session, measurement, model, own, registration.poses))
        taken = clock.lap()
    dropped = support_note(unsupported)
    last = StageResult("fuse", _fused_rms(fused.residual), int((fused.count > 1).sum()), 1, taken, dropped)
    recorder.stage(last, registration.poses)
    floor = noise_floor(own, registration.overlaps, session.scanner.noise)
    found = Fit(
        stages=(before, corrected, registered, last),
        poses_model=poses_model,
        poses=registration.poses,
        corrections=_twists(poses_model, registration.poses),
        view_rms=per_view_rms(registration.overlaps, len(own.scans)),
        fused=fused,
        unsupported=unsupported,
        repeatability=scatter,
        verdict=surface_sentence(corrected.rms, registered.rms, floor, scatter, session.length_unit, model.effects),
        convergence={"correct": list(correction.history), "register": list(registration.history)},
        # A search that nobody goes on from takes room.
        overlaps=replace(overlaps, searched=None),
        registered=replace(registration.overlaps, searched=None),
    )
    return found, _ledger_step(model, corrected.rms, corrected.rms * correction.hand_eye.heldout_ratio, floor)


def _twists(poses_model: Array, poses: Array) -> Array:
    """Return (V, 6) twists: poses = exp(twists) @ poses_model."""
    return frames.log(poses @ frames.inverse(poses_model))


def _ledger_step(model: Model, residual_rms: float, heldout_rms: float, noise_floor: float) -> LedgerStep:
    """Return the line of the model's history."""
    return LedgerStep(
        effects=tuple(model.effects),
        residual_rms=residual_rms,
        heldout_rms=heldout_rms,
        noise_floor=noise_floor,
        T_mount=model.T_mount,
        values={term.name: {p.name: p.value for p in term.parameters} for term in model.terms},
    )


def _overlap_stage(name: str, overlaps: Overlaps, iterations: int, seconds: float, note: str = "") -> StageResult:
    return StageResult(name, overlaps.gram.rms, int(overlaps.gram.count.sum()), iterations, seconds, note)


def finish_targets(
    session: SessionData, found: TargetModelFit, before: StageResult, recorder: Recorder, seconds: float
) -> tuple[Fit, LedgerStep]:
    """Register single views by their labelled points, and show it to the recorder; there is no cloud to fuse."""
    clock, rows = Clock(), found.rows
    own = rows.capture
    poses_model = own.poses(found.model.T_mount)
    distances = rows.distances(rows.residual)
    poses, after = register_targets(rows, found.variances, poses_model)
    total, history = int(np.isfinite(distances).sum()), len(found.history)
    corrected = StageResult(
        "correct", found.rms, total, history, seconds, "3D distances of the targets from their fitted positions"
    )
    registered = StageResult(
        "register", rms_of(after), total, 1, clock.lap(), "each view moved by its most likely pose error"
    )
    recorder.stage(corrected, poses_model)
    recorder.stage(registered, poses)
    scatter = repeatability_from(found.variances)
    fit = Fit(
        stages=(before, corrected, registered),
        poses_model=poses_model,
        poses=poses,
        corrections=_twists(poses_model, poses),
        view_rms=np.sqrt(found.view_squares),
        fused=_targets_as_cloud(found),
        repeatability=scatter,
        verdict=target_sentence(found, rms_of(after), scatter, session.length_unit),
        convergence={"correct": list(found.history), "register": [rms_of(after)]},
    )
    return fit, _ledger_step(found.model, found.rms, found.heldout_rms, found.noise_floor)


def _targets_as_cloud(found: TargetModelFit) -> FusedCloud:
    """The targets in place of a fused cloud: position, rms distance of the views from it, number of views."""
    positions, seen = found.landmarks.positions, np.minimum(found.rows.sightings.view_counts, 65535)
    return FusedCloud(positions, np.zeros_like(positions), found.target_rms, seen.astype(np.int32))


def per_view_rms(overlaps: Overlaps, views: int) -> Array:
    """(V,) rms of the residuals that touch a view, inside the robust gate; NaN for a view without partners."""
    square, count = np.zeros(views), np.zeros(views)
    for (v, w), s, n in zip(overlaps.gram.pairs, overlaps.gram.raw_square, overlaps.gram.count, strict=True):
        square[[v, w]] += s
        count[[v, w]] += n
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)


def _fused_rms(residual: Array) -> float:
    some = take_mapped(residual, np.arange(0, len(residual), -(-len(residual) // _RMS_SAMPLES)))
    seen = some[np.isfinite(some)]
    if not len(seen):
        return float("nan")
    # As in the overlaps: what lies beyond 4 robust sigmas is an edge, not a distance of surfaces.
    return float(np.sqrt(np.mean(seen[seen < RMS_GATE * MAD_TO_SIGMA * np.median(seen)] ** 2)))


# How a run goes with what was observed, and what the fit of a rig found.

# From a measurement, its model and the gate to the model that the fit of effects begins with.
InitialModel = Callable[[Measurement, Model, float], Model]


@dataclass(frozen=True)
class FittedRig:
    """The common model of a rig, and its sessions as they count."""

    sessions: list[FittedSession]
    captures: list[Capture]  # without the effects in use
    correction: Correction | None = None  # of surfaces
    begun: tuple[BegunRegistration, ...] = ()  # of surfaces

    def discard(self) -> None:
        """End what has been begun of it: it is not wanted any more."""
        for own in self.begun:
            own.iterations.stopped = True

    def model_of(self, index: int) -> Model:
        """Of one session: labelled points of an arm share its effects, and each session has its own hand-eye."""
        own = self.sessions[index].targets
        if self.correction is not None:
            return self.correction.model
        assert own is not None
        return own.model


class Pipeline(Protocol):
    """How a run goes with what was observed; a further kind of observation is one more module with these functions."""

    def initial_hand_eyes(
        self, sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile | None
    ) -> list[CoarseHandEye]:
        """The hand-eye of every session to begin with."""
        ...

    def initial_stage(
        self, measurement: Measurement, start: CoarseHandEye, seconds: float, recorder: Recorder
    ) -> StageResult:
        """How well the views agree under it."""
        ...

    def fit(
        self,
        sessions: Sequence[SessionData],
        measurements: Sequence[Measurement],
        starts: Sequence[CoarseHandEye],
        initial_model: InitialModel | None,
        recorder: Recorder,
    ) -> FittedRig:
        """Hand-eye and effects from the coarse hand-eye on."""
        ...

    def refit(
        self,
        sessions: Sequence[SessionData],
        measurements: Sequence[Measurement],
        model: Model,
        gates: Sequence[float],
        recorder: Recorder,
    ) -> FittedRig:
        """Hand-eye and the effects of a model fitted anew from where it stands."""
        ...

    def apply(self, sessions: Sequence[SessionData], measurements: Sequence[Measurement], file: ModelFile) -> FittedRig:
        """The sessions under a model of another run as it is."""
        ...

    def linearise(self, session: SessionData, measurement: Measurement, model: Model, gate: float) -> LinearModel:
        """What was observed, as one linear model about a model."""
        ...

    def begin_to_register(self, fitted: FittedRig, sessions: Sequence[SessionData], register: str) -> FittedRig:
        """The same, with single views being registered by a method, and fused, while other things go on."""
        ...

    def finish(
        self,
        session: SessionData,
        fitted: FittedRig,
        index: int,
        before: StageResult,
        recorder: Recorder,
        seconds: float,
    ) -> tuple[Fit, LedgerStep]:
        """Single views registered by a method, and fused."""
        ...

    def notes(self, session: SessionData, fitted: FittedRig, index: int, start: CoarseHandEye) -> tuple[str, ...]:
        """What a user should know before trusting the result."""
        ...
