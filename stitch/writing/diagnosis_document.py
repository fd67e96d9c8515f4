"""diagnosis.json from a diagnosis."""

from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis

FORMAT = "stitch-diagnosis/1"


def diagnosis_document(d: Diagnosis) -> dict[str, Any]:
    """diagnosis.json as a dictionary; candidates best first, those that the data cannot see last."""
    return {
        "format": FORMAT,
        "verdict": d.verdict,
        "effects": list(d.effects),
        "sentence": d.sentence,
        "residual_rms": d.residual_rms,
        "noise_floor": d.noise_floor,
        "repeatability": {"rotation": d.rotation, "translation": d.translation},
        "candidates": [_candidate(d, s) for s in d.candidates] + [
            {"effect": name, "p_value": None, "posterior": 0.0, "observable": False, "parameters": {},
             "rms_if_added": None, "heldout_rms_if_added": None, "minimum_detectable": None, "aliases": [],
             "needs": list(needs)}
            for name, needs in d.missing.items()
        ],
        "depends_on": [
            {"covariate": x.covariate, "score": x.score, "p_value": x.p_value, "bins": x.bins.tolist(),
             "mean": x.mean.tolist(), "sigma": x.sigma.tolist(), "shape": x.shape}
            for x in d.depends_on
        ],
        "next": [
            {"do": p.do, "separates": list(p.separates), "joints_deg": p.joints_deg, "views": p.views} for p in d.next
        ],
        "alias_matrix": {"effects": [s.name for s in d.candidates], "correlation": np.round(d.matrix, 4).tolist()},
        "notes": list(d.notes),
        "views": d.evidence.measurement.views.count,
        "evidence": d.evidence.evidence.size,
    }  # fmt: skip


def _candidate(d: Diagnosis, candidate: CandidateEffect) -> dict[str, Any]:
    r = candidate.ranked
    s = r.score
    values = {p.name: v for p, v in zip(s.candidate.parameters, s.form.term.values, strict=True) if p.grid}
    kept = [p for p, k in zip(s.candidate.parameters, s.form.keep, strict=True) if k]
    units = {p.name: p.unit for p in s.candidate.parameters}
    parameters = {name: {"value": float(v), "sigma": None, "unit": units[name]} for name, v in values.items()}
    if s.observable and np.isfinite(s.sigmas).all():
        parameters |= {
            p.name: {"value": float(v), "sigma": float(x), "unit": p.unit}
            for p, v, x in zip(kept, s.values, s.sigmas, strict=True)
        }
    detectable = {name: x for name, x in candidate.detectable.items() if np.isfinite(x)}
    return {
        "effect": s.name,
        "p_value": r.adjusted if s.observable else None,
        "posterior": r.posterior if s.observable else 0.0,
        "observable": s.observable,
        "parameters": parameters,
        "rms_if_added": None
        if candidate.cross_validation is None
        else d.residual_rms * float(np.sqrt(candidate.cross_validation.inside)),
        "heldout_rms_if_added": None
        if candidate.cross_validation is None
        else d.residual_rms * float(np.sqrt(candidate.cross_validation.heldout)),
        # Of the parameter that these views know best against its plausible size; all below.
        "minimum_detectable": detectable.get(_clearest(candidate) or ""),
        "minimum_detectable_of": _clearest(candidate),
        "minimum_detectable_each": detectable,
        "hand_eye_if_missed": candidate.hand_eye,
        "aliases": [{"effect": a.name, "correlation": a.correlation} for a in candidate.aliases],
        "tier": s.candidate.effect.tier,
    }


def _clearest(candidate: CandidateEffect) -> str | None:
    sizes = {p.name: p.typical for p in candidate.ranked.score.candidate.parameters}
    found = candidate.detectable
    return min(found, key=lambda name: found[name] / sizes[name]) if found else None
