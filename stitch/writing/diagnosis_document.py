"""diagnosis.json from a diagnosis."""

from typing import Any

import numpy as np

from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.unknown.joint_curves import JointCurve
from stitch.diagnosis.unknown.time_curve import TimeCurve
from stitch.observations.surfaces.field_error import FieldError
from stitch.writing.json_file import rows_of_fields
from stitch.writing.plain_finding import plain_finding

FORMAT = "stitch-diagnosis/1"


def diagnosis_document(d: Diagnosis) -> dict[str, Any]:
    """diagnosis.json as a dictionary; candidates best first, those that the data cannot see last."""
    return {
        "format": FORMAT,
        "verdict": d.verdict,
        "effects": list(d.effects),
        "plain": plain_finding(d, d.linear.measurement.length_unit),
        "sentence": d.sentence,
        "residual_rms": d.residual_rms,
        "noise_floor": d.noise_floor,
        "repeatability": {"rotation": d.rotation, "translation": d.translation},
        "candidates": [
            *(_candidate(d, c) for c in d.candidates),
            *(_untested(name, needs) for name, needs in d.missing.items()),
        ],
        "depends_on": rows_of_fields(d.depends_on, "covariate score p_value bins mean sigma shape"),
        "joint_laws": [_curve(curve) for curve in d.curves],
        "time_law": None if d.time_curve is None else _time_curve(d.time_curve),
        "next": rows_of_fields(d.next, "do separates joints_deg views"),
        "alias_matrix": {"effects": [c.name for c in d.candidates], "correlation": np.round(d.matrix, 4).tolist()},
        "log_odds_over_nothing": d.log_odds_over_nothing if np.isfinite(d.log_odds_over_nothing) else None,
        "notes": list(d.notes),
        "doubts": list(d.doubts),
        "budget": rows_of_fields(d.budget, "source variance_share sigma unit"),
        "field_map": _field_map(d.scanner_error),
        "views": d.linear.measurement.views.count,
        "evidence": d.linear.mixed.size,
    }


def _curve(curve: JointCurve) -> dict[str, Any]:
    """Along what a joint errs by no known law, in the unit of its covariate; errors in rad."""
    return {
        "joint": curve.joint,
        "covariate": curve.covariate,
        "share": curve.share,
        "at": curve.at.tolist(),
        "error": curve.error.tolist(),
        "sigma": curve.sigma.tolist(),
        "may_follow": list(curve.may_follow),
    }


def _time_curve(curve: TimeCurve) -> dict[str, Any]:
    """When in the session a flange errs by no known law, in its own frame; rotation in rad, then translation."""
    return {
        "steps": curve.steps.tolist(),
        "seconds_a_step": curve.seconds or None,
        "error": curve.error.tolist(),
        "sigma": curve.sigma.tolist(),
    }


def _field_map(smooth: FieldError | None) -> dict[str, Any] | None:
    """Where in its field the scanner errs along the ray, in length_unit; null where too few points were seen."""
    if smooth is None or smooth.map is None:
        return None
    drawn = {"error": smooth.map.error, "sigma": smooth.map.sigma}
    rows = {name: [[x if np.isfinite(x) else None for x in row] for row in at.tolist()] for name, at in drawn.items()}
    return {"x_over_z": smooth.map.x.tolist(), "y_over_z": smooth.map.y.tolist()} | rows


def _untested(name: str, needs: tuple[str, ...]) -> dict[str, Any]:
    """An effect that lacks what it needs."""
    unknown = ("p_value", "rms_if_added", "heldout_rms_if_added", "minimum_detectable")
    return {
        "effect": name,
        "posterior": 0.0,
        "observable": False,
        "parameters": {},
        "aliases": [],
        "needs": list(needs),
        **dict.fromkeys(unknown),
    }


def _candidate(d: Diagnosis, candidate: CandidateEffect) -> dict[str, Any]:
    r, s, left_out = candidate.ranked, candidate.ranked.score, candidate.cross_validation
    parameters: dict[str, Any] = {
        p.name: {"value": p.value, "sigma": None, "unit": p.unit} | ({"view": p.view} if p.view else {})
        for p in s.form.term.parameters
        if p.grid
    }
    if s.observable and s.fitted:
        parameters |= {
            p.name: {"value": float(v), "sigma": float(x), "unit": p.unit}
            for p, v, x in zip(s.form.free, s.values, s.sigmas, strict=True)
        }
    inside, heldout = (None, None) if left_out is None else d.rms_if_added(left_out)
    detectable = {name: x for name, x in candidate.detectable.items() if np.isfinite(x)}
    return {
        "effect": s.name,
        "p_value": r.adjusted if s.observable else None,
        "posterior": r.posterior if s.observable else 0.0,
        "observable": s.observable,
        "parameters": parameters,
        "rms_if_added": inside,
        "heldout_rms_if_added": heldout,
        # Of the parameter that these views know best against its plausible size; all below.
        "minimum_detectable": detectable.get(_clearest_parameters(candidate) or ""),
        "minimum_detectable_of": _clearest_parameters(candidate),
        "minimum_detectable_each": detectable,
        "hand_eye_if_missed": candidate.hand_eye,
        "aliases": [{"effect": a.name, "correlation": a.correlation} for a in candidate.aliases],
        "tier": s.candidate.effect.tier,
    }


def _clearest_parameters(candidate: CandidateEffect) -> str | None:
    sizes = {p.name: p.typical for p in candidate.ranked.score.candidate.parameters}
    found = candidate.detectable
    return min(found, key=lambda name: found[name] / sizes[name]) if found else None
