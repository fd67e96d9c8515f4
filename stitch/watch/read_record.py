"""A run folder as the record of its cell's history: parameters with sigmas, when, under which conditions, of what."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.model.model_toml import ModelFile, read_model
from stitch.stages.coarse import REUSED
from stitch.stored.run_documents import read_result
from stitch.watch.mount_twist import middle_in_scanner
from stitch.watch.run_record import Estimate, RunRecord
from stitch.watch.session_conditions import session_conditions

# Tables by which a session is known again; its clouds may be gigabytes.
_TABLES = ("session.toml", "views.csv", "points.csv", "frames.csv", "targets.csv")


def read_record(folder: Path, at: float | None = None) -> RunRecord:
    """What a run folder says.

    Args:
        at: s since 1970, when the session was measured; default: what its files say.

    Raises:
        InputError: no run of one session, damaged, or one that used the model of another run as it is.
    """
    document, model = read_result(folder), read_model(folder)
    reused = any(REUSED in stage.get("note", "") for stage in document["stages"][:1])
    if reused and np.array_equal(model.T_mount, model.T_mount_coarse):
        raise InputError(
            f"{folder}: uses the hand-eye of another run as it is, so nothing was measured anew; to fix: run its "
            "session without --hand-eye"
        )
    session = Path(document["session"])
    found = session_conditions(session, folder / "result.json")
    run_hash = _files_hash([folder / "model.toml", folder / "result.json"])
    own = [session / name for name in _TABLES if (session / name).is_file()]
    repeatability = document["repeatability"]
    return RunRecord(
        path=folder.resolve(),
        session=document["session"],
        name=document.get("name") or session.name,
        run_hash=run_hash,
        session_hash=_files_hash(own) if own else run_hash,
        time=found.time if at is None else at,
        time_from=found.time_from if at is None else "stated",
        length_unit=model.length_unit,
        mount=model.mount,
        T_mount=model.T_mount,
        covariance=model.covariance,
        estimates=tuple(_estimates(model)),
        covariates=found.covariates,
        numbers={name: document[name] for name in ("residual_rms", "noise_floor")}
        | {f"repeatability_{name}": repeatability[name] for name in ("rotation", "translation")},
        document=document,
    )


def _estimates(model: ModelFile) -> list[Estimate]:
    return [
        Estimate(f"{effect}.{name}", p.unit, p.value, p.sigma)
        for effect, own in model.effects.items()
        for name, p in own.items()
        if np.isfinite(p.value) and np.isfinite(p.sigma) and p.sigma > 0
    ]


def _files_hash(files: Sequence[Path]) -> str:
    found = hashlib.sha256()
    for file in files:
        found.update(file.name.encode() + b"\0" + file.read_bytes())
    return found.hexdigest()


def scanned_middle(record: RunRecord) -> tuple[Array, float]:
    """(3,) middle of what a run saw, scanner frame, and how far its points lie from there, rms."""
    points = _points(record)
    middle = points.mean(axis=0)
    poses = np.array([view["pose"] for view in record.document["views"]], float)
    centre = middle_in_scanner(poses, middle) if len(poses) else np.zeros(3)
    return centre, float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))


def _points(record: RunRecord) -> Array:
    """(n, 3) of the stitched cloud, or the targets; reference frame."""
    targets = record.document.get("targets") or []
    if targets:
        return np.array([target["position"] for target in targets], float)
    if not (record.path / "stitched.ply").is_file():
        return np.zeros((1, 3))
    # The libraries that read clouds are asked for once in the life of a cell.
    from stitch.stored.stored_run import fused_cloud

    return fused_cloud(record.path / "stitched.ply").points
