"""Test if the model of another run holds here: its hand-eye, its targets, its arm, and the effects that a rig shares.

Another day the tracker may stand elsewhere, the tool be mounted anew, a ball of the same name sit in another nest: then
what is left is no error of the arm. Hand-eye and targets fitted here say so, within what both are known to.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.fit.correct import Correction
from stitch.fit.fit import FittedRig, FittedSession
from stitch.fit.surface_steps import per_view_rms
from stitch.model.model_toml import ModelFile
from stitch.numerics import frames
from stitch.numerics.distributions import chi2_tail, f_tail
from stitch.numerics.frames import Array
from stitch.numerics.least_squares import significantly_smaller
from stitch.numerics.units import length_text
from stitch.observations.surfaces.hand_eye_fit import solve_hand_eye
from stitch.observations.targets.target_model import TargetModelFit
from stitch.screening.hand_eye_transfer import hand_eye_difference, hand_eye_transfer, mahalanobis_square
from stitch.screening.hypotheses import sentence
from stitch.screening.plausibility import beyond_any_arm
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData

# A hand-eye that differs by chance alone is refused once in a million.
_HAND_EYE_CHANCE = 1e-6
# That a model which holds is doubted: half of it for the hand-eye, half for all targets (Bonferroni).
_MODEL_CHANCE = 0.01
# Targets that a message lists.
_LISTED = 4
# That an arm which is right is doubted.
_ARM_CHANCE = 0.01
# That one session of sound rigs is doubted.
_SESSION_CHANCE = 0.001
# Significant is not large: sessions of one arm, at other poses, differ by a tenth of an rms, and an rms of few views is
# no better known than that. Less is no reason to give up what the others tell of the effects.
_WORTH_A_TENTH = 0.1
# Numbers that the views show of each pose at the least, and that a session has of its own: base or hand-eye, and tool.
_NUMBERS_PER_VIEW, _NUMBERS_PER_SESSION = 3, 12

# A fit of the sessions with an arm, or with the nominal one.
FitWithArm = Callable[[ModelFile | None], FittedRig]


def require_matching_hand_eye(
    session: SessionData, measurement: Measurement, correction: Correction, index: int
) -> None:
    """Refuse a model whose hand-eye is off by more than any arm moves it, as these scans clearly show.

    Raises:
        NoResultError: it is.
    """
    capture, views = correction.captures[index], correction.unconstrained[index]
    fitted = solve_hand_eye([capture], [views], correction.model.T_mount)
    if not beyond_any_arm(session, *hand_eye_difference(capture, correction.model.T_mount, fitted.T_mount)):
        return
    transfer = hand_eye_transfer(measurement, capture, views, correction.model)
    if transfer.p_value < _HAND_EYE_CHANCE and beyond_any_arm(session, transfer.turn, transfer.distance):
        by = f"{transfer.distance:.3g} {session.length_unit} and {1e3 * transfer.turn:.3g} mrad"
        raise NoResultError(f"{session.path}: {sentence('hand-eye of another set-up', by=by)}")


def check_model_transfer(
    sessions: Sequence[SessionData], applied: FittedRig, fit: Callable[[], FittedRig]
) -> list[tuple[str, ...]]:
    """Return per session of labelled points the warnings about the model of another run; () where it holds.

    Args:
        applied: the sessions under that model.
        fit: fits hand-eyes and targets here, with the arm of that run.

    Raises:
        NoResultError: no arm errs by as much as the other run's model leaves.
    """
    fitted: Sequence[FittedSession | None] = [None] * len(sessions)
    with suppress(NoResultError):
        fitted = fit().sessions
    every = zip(sessions, applied.sessions, fitted, strict=True)
    return [_transfer_warnings(*of_session) for of_session in every]


def _transfer_warnings(session: SessionData, applied: FittedSession, fitted: FittedSession | None) -> tuple[str, ...]:
    """Return what to doubt of the other run's model in one session; () where it holds.

    Args:
        applied: the session under that model.
        fitted: with hand-eye and targets fitted here; None where no such fit came to an end.

    Raises:
        NoResultError: no arm errs by as much as that model leaves.
    """
    given = applied.targets
    assert given is not None
    beyond = beyond_any_arm(session, *np.sqrt(given.variances[:2]))
    text = None
    if fitted is not None and fitted.targets is not None:
        text = _what_does_not_hold(given, fitted.targets, session.length_unit)
    if text is not None:
        if beyond:
            raise NoResultError(f"{session.path}: {text}")
        return (f"{text[0].upper()}{text[1:]}.",)
    if beyond and fitted is None:
        off = length_text(given.rms, session.length_unit)
        raise NoResultError(f"{session.path}: {sentence('model of another set-up', off=off)}")
    return ()


def _what_does_not_hold(given: TargetModelFit, refitted: TargetModelFit, unit: str) -> str | None:
    """Return a sentence that hand-eye or targets have moved since the other run, and what to do; None if neither has.

    Moved means two things: fitted here, they leave significantly smaller residuals; and they differ from the other
    run's by more than the covariances of both allow.

    Args:
        given: the views of this session under the model of the other run.
        refitted: the same views with hand-eye and targets fitted to them.
        unit: of length.
    """
    if not significantly_smaller(refitted.view_squares, given.view_squares, _MODEL_CHANCE):
        return None
    # Right perturbation (6,) from the given hand-eye to the refitted one, scanner frame, as their covariances count it.
    xi = frames.log(frames.inverse(given.model.T_mount) @ refitted.model.T_mount)
    square = mahalanobis_square(xi, given.model.covariance + refitted.model.covariance)
    moved = []
    if chi2_tail(square, 6) < _MODEL_CHANCE / 2:
        mrad = 1e3 * float(np.linalg.norm(xi[:3]))
        shift = length_text(float(np.linalg.norm(xi[3:])), unit)
        moved.append(
            f"the hand-eye of the other run does not hold here: fitted here it lies {shift} and {mrad:.3g} mrad from "
            "there"
        )
    displaced = _displaced_targets(given, refitted)
    if displaced:
        more = f" and {len(displaced) - _LISTED} more" if len(displaced) > _LISTED else ""
        lie = "lie" if len(displaced) > 1 else "lies"
        farthest = length_text(max(displaced.values()), unit)
        names = ", ".join([*displaced][:_LISTED])
        moved.append(f"{names}{more} {lie} elsewhere than in the other run, by up to {farthest}")
    if not moved:
        return None
    rms_given = length_text(_rms(given.view_squares), unit)
    rms_refitted = length_text(_rms(refitted.view_squares), unit)
    return sentence("model does not hold", what="; ".join(moved), off=rms_given, fitted=rms_refitted)


def _displaced_targets(given: TargetModelFit, refitted: TargetModelFit) -> dict[str, float]:
    """Return by name how far (length_unit) targets are from where the other run has them, of those that have moved.

    A target has moved if a χ² test of three coordinates rejects, by the sigmas of both runs, at half of `_MODEL_CHANCE`
    over the number of targets (Bonferroni).

    Args:
        given: the session under the model of the other run.
        refitted: with hand-eye and targets fitted to it.
    """
    sigmas = refitted.landmark_sigmas
    known = {name: k for k, name in enumerate(refitted.rows.sightings.targets) if name in given.model.targets}
    displaced = dict[str, float]()
    for name, k in known.items():
        other = given.model.targets[name]
        difference = refitted.landmarks.positions[k] - other.position
        variance = sigmas[k] ** 2 + other.sigma**2
        if chi2_tail(float(np.sum(difference**2 / np.maximum(variance, 1e-300))), 3) < _MODEL_CHANCE / 2 / len(known):
            displaced[name] = float(np.linalg.norm(difference))
    return displaced


def check_arm_transfer(fit: FitWithArm, arm: ModelFile, fitted: FittedRig, unit: str) -> tuple[bool, str]:
    """Return whether the arm of another run holds here, and a sentence that says so.

    It does not if the nominal arm, or the same arm without one effect, leaves significantly smaller residuals. Base,
    tool and targets are fitted anew with each, so that only the arm makes the difference.

    Args:
        fit: fits the sessions with an arm; None: the nominal one.
        arm: effects of the other run.
        fitted: the fit with `arm`.
        unit: of length.
    """
    squares = view_mean_squares(fitted)
    nominal = view_mean_squares(fit(None))
    leaves = length_text(_rms(squares), unit)
    nominal_leaves = length_text(_rms(nominal), unit)
    effects = ", ".join(arm.effects)
    if len(arm.effects) > 1:
        without = {}
        for name in arm.effects:
            others = {effect: values for effect, values in arm.effects.items() if effect != name}
            without[name] = view_mean_squares(fit(replace(arm, effects=others)))
        best = min(without, key=lambda name: _rms(without[name]))
        if significantly_smaller(without[best], squares, _ARM_CHANCE / len(without)):
            rest = length_text(_rms(without[best]), unit)
            words = {"effects": effects, "leaves": leaves, "nominal": nominal_leaves}
            return False, sentence("effect of the arm", effect=best, rest=rest, **words)
    if significantly_smaller(nominal, squares, _ARM_CHANCE):
        return False, sentence("arm does not hold", effects=effects, leaves=leaves, nominal=nominal_leaves)
    return True, f"The arm of the other run leaves {leaves} where the nominal arm leaves {nominal_leaves}."


def _rms(squares: Array) -> float:
    return float(np.sqrt(np.nanmean(squares)))


def view_mean_squares(fitted: FittedRig) -> Array:
    """Return mean square distances (ΣV,), length_unit², of surfaces or else targets, in every view of all sessions.

    NaN where nothing was seen.
    """
    if fitted.correction is not None:
        every = zip(fitted.captures, fitted.correction.overlaps, strict=True)
        return np.concatenate([per_view_rms(overlaps, len(capture.scans)) ** 2 for capture, overlaps in every])
    return np.concatenate([session.targets.view_squares for session in fitted.sessions if session.targets is not None])


def find_disagreeing_sessions(
    names: Sequence[str], fitted: FittedRig, fit_separately: Callable[[int], FittedRig], unit: str
) -> tuple[str, ...]:
    """Return a sentence on each session of a rig that seems to be of another arm: it needs effects of its own.

    Its residuals must be smaller with its own effects beyond chance (F test, Bonferroni over the sessions), and by so
    much that sharing costs more than it gives (`compare_with_own_effects`).

    Args:
        fitted: the fit of all.
        fit_separately: fits the session of that index by itself.
        unit: of length.
    """
    ends = np.cumsum([session.measurement.views.count for session in fitted.sessions])[:-1]
    doubts = []
    for i, (name, shared) in enumerate(zip(names, np.split(view_mean_squares(fitted), ends), strict=True)):
        alone = fit_separately(i)
        numbers = sum(int(np.count_nonzero(term.values)) for term in alone.model_of(0).terms)
        rms, p_value, large = compare_with_own_effects(shared, view_mean_squares(alone), numbers)
        if large and p_value < _SESSION_CHANCE / len(names):
            texts = (length_text(x, unit) for x in rms)
            words = dict(zip(("shared", "separate", "expected"), texts, strict=True))
            doubts.append(sentence("another arm", session=name, **words))
    return tuple(doubts)


def compare_with_own_effects(shared: Array, separate: Array, numbers: int) -> tuple[list[float], float, bool]:
    """Return three rms of a session, length_unit, a p-value, and whether sharing effects with others costs too much.

    The rms are with shared effects, with its own, and with its own on further views: Akaike's (1970) final prediction
    error, in which each fitted parameter counts twice. p is that of an F test of its own effects. Sharing costs too
    much if the first rms exceeds the third by more than its uncertainty, a tenth at least.

    Args:
        shared: (V,) mean squares of the views under the effects of all sessions, length_unit².
        separate: (V,) the same under its own.
        numbers: parameters of its own effects.
    """
    seen = np.isfinite(shared) & np.isfinite(separate)
    views = max(int(seen.sum()), 1)
    shared_sum = float(shared[seen].sum())
    separate_sum = float(separate[seen].sum())
    count = _NUMBERS_PER_VIEW * views
    degrees = count - numbers - _NUMBERS_PER_SESSION
    rms = np.sqrt(np.array([shared_sum, separate_sum]) / views).tolist()
    if not numbers or degrees <= 0:
        return [*rms, rms[0]], 1.0, False
    p = f_tail(max((shared_sum - separate_sum) / numbers / max(separate_sum / degrees, 1e-300), 0.0), numbers, degrees)
    expected = rms[1] * float(np.sqrt((count + numbers) / (count - numbers)))
    uncertain = max(_WORTH_A_TENTH, 2 / np.sqrt(2 * count))
    return [*rms, expected], p, rms[0] > (1 + uncertain) * expected
