"""Test if the hand-eye and the targets of another run hold in a session of labelled points that fits none of them.

Another day the tracker may stand elsewhere, the tool be mounted anew, a ball of the same name sit in another nest: then
what is left is no error of the arm. Hand-eye and targets fitted here say so, within what both are known to.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.fit import FittedRig, FittedSession
from stitch.fit.surface_steps import per_view_rms
from stitch.model.model_toml import ModelFile
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail, f_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import equilibrated, significantly_smaller
from stitch.numerics.units import length_text
from stitch.observations.targets.target_model import TargetModelFit
from stitch.screening.deep_check import beyond_any_arm
from stitch.screening.view_screening import ScreenedFit
from stitch.session.session import SessionData

# That an arm which is right is doubted.
_ARM_CHANCE = 0.01
# A fit of the sessions with an arm, or with the nominal one.
FitWithArm = Callable[[ModelFile | None], FittedRig]


@dataclass(frozen=True)
class ArmTransfer:
    """Rms over all views with an arm, length_unit."""

    effects: tuple[str, ...]
    rms: float
    nominal_rms: float
    worse: bool  # the nominal arm leaves less, beyond chance
    better_without: str | None = None  # the effect without which the rest of the arm leaves least, and less
    without_rms: float = np.nan

    @property
    def holds(self) -> bool:
        """True unless the arm, or an effect of it, makes it worse."""
        return not self.worse and self.better_without is None

    def sentence(self, unit: str) -> str:
        """Return what the arm does here; a doubt where it does not hold."""
        here, nominal, without = (length_text(x, unit) for x in (self.rms, self.nominal_rms, self.without_rms))
        if self.holds:
            return f"The arm of the other run leaves {here} where the nominal arm leaves {nominal}."
        told = f"The arm of the other run ({', '.join(self.effects)}) does not hold here: it leaves {here}"
        if self.better_without is None:
            return f"{told}, the nominal arm {nominal}; calibrate it at poses like these, or run without --arm."
        return (
            f"{told}, the nominal arm {nominal}, and without its {self.better_without} {without} would be left; "
            "take that out there (stitch drop)."
        )


def check_arm_transfer(fit: FitWithArm, arm: ModelFile, found: FittedRig) -> ArmTransfer:
    """Hold the arm that was kept against the nominal one, and against itself without one of its effects.

    What imitates among the poses of one session may err at those of another; base, tool and targets are fitted with
    either arm, so that nothing but the arm makes the difference.

    Args:
        found: the fit with it.
    """
    own, nominal = view_mean_squares(found), view_mean_squares(fit(None))
    here = ArmTransfer(
        tuple(arm.effects),
        _rms_of_squares(own),
        _rms_of_squares(nominal),
        significantly_smaller(nominal, own, _ARM_CHANCE),
    )
    if len(arm.effects) < 2:
        return here
    rest = {name: {e: p for e, p in arm.effects.items() if e != name} for name in arm.effects}
    left = {name: view_mean_squares(fit(replace(arm, effects=effects))) for name, effects in rest.items()}
    best = min(left, key=lambda name: _rms_of_squares(left[name]))
    less = significantly_smaller(left[best], own, _ARM_CHANCE / len(left))
    return replace(here, better_without=best, without_rms=_rms_of_squares(left[best])) if less else here


def _rms_of_squares(squares: Array) -> float:
    return float(np.sqrt(np.nanmean(squares)))


def view_mean_squares(fitted: FittedRig) -> Array:
    """(ΣV,) mean square distance of the targets, or of the surfaces, in every view; NaN where nothing was seen."""
    if fitted.correction is not None:
        every = zip(fitted.captures, fitted.correction.overlaps, strict=True)
        return np.concatenate([per_view_rms(overlaps, len(c.scans)) ** 2 for c, overlaps in every])
    return np.concatenate([own.targets.view_squares for own in fitted.sessions if own.targets is not None])


# That one session of sound rigs is doubted.
_SESSION_CHANCE = 0.001
# Significant is not large: sessions of one arm, at other poses, differ by a tenth of an rms, and an rms of few views is
# no better known than that. Less is no reason to give up what the others tell of the effects.
_WORTH_A_TENTH = 0.1
# Numbers that the views show of each pose at the least, and that a session has of its own: base or hand-eye, and tool.
_NUMBERS_PER_VIEW, _NUMBERS_PER_SESSION = 3, 12


@dataclass(frozen=True)
class SessionDisagreement:
    """Rms over the views of one session, length_unit, with the effects of all and with its own."""

    name: str
    shared_rms: float
    separate_rms: float
    expected_rms: float  # of further views, with effects of its own
    p_value: float  # that effects of its own explain so much by chance
    large: bool  # sharing costs more than it gives

    def doubt(self, unit: str) -> str:
        """Return a warning with the size."""
        here, own, further = (length_text(x, unit) for x in (self.shared_rms, self.separate_rms, self.expected_rms))
        return (
            f"{self.name} does not share the effects of this rig: they leave {here}, fitted to it alone {own} "
            f"({further} on views left out); another arm, or something that has changed between the sessions: stitch "
            "each by itself."
        )


def find_disagreeing_sessions(
    names: Sequence[str], found: FittedRig, fit_separately: Callable[[int], FittedRig]
) -> list[SessionDisagreement]:
    """Find sessions that want effects of their own, beyond chance (F test, Bonferroni over sessions) and by size.

    Two arms of one make have the same table and other errors. In one fit with both, what the one does wrong is left in
    the other, and looks like an effect that is missing.

    Args:
        found: the fit of all.
        fit_separately: fits the session of that index by itself.
    """
    ends = np.cumsum([own.measurement.views.count for own in found.sessions])[:-1]
    every = np.split(view_mean_squares(found), ends)
    out = []
    for i, (name, together) in enumerate(zip(names, every, strict=True)):
        own = fit_separately(i)
        numbers = sum(int(np.count_nonzero(term.values)) for term in own.model_of(0).terms)
        tested = compare_with_own_effects(name, together, view_mean_squares(own), numbers)
        out += [tested] if tested.large and tested.p_value < _SESSION_CHANCE / len(names) else []
    return out


def compare_with_own_effects(name: str, shared: Array, separate: Array, numbers: int) -> SessionDisagreement:
    """Compare the mean squares of the views (V,) under the effects of all with those under a session's own.

    What further views would leave is Akaike's (1970) final prediction error: each parameter that was fitted to these
    views counts twice.

    Args:
        numbers: parameters of the effects that were fitted.
    """
    seen = np.isfinite(shared) & np.isfinite(separate)
    views = max(int(seen.sum()), 1)
    whole, own = float(shared[seen].sum()), float(separate[seen].sum())
    count = _NUMBERS_PER_VIEW * views
    left = count - numbers - _NUMBERS_PER_SESSION
    here, alone = float(np.sqrt(whole / views)), float(np.sqrt(own / views))
    if not numbers or left <= 0:
        return SessionDisagreement(name, here, alone, here, 1.0, False)
    p = f_tail(max((whole - own) / numbers / max(own / left, 1e-300), 0.0), numbers, left)
    further = alone * float(np.sqrt((count + numbers) / (count - numbers)))
    uncertain = max(_WORTH_A_TENTH, 2 / np.sqrt(2 * count))
    return SessionDisagreement(name, here, alone, further, p, here > (1 + uncertain) * further)


# That something which holds is doubted: half for the hand-eye, half for all targets.
_MODEL_CHANCE = 0.01
_LISTED = 4


@dataclass(frozen=True)
class ModelTransfer:
    """Parts of another run that do not hold; lengths in length_unit, angles in rad."""

    turned: float  # of the hand-eye from there to here
    moved: float
    hand_eye: bool  # it lies elsewhere
    targets: tuple[str, ...]  # that lie elsewhere among those that both know
    farthest: float
    rms: float  # of the targets here
    own_rms: float  # with hand-eye and targets of this session

    def sentence(self, unit: str) -> str:
        """Return what lies elsewhere, and what to do."""
        told, off, own = [], length_text(self.rms, unit), length_text(self.own_rms, unit)
        if self.hand_eye:
            away = f"{length_text(self.moved, unit)} and {1e3 * self.turned:.3g} mrad"
            told.append(f"the hand-eye of the other run does not hold here: fitted here it lies {away} from there")
        if self.targets:
            more = f" and {len(self.targets) - _LISTED} more" if len(self.targets) > _LISTED else ""
            names, away = ", ".join(self.targets[:_LISTED]) + more, length_text(self.farthest, unit)
            lie = "lie" if len(self.targets) > 1 else "lies"
            told.append(f"{names} {lie} elsewhere than in the other run, by up to {away}")
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


def _transfer_warnings(session: SessionData, applied: FittedSession, own: FittedSession | None) -> tuple[str, ...]:
    """Return warnings; none where the other run holds."""
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
    """Return how far the farthest lies from where the other run has it, and the names of those that lie elsewhere."""
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
    scaled, unit = equilibrated(covariance)
    return float((apart * unit) @ np.linalg.pinv(scaled, rcond=1e-9, hermitian=True) @ (apart * unit))
