"""The residuals of a run, from its residuals.parquet: both sides of every correspondence, or every labelled point."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stitch.errors import InputError
from stitch.numerics.distributions import MAD_TO_SIGMA
from stitch.numerics.frames import Array, Indices
from stitch.observations.surfaces.normal_equations import RMS_GATE

# Correspondences that are kept; of more, every n-th.
_AT_MOST = 150_000
_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "residual")


@dataclass(frozen=True)
class ResidualRows:
    """N sides of correspondences under the present model, the first half of `view`, the second of `partner`.

    Or N labelled points, each once, by its 3D distance.
    """

    views: tuple[str, ...]
    view: Indices  # (N,)
    residual: Array  # (N,) signed distance outwards of the other view, length_unit
    place: Array  # (N, 3) reference frame
    normal: Array  # (N, 3)
    poses: Array  # (V, 4, 4) T_reference_scanner
    share: float  # of all correspondences
    targets: tuple[str, ...] = ()  # of labelled points
    target: Indices = field(default_factory=lambda: np.zeros(0, np.int64))  # (N,) likewise

    @cached_property
    def properties(self) -> dict[str, Array]:
        """Return the covariates of a point, as `stitch compare` names them."""
        away, seen = np.empty_like(self.place), np.empty(len(self.view))
        for v, T in enumerate(self.poses):  # view by view: all at once would take several times the memory
            own = np.flatnonzero(self.view == v)
            ray = self.place[own] - T[:3, 3]
            seen[own] = np.abs(np.einsum("ni,ni->n", ray, self.normal[own]))
            away[own] = ray @ T[:3, :3]
        far, (x, y, z) = np.linalg.norm(away, axis=1), away.T
        cosine = seen / np.maximum(far, 1e-300)
        with np.errstate(invalid="ignore", divide="ignore"):
            field = {"field a = x/z": x / z, "field b = y/z": y / z, "field ρ": np.hypot(x, y) / z}
        return {"range": far, "incidence": np.degrees(np.arccos(np.clip(cosine, -1, 1))), **field}


def read_rows(run: Path, result: dict[str, Any]) -> ResidualRows | None:
    """The rows of a run of clouds; None for labelled points alone.

    Args:
        result: result.json of the same run.

    Raises:
        InputError: a damaged file.
    """
    try:
        file = pq.ParquetFile(run / "residuals.parquet")
        if not {"view", "partner", *_COLUMNS} <= set(file.schema_arrow.names):
            return None
        step = max(1, -(-file.metadata.num_rows // _AT_MOST))
        parts, left = [], 0
        for batch in file.iter_batches(columns=["view", "partner", *_COLUMNS]):
            parts.append(batch.take(pa.array(np.arange(left, batch.num_rows, step))))
            left = (left - batch.num_rows) % step
        table = pa.Table.from_batches(
            parts, file.schema_arrow.empty_table().select(["view", "partner", *_COLUMNS]).schema
        )
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{run}/residuals.parquet: cannot be read ({error}); run `stitch run` again") from None
    rows = _both_sides(table, result, 1 / step)
    del parts, batch, table
    pa.default_memory_pool().release_unused()  # three times what the rows take
    return rows


def read_sightings(run: Path, result: dict[str, Any]) -> ResidualRows:
    """Every labelled point as a row: the 3D distance from its place, and where that is.

    Args:
        result: result.json of the same run.

    Raises:
        InputError: a damaged file.
    """
    try:
        table = pq.read_table(run / "residuals.parquet", columns=["view", "partner", *_COLUMNS])
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{run}/residuals.parquet: cannot be read ({error}); run `stitch run` again") from None
    names = tuple(row["view"] for row in result["views"])
    number = {name: v for v, name in enumerate(names)}
    values = np.column_stack([table[name].to_numpy() for name in _COLUMNS])
    view = np.array([number[name] for name in table["view"].to_pylist()], np.int64)
    poses = np.array([row["pose"] for row in result["views"]], float)
    targets, target = np.unique(np.array(table["partner"].to_pylist(), str), return_inverse=True)
    return ResidualRows(
        views=names,
        view=view,
        residual=values[:, 6],
        place=values[:, :3],
        normal=values[:, 3:6],
        poses=poses,
        share=1.0,
        targets=tuple(targets.tolist()),
        target=target.astype(np.int64),
    )


def _both_sides(table: pa.Table, result: dict[str, Any], share: float) -> ResidualRows:
    names = tuple(row["view"] for row in result["views"])
    number = {name: v for v, name in enumerate(names)}
    values = np.column_stack([table[name].to_numpy() for name in _COLUMNS])
    e = values[:, 6]
    # As the rms of a run: what lies beyond the gate is an edge.
    inside = np.abs(e) < RMS_GATE * MAD_TO_SIGMA * float(np.median(np.abs(e))) if len(e) else np.zeros(0, bool)
    sides = []
    for side in ("view", "partner"):
        told = table[side].combine_chunks()
        of = np.array([number.get(name, -1) for name in told.dictionary.to_pylist()])
        sides.append(of[told.indices.to_numpy()][inside])
    values, e = values[inside], e[inside]
    return ResidualRows(
        views=names,
        view=np.concatenate(sides).astype(np.int64),
        residual=np.concatenate([e, -e]),
        place=np.vstack([values[:, :3]] * 2),
        normal=np.vstack([values[:, 3:6]] * 2),
        poses=np.array([row["pose"] for row in result["views"]], float),
        share=share,
    )
