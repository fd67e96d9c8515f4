"""Whether the hand-eye and the targets of another run hold in a session of labelled points that fits none of them.

Another day the tracker may stand elsewhere, the tool be mounted anew, a ball of the same name sit in another nest: then
what is left is no error of the arm. Hand-eye and targets fitted here say so, within what both are known to.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stitch import frames
from stitch.errors import NoResultError
from stitch.frames import Array
from stitch.integrity.admitted_fit import ScreenedFit
from stitch.integrity.arm_limits import beyond_any_arm
from stitch.measurement.session import Session
from stitch.observations.targets.target_fit import TargetModelFit
from stitch.stages.fitted import FittedRig
from stitch.stages.outlier_removal import FittedSession
from stitch.statistics.shares import significantly_smaller
from stitch.statistics.tails import chi2_tail
from stitch.units import length_text

# That something which holds is doubted: half for the hand-eye, half for all targets.
_MODEL_CHANCE = 0.01
_LISTED = 4


@dataclass(frozen=True)
class ModelTransfer:
    """What of another run does not hold; lengths in length_unit, angles in rad."""

    turned: float  # of the hand-eye from there to here
    moved: float
    hand_eye: bool  # it lies elsewhere
    targets: tuple[str, ...]  # that lie elsewhere among those that both know
    farthest: float
    rms: float  # of the targets here
    own_rms: float  # with hand-eye and targets of this session

    def sentence(self, unit: str) -> str:
        """What lies elsewhere, and what to do."""
        told, off, own = [], length_text(self.rms, unit), length_text(self.own_rms, unit)
        if self.hand_eye:
            away = f"{length_text(self.moved, unit)} and {1e3 * self.turned:.3g} mrad"
            told.append(f"the hand-eye of the other run does not hold here: fitted here it lies {away} from there")
        if self.targets:
            more = f" and {len(self.targets) - _LISTED} more" if len(self.targets) > _LISTED else ""
            names, away = ", ".join(self.targets[:_LISTED]) + more, length_text(self.farthest, unit)
            told.append(f"{names} lie elsewhere than in the other run, by up to {away}")
        return (
            f"{'; '.join(told)} (targets are {off} off with it, {own} with what this session shows itself); to fix: "
            "run without --hand-eye, keep the arm alone (--arm), or give targets that moved another name"
        )


def check_model_transfer(found: ScreenedFit, fit: Callable[[], FittedRig]) -> ScreenedFit:
    """Sessions under the model of another run, with what is to be doubted of it in each.

    Args:
        fit: hand-eye and targets fitted here, with the arm of that run.

    Raises:
        NoResultError: no arm errs by as much as the other run's model leaves.
    """
    try:
        own: list[FittedSession | None] = [*fit().sessions]
    except NoResultError:
        own = [None] * len(found.sessions)
    every = zip(found.screenings, found.sessions, found.fitted.sessions, own, strict=True)
    doubted = [
        replace(a, doubts=(*a.doubts, *_transfer_warnings(session, there, here))) for a, session, there, here in every
    ]
    return replace(found, screenings=doubted)


def _transfer_warnings(session: Session, applied: FittedSession, own: FittedSession | None) -> tuple[str, ...]:
    """What to doubt; nothing where the other run holds."""
    there = applied.targets
    assert there is not None
    beyond = beyond_any_arm(session, *np.sqrt(there.variances[:2]))
    found = None if own is None or own.targets is None else _compare_with_own(applied, own)
    if found is not None and (found.hand_eye or found.targets):
        told = found.sentence(session.length_unit)
        if beyond:
            raise NoResultError(f"{session.path}: {told}")
        return (f"{told[0].upper()}{told[1:]}.",)
    if beyond and own is None:
        off = length_text(there.rms, session.length_unit)
        raise NoResultError(
            f"{session.path}: under the model of the other run the targets lie {off} off, which no arm does; to fix: "
            "name a run of the same set-up, or keep its arm alone (--arm)"
        )
    return ()


def _compare_with_own(applied: FittedSession, own: FittedSession) -> ModelTransfer | None:
    """None where what is fitted here leaves no less than chance would."""
    there, here = applied.targets, own.targets
    assert there is not None and here is not None
    squares = there.view_squares, here.view_squares
    if not significantly_smaller(squares[1], squares[0], _MODEL_CHANCE):
        return None
    apart = frames.log(frames.inverse(there.model.T_mount) @ here.model.T_mount)
    covariance = there.model.covariance + here.model.covariance
    away, names = _displaced_targets(there, here)
    return ModelTransfer(
        turned=float(np.linalg.norm(apart[:3])),
        moved=float(np.linalg.norm(apart[3:])),
        hand_eye=chi2_tail(_mahalanobis_square(apart, covariance), 6) < _MODEL_CHANCE / 2,
        targets=names,
        farthest=away,
        rms=float(np.sqrt(np.nanmean(squares[0]))),
        own_rms=float(np.sqrt(np.nanmean(squares[1]))),
    )


def _displaced_targets(there: TargetModelFit, here: TargetModelFit) -> tuple[float, tuple[str, ...]]:
    """How far the farthest lies from where the other run has it, and the names of those that lie elsewhere."""
    sigmas, found = here.landmark_sigmas, dict[str, float]()
    known = {name: k for k, name in enumerate(here.rows.sightings.targets) if name in there.model.targets}
    for name, k in known.items():
        other = there.model.targets[name]
        apart, variance = here.landmarks.positions[k] - other.position, sigmas[k] ** 2 + other.sigma**2
        if chi2_tail(float(np.sum(apart**2 / np.maximum(variance, 1e-300))), 3) < _MODEL_CHANCE / 2 / len(known):
            found[name] = float(np.linalg.norm(apart))
    return max(found.values(), default=0.0), tuple(found)


def _mahalanobis_square(apart: Array, covariance: Array) -> float:
    """dᵀ C⁻¹ d; a direction that is known exactly counts nothing."""
    unit = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    inverse = np.linalg.pinv(covariance / np.outer(unit, unit), rcond=1e-9, hermitian=True)
    return float((apart / unit) @ inverse @ (apart / unit))
