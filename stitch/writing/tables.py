"""stitched.ply and residuals.parquet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from plyfile import PlyData, PlyElement

from stitch.frames import Array
from stitch.labelled.document import residual_columns
from stitch.result import FusedCloud, Run


def write_cloud(cloud: FusedCloud, path: Path) -> None:
    """Binary PLY with normals, `residual` and `count`."""
    names = ("x", "y", "z", "nx", "ny", "nz", "residual")
    columns = np.column_stack([cloud.points, cloud.normals, cloud.residual])
    vertex = np.empty(len(cloud.points), [(name, "<f4") for name in names] + [("count", "<u2")])
    for name, column in zip(names, columns.T, strict=True):
        vertex[name] = column
    vertex["count"] = cloud.count
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(path))


def write_residuals(run: Run, path: Path) -> None:
    """One row per residual of the model, before the register stage moves single views."""
    names = np.array([view.name for view in run.session.views])
    covariates = sorted({key for view in run.session.views for key in view.covariates})
    table: dict[str, list[Any]] = {}

    def add(key: str, values: Array | Sequence[str]) -> None:
        table.setdefault(key, []).append(values)

    for m in () if run.overlaps is None else run.overlaps.matches:
        size = len(m.residual)
        add("view", np.repeat(names[m.v], size))
        add("partner", np.repeat(names[m.w], size))
        for axis, column in zip("xyz", m.middle.T, strict=True):
            add(axis, column)
        for axis, column in zip("xyz", m.normal.T, strict=True):
            add(f"n{axis}", column)
        add("residual", m.residual)
        for key in covariates:
            add(key, np.full(size, run.session.views[m.v].covariates.get(key, np.nan)))
        if run.session.views[m.v].time_s is not None:
            add("time_s", np.full(size, run.session.views[m.v].time_s))
    if run.labelled is not None:
        for key, values in residual_columns(run.labelled, run.session).items():
            if run.overlaps is None or key in table:
                add(key, values)
    columns = {key: np.concatenate(parts) for key, parts in table.items()}
    arrays = {
        key: pa.array(c).dictionary_encode() if c.dtype.kind == "U" else pa.array(c) for key, c in columns.items()
    }
    pq.write_table(pa.table(arrays), path, compression="zstd")
