"""What the homography hides: effects of the camera by forward selection with F-test and BIC."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from stitch.cells.drilling.camera_model import CAMERA_EFFECTS, CameraFit, HoleObservations, fit_camera

# An effect enters when chance would do as well in less than one of a thousand cases, and the BIC agrees.
_EFFECT_P_LIMIT = 1e-3


@dataclass(frozen=True)
class CameraEffectTest:
    """One effect tried on top of a fit."""

    effect: str
    value: float
    sigma: float
    F: float
    p_value: float
    bic_change: float  # below zero: the fit with the effect is the better one
    accepted: bool


@dataclass(frozen=True)
class EffectSelection:
    """The trials in their order and the camera with what was accepted."""

    plain: CameraFit
    camera: CameraFit
    trials: tuple[CameraEffectTest, ...]


def select_effects(observations: HoleObservations) -> EffectSelection:
    """Forward selection among EFFECTS by F-test and BIC, the best first.

    Raises:
        NoResultError: the observations fix no camera.
    """
    plain = current = fit_camera(observations)
    trials: list[CameraEffectTest] = []
    while len(current.effects) < len(CAMERA_EFFECTS):
        fits = [fit_camera(observations, (*current.effects, e)) for e in CAMERA_EFFECTS if e not in current.effects]
        tried = [_test_effect(current, bigger) for bigger in fits]
        best = int(np.argmin([t.bic_change for t in tried]))
        trials.append(tried[best])
        if not tried[best].accepted:
            trials += [t for i, t in enumerate(tried) if i != best]
            break
        current = fits[best]
    return EffectSelection(plain, current, tuple(trials))


def _test_effect(smaller: CameraFit, bigger: CameraFit) -> CameraEffectTest:
    count = bigger.residuals.size
    free = count - bigger.unknowns
    F = (smaller.sum_of_squares - bigger.sum_of_squares) / (bigger.sum_of_squares / free)
    bic = count * np.log(bigger.sum_of_squares / smaller.sum_of_squares) + np.log(count)
    p = float(f.sf(max(F, 0.0), 1, free))
    effect = bigger.effects[-1]
    value = bigger.k1 if effect == "k1" else bigger.plate_height
    accepted = bool(p < _EFFECT_P_LIMIT and bic < 0)
    return CameraEffectTest(
        effect, value, bigger.sigma[effect], F=float(F), p_value=p, bic_change=float(bic), accepted=accepted
    )
