"""result.json, ledger.json and the model of a run, as plain data."""

from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from stitch.model.model import Target
from stitch.model.model_toml import ModelFile
from stitch.numerics.frames import Array
from stitch.observations.targets.outliers import Outlier, mask_outliers
from stitch.observations.targets.target_model import TargetModelFit
from stitch.output.comparison.disagreement_field import model_history
from stitch.output.comparison.run_verdict import run_verdict
from stitch.output.json_file import FORMAT
from stitch.run_data import ExcludedView, RunData, StageResult
from stitch.session.measurement import Measurement
from stitch.session.session import SessionData, View

# What labelled points add to model.toml, result.json and residuals.parquet, and back.


def targets_of(found: TargetModelFit | None) -> dict[str, Target]:
    """The targets that were seen, for model.toml."""
    if found is None:
        return {}
    sightings = found.rows.sightings
    sigma = found.landmark_sigmas
    return {
        name: Target(found.landmarks.positions[k], sigma[k], found.landmarks.orientation)
        for k, name in enumerate(sightings.targets)
        if np.isfinite(found.landmarks.positions[k]).all()
    }


def target_rows(found: TargetModelFit | None) -> list[dict[str, Any]]:
    """The list `targets` of result.json, reference frame."""
    targets = targets_of(found)
    if found is None:
        return []
    sightings = found.rows.sightings
    seen = dict(zip(sightings.targets, sightings.view_counts, strict=True))
    return [
        {"target": name, "position": t.position.tolist(), "sigma": t.sigma.tolist(), "seen": int(seen[name])}
        | ({} if t.orientation is None else {"orientation": t.orientation.tolist()})
        for name, t in targets.items()
    ]


def labelled_facts(run: RunData) -> dict[str, Any]:
    """What the rms of a run on labelled points counts, the errors left out and inside, and the outliers."""
    if run.targets is None:
        return {}
    rows = run.targets.rows
    facts = {
        "position_error": _sizes(rows.distances(rows.residual)),
        "outliers": [
            {"view": run.session.views[o.view].name, "target": o.target, "distance": o.distance, "times_usual": o.times}
            for o in run.outliers
        ],
    }
    if run.overlaps is not None:
        # The rms of the run is that of its surfaces, and views are left out with both.
        return facts | {"cloud_noise_factor": run.measurement.capture.noise_factor}
    return facts | {
        "rms_of": "3D distances of the targets from their place",
        "heldout_position_error": _sizes(run.targets.heldout),
    }


def _sizes(distances: Array) -> dict[str, float]:
    d = distances[np.isfinite(distances)]
    return {"mean": float(d.mean()), "median": float(np.median(d)), "max": float(d.max())}


def residual_columns(found: TargetModelFit, session: SessionData) -> dict[str, Array]:
    """Columns of residuals.parquet, a row per target and view: `partner` is the target, `residual` the 3D distance."""
    rows, s = found.rows, found.rows.sightings
    v, slot = np.nonzero(s.used)
    left = rows.residual[: len(s.used), : rows.positions].reshape(*s.used.shape, 3)[v, slot]
    names = np.array(session.names)
    out: dict[str, Array] = {"view": names[v], "partner": np.array(s.targets)[s.target[v, slot]]}
    out |= dict(zip("xyz", found.landmarks.positions[s.target[v, slot]].T, strict=True))
    distance = np.linalg.norm(left, axis=1)
    out |= dict(zip(("nx", "ny", "nz"), (left / np.maximum(distance, 1e-300)[:, None]).T, strict=True))
    out |= {"residual": distance, "heldout": found.heldout[v, slot]}
    covariates = sorted({key for view in session.views for key in view.covariates})
    out |= {key: np.array([view.covariates.get(key, np.nan) for view in session.views])[v] for key in covariates}
    # As floats, NaN where nobody states it.
    return out | {"time_s": np.array([view.time_s for view in session.views], float)[v]}


def restore_counted_targets(measurement: Measurement, session: SessionData, document: dict[str, Any]) -> Measurement:
    """The measurement as result.json counts its labelled points: less the outliers, and weighed against the clouds."""
    s, outliers = measurement.capture.sightings, document.get("outliers", ())
    if s is None:
        return measurement
    number = {view.name: v for v, view in enumerate(session.views)}
    gone = [Outlier(number[o["view"]], o["target"], np.nan, np.nan) for o in outliers if o["view"] in number]
    used = mask_outliers(s.used, gone, s.targets, s.target)
    factor = document.get("cloud_noise_factor", measurement.capture.noise_factor)
    own = replace(measurement.capture, sightings=replace(s, used=used), noise_factor=factor)
    return replace(measurement, capture=own)


_VERSIONS = ("stitch", "numpy", "scipy", "pykdtree", "libigl", "rerun-sdk", "kiss-icp", "trimesh")


def model_of(run: RunData) -> ModelFile:
    """The model that a run fitted, as model.toml states it; a file of effects is named while one of them is in use."""
    own = any(term.effect.tier == "user" for term in run.terms)
    return ModelFile(
        length_unit=run.session.length_unit,
        mount=run.session.mount,
        T_mount=run.T_mount,
        T_mount_coarse=run.T_mount_coarse,
        covariance=run.mount_covariance,
        effects={term.name: {p.name: p for p in term.parameters} for term in run.terms},
        effects_file=run.effects_file if own else None,
        targets=targets_of(run.targets),
        effects_covariance=run.model.effects_covariance,
    )


def result_document(run: RunData) -> dict[str, Any]:
    """result.json as a dictionary."""
    unit = run.session.length_unit
    return {
        "format": FORMAT,
        "session": str(run.session.path.resolve()),
        "name": run.session.name,
        "length_unit": unit,
        "mount": run.session.mount,
        "reference_frame": "flange" if run.session.mount == "eye_to_hand" else "base",
        "hand_eye": run.T_mount.tolist(),
        "hand_eye_coarse": run.T_mount_coarse.tolist(),
        "hand_eye_sigma": np.sqrt(np.diag(run.mount_covariance)).tolist(),
        "hand_eye_covariance": run.mount_covariance.tolist(),
        "unobservable": list(run.unobservable),
        "hand_eye_unknown": list(run.unknown),
        "hand_eye_stated": run.session.scanner.T_mount is not None,
        "stages": [_stage(s) for s in run.stages],
        "residual_rms": run.residual_rms,
        "heldout_rms": run.heldout_rms,
        "noise_floor": run.noise_floor,
        "repeatability": {"rotation": run.repeatability.rotation, "translation": run.repeatability.translation},
        "effects": _effects(run),
        "effects_covariance": {
            "parameters": list(run.model.effects_covariance.names),
            "matrix": run.model.effects_covariance.matrix.tolist(),
        },
        "views": _views(run),
        "left_out": [{"view": item.view, "why": item.why} for item in run.left_out],
        "linkage": _linkage(run),
        "unsupported_points": asdict(run.fit.unsupported),
        "targets": target_rows(run.targets),
        **labelled_facts(run),
        "convergence": run.convergence,
        "disagreement": _disagreement(run),
        "plain": run_verdict(run, model_history(run)),
        "verdict": run.verdict,
        "doubts": list(run.doubts),
        "notes": list(run.notes),
        "versions": _versions(),
    }


def _stage(stage: StageResult) -> dict[str, Any]:
    """A row of the stages; only register has a method."""
    row = asdict(stage) | {"seconds": round(stage.seconds, 3)}
    return row if stage.method else {key: value for key, value in row.items() if key != "method"}


def points_of(view: View) -> int:
    """Number of points that a view shows, of its cloud and by name."""
    labelled = 0 if view.sighting is None else len(view.sighting.targets)
    return labelled + (0 if view.cloud is None else view.cloud.count)


def ledger(run: RunData) -> list[dict[str, Any]]:
    """The model's history, one step per change."""
    numbers = ["residual_rms", "heldout_rms", "noise_floor"]
    return [
        {"step": i, "effects": list(s.effects), "parameters": s.values, "hand_eye": s.T_mount.tolist()}
        | {key: getattr(s, key) for key in numbers}
        | ({"notes": [asdict(note) for note in s.notes]} if s.notes else {})
        for i, s in enumerate(run.ledger)
    ]


def _effects(run: RunData) -> dict[str, dict[str, Any]]:
    return {
        term.name: {
            p.name: {"value": p.value, "sigma": p.sigma, "unit": p.unit} | ({"view": p.view} if p.view else {})
            for p in term.parameters
        }
        for term in run.terms
    }


def _linkage(run: RunData) -> dict[str, Any]:
    """Groups of views that surfaces connect, and views that hang on a single pair."""
    return {
        "components": [list(part) for part in run.links.components],
        "weak": [{"view": v, "partner": w, "directions": "all, through one pair"} for v, w in run.links.weak],
    }


def _disagreement(run: RunData) -> dict[str, Any] | None:
    """How far the views disagree on the part at every step of the model's history; None without clouds."""
    history = model_history(run)
    if history is None or run.registered is None:
        return None
    return {
        "gate": run.registered.gate,
        "patch_radius": history.patches.radius,
        "steps": [
            {"step": s.name, "mean": s.field.mean_abs, "of_noise": s.field.noise, "largest": s.field.quantile()}
            for s in history.steps
        ],
    }


def _views(run: RunData) -> list[dict[str, Any]]:
    """All views of the session in their order; those that were left out stand between those that are fused."""
    rows = {int(number): _view(run, v) for v, number in enumerate(run.measurement.views.number)}
    free = (number for number in range(len(rows) + len(run.left_out)) if number not in rows)
    rows |= {number: _left_out_view(item) for number, item in zip(free, run.left_out, strict=True)}
    return [rows[number] for number in sorted(rows)]


def _left_out_view(item: ExcludedView) -> dict[str, Any]:
    """A view that is not fused: its pose is what the robot and the model say."""
    return {
        "view": item.view,
        "pose": item.pose.tolist(),
        "correction": [0.0] * 6,
        "rms": None,
        "points": item.points,
    }


def _view(run: RunData, v: int) -> dict[str, Any]:
    return {
        "view": run.session.views[v].name,
        "pose": run.poses[v].tolist(),
        "correction": run.corrections[v].tolist(),
        "rms": float(run.view_rms[v]),
        "points": points_of(run.session.views[v]),
    }


def _versions() -> dict[str, str]:
    found = {}
    for name in _VERSIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
