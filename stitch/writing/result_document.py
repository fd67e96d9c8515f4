"""result.json, ledger.json and the model of a run, as plain data."""

from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from stitch.measurement.session import View
from stitch.model.model_toml import Model
from stitch.model.terms import fitted_of
from stitch.runs.run import Run
from stitch.writing.target_rows import labelled_facts, target_rows, targets_of

FORMAT = "stitch-run/1"
_VERSIONS = ("stitch", "numpy", "scipy", "open3d-cpu", "open3d", "pykdtree", "rerun-sdk", "kiss-icp", "trimesh")


def model_of(run: Run) -> Model:
    """The model that a run fitted."""
    return Model(
        run.session.length_unit, run.session.mount, run.T_mount, run.T_mount_coarse, run.mount_covariance,
        fitted_of(run.measurement, run.terms, run.sigmas), run.effects_file, targets_of(run.labelled),
    )  # fmt: skip


def result_document(run: Run) -> dict[str, Any]:
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
        "unobservable": list(run.unobservable),
        "stages": [
            {"name": s.name, "rms": s.rms, "correspondences": s.correspondences, "iterations": s.iterations,
             "seconds": round(s.seconds, 3), "note": s.note}
            for s in run.stages
        ],
        "residual_rms": run.residual_rms,
        "heldout_rms": run.heldout_rms,
        "noise_floor": run.noise_floor,
        "repeatability": {"rotation": run.repeatability.rotation, "translation": run.repeatability.translation},
        "effects": {
            name: {p: {"value": f.value, "sigma": f.sigma, "unit": f.unit} for p, f in fitted.items()}
            for name, fitted in fitted_of(run.measurement, run.terms, run.sigmas).items()
        },
        "views": [
            {"view": view.name, "pose": pose.tolist(), "correction": correction.tolist(), "rms": float(rms),
             "points": points_of(view)}
            for view, pose, correction, rms in zip(
                run.session.views, run.poses, run.corrections, run.view_rms, strict=True)
        ],
        "targets": target_rows(run.labelled),
        **labelled_facts(run),
        "convergence": run.convergence,
        "verdict": run.verdict,
        "notes": list(run.notes),
        "versions": _versions(),
    }  # fmt: skip


def points_of(view: View) -> int:
    """Number of points that a view shows, of its cloud and by name."""
    labelled = 0 if view.sighting is None else len(view.sighting.targets)
    return labelled + (0 if view.cloud is None else len(view.cloud.points))


def ledger(run: Run) -> list[dict[str, Any]]:
    """The model's history, one step per change."""
    return [
        {"step": i, "effects": list(s.effects), "residual_rms": s.residual_rms, "heldout_rms": s.heldout_rms,
         "noise_floor": s.noise_floor, "hand_eye": s.T_mount.tolist()}
        for i, s in enumerate(run.ledger)
    ]  # fmt: skip


def _versions() -> dict[str, str]:
    found = {}
    for name in _VERSIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
