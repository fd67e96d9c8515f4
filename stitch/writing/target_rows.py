"""What labelled points add to model.toml, result.json and residuals.parquet, and back."""

from dataclasses import replace
from typing import Any

import numpy as np

from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.measurement.session import Session
from stitch.model.model import Target
from stitch.observations.targets.outliers import Outlier, mask_outliers
from stitch.observations.targets.target_fit import TargetModelFit
from stitch.runs.run import Run


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


def labelled_facts(run: Run) -> dict[str, Any]:
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


def residual_columns(found: TargetModelFit, session: Session) -> dict[str, Array]:
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


def restore_counted_targets(measurement: Measurement, session: Session, document: dict[str, Any]) -> Measurement:
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
