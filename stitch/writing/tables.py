"""stitched.ply and residuals.parquet."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from plyfile import PlyData, PlyElement

from stitch.frames import Array
from stitch.measurement.session import Session, View
from stitch.observations.surfaces.match import Match
from stitch.runs.run import FusedCloud, Run
from stitch.system.mapped_file import release_mapped
from stitch.writing.target_rows import residual_columns

_Value = TypeVar("_Value")

# Rows that are in memory at a time.
_ROWS = 1_000_000
_PLACE = ("x", "y", "z", "nx", "ny", "nz")
_RESERVED_COLUMNS = {"view", "partner", *_PLACE, "residual", "heldout", "time_s"}


def write_cloud(cloud: FusedCloud, path: Path) -> None:
    """Binary PLY with normals, `residual` and `count`; of a cloud in a file never more than a part is in memory."""
    names = ("x", "y", "z", "nx", "ny", "nz", "residual")
    layout = np.dtype([(name, "<f4") for name in names] + [("count", "<u2")])
    header = PlyData([PlyElement.describe(np.empty(0, layout), "vertex")], byte_order="<").header
    with path.open("wb") as out:
        out.write(header.replace("vertex 0", f"vertex {len(cloud.points)}").encode() + b"\n")
        for start in range(0, len(cloud.points), _ROWS):
            part = slice(start, start + _ROWS)
            columns = np.column_stack([cloud.points[part], cloud.normals[part], cloud.residual[part]])
            vertex = np.empty(len(columns), layout)
            for name, column in zip(names, columns.T, strict=True):
                vertex[name] = column
            vertex["count"] = cloud.count[part]
            vertex.tofile(out)
            for values in vars(cloud).values():
                release_mapped(values)


def write_residuals(run: Run, path: Path) -> None:
    """Write the table of residuals as Parquet."""
    pq.write_table(residual_table(run), path, compression="zstd")


def residual_table(run: Run) -> Any:
    """Return one row per residual of the model, before the register stage moves single views, as a pyarrow.Table.

    `time_s` is NaN where nobody states it; a covariate that is called like another column becomes `covariate_NAME`.
    What the clouds state of every point stands there as well, of the partner's point as `partner_NAME`.
    """
    session = _without_reserved_covariates(run.session)
    of_views = {key for view in session.views for key in view.covariates}
    of_points = {key for view in session.views if view.cloud is not None for key in view.cloud.scalars}
    parts = [] if run.overlaps is None else [_columns(session, m, of_views, of_points) for m in run.overlaps.matches]
    if run.targets is not None:
        parts.append(residual_columns(run.targets, session))
    # Beside clouds, labelled points have the columns of these.
    common = [key for key in (parts or [{}])[0] if all(key in part for part in parts)]
    columns = {key: np.concatenate([part[key] for part in parts]) for key in common}
    arrays = {
        key: pa.array(c).dictionary_encode() if c.dtype.kind == "U" else pa.array(c) for key, c in columns.items()
    }
    return pa.table(arrays)


def _without_reserved_covariates(session: Session) -> Session:
    """The session without covariates that would take the place of a column."""

    def free(values: dict[str, _Value]) -> dict[str, _Value]:
        return {f"covariate_{key}" if key in _RESERVED_COLUMNS else key: value for key, value in values.items()}

    def renamed(view: View) -> View:
        cloud = None if view.cloud is None else replace(view.cloud, scalars=free(view.cloud.scalars))
        return replace(view, covariates=free(view.covariates), cloud=cloud)

    return replace(session, views=tuple(renamed(view) for view in session.views))


def _columns(session: Session, m: Match, of_views: Iterable[str], of_points: Iterable[str]) -> dict[str, Array]:
    """Columns of one pair of views, a row per correspondence."""
    size = len(m.residual)
    own, time = session.views[m.v].covariates, session.views[m.v].time_s
    out = {name: np.repeat(session.views[v].name, size) for name, v in (("view", m.v), ("partner", m.w))}
    out |= dict(zip(_PLACE, (*m.middle.T, *m.normal.T), strict=True))
    out |= {"residual": m.residual, "time_s": np.full(size, np.nan if time is None else time)}
    out |= {key: np.full(size, own.get(key, np.nan)) for key in sorted(of_views)}
    for key in sorted(of_points):
        for name, v, index in ((key, m.v, m.index_v), (f"partner_{key}", m.w, m.index_w)):
            cloud = session.views[v].cloud
            if cloud is not None and key in cloud.scalars:
                out[name] = cloud.scalars[key][index]
            else:
                out.setdefault(name, np.full(size, np.nan))
    return out
