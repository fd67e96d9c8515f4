"""result.json, ledger.json and the model of a run, as plain data."""

from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from stitch.measurement.session import View
from stitch.model.model_toml import ModelFile
from stitch.runs.run import Run
from stitch.writing.target_rows import labelled_facts, target_rows, targets_of

FORMAT = "stitch-run/1"
_VERSIONS = ("stitch", "numpy", "scipy", "open3d-cpu", "open3d", "pykdtree", "rerun-sdk", "kiss-icp", "trimesh")


def model_of(run: Run) -> ModelFile:
    """The model that a run fitted, as model.toml states it."""
    return ModelFile(
        length_unit=run.session.length_unit,
        mount=run.session.mount,
        T_mount=run.T_mount,
        T_mount_coarse=run.T_mount_coarse,
        covariance=run.mount_covariance,
        effects={term.name: {p.name: p for p in term.parameters} for term in run.terms},
        effects_file=run.effects_file,
        targets=targets_of(run.targets),
    )


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
        "hand_eye_covariance": run.mount_covariance.tolist(),
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
            term.name: {p.name: {"value": p.value, "sigma": p.sigma, "unit": p.unit} for p in term.parameters}
            for term in run.terms
        },
        "views": [
            {"view": view.name, "pose": pose.tolist(), "correction": correction.tolist(), "rms": float(rms),
             "points": points_of(view)}
            for view, pose, correction, rms in zip(
                run.session.views, run.poses, run.corrections, run.view_rms, strict=True)
        ],
        "targets": target_rows(run.targets),
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
