"""How far an effect that is too small to be seen would push the hand-eye: what its sigma does not hold."""

import numpy as np

from stitch import frames
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.evidence import ViewEvidence
from stitch.frames import Array


def hand_eye_if_missed(evidence: ViewEvidence, candidate: Candidate, detectable: dict[str, float]) -> float | None:
    """Largest displacement (length_unit) of the middle of the scanner's field by the error of the hand-eye.

    Each parameter in turn is there unseen, at its smallest detectable size or, where that is larger, at its plausible
    one; the hand-eye takes up of it what generalised least squares gives it. None if these views show no parameter.
    """
    lever = _lever(evidence)
    found = [
        min(detectable[p.name], p.typical) * float(np.linalg.norm(lever @ shift))
        for form in candidate.forms
        for p, shift in zip(
            [p for p, keep in zip(candidate.parameters, form.keep, strict=True) if keep],
            _shifts(evidence, form.columns).T, strict=True,
        )
        if np.isfinite(detectable.get(p.name, np.inf))
    ]  # fmt: skip
    return max(found, default=None)


def _shifts(evidence: ViewEvidence, columns: Array) -> Array:
    """(6, p) error of the hand-eye per unit of what columns (n, p) of the channel do."""
    scale = np.maximum(np.linalg.norm(evidence.white_model, axis=0), 1e-300)
    fitted = np.linalg.lstsq(evidence.white_model / scale, evidence.whiten_raw(columns), rcond=1e-10)[0]
    return np.asarray((fitted / scale[:, None])[:6])


def _lever(evidence: ViewEvidence) -> Array:
    """(3, 6) how a right perturbation of the hand-eye displaces the middle of the scanner's field."""
    middle = np.mean([points.mean(axis=0) for points in evidence.chain.capture.point_sets], axis=0)
    return np.hstack([-frames.skew(middle), np.eye(3)])
