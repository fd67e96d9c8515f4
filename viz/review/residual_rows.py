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


def read_rows(run: Path, result: dict[str, Any], labelled: bool) -> ResidualRows:
    """The rows of a run of clouds; of labelled points alone, if they are all that it has.

    Args:
        result: result.json of the same run.

    Raises:
        InputError: a damaged file, or one without surfaces.
    """
    wanted = ["view", "partner", *_COLUMNS]
    try:
        file = pq.ParquetFile(run / "residuals.parquet")
        if not set(wanted) <= set(file.schema_arrow.names):
            raise InputError(f"{run}: has no surfaces to show a part of")
        step = 1 if labelled else max(1, -(-file.metadata.num_rows // _AT_MOST))
        parts, left = [], 0
        for batch in file.iter_batches(columns=wanted):
            parts.append(batch.take(pa.array(np.arange(left, batch.num_rows, step))))
            left = (left - batch.num_rows) % step
        table = pa.Table.from_batches(parts, file.schema_arrow.empty_table().select(wanted).schema)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{run}/residuals.parquet: cannot be read ({error}); run `stitch run` again") from None
    rows = (_sightings if labelled else _both_sides)(table, result, 1 / step)
    del parts, batch, table
    pa.default_memory_pool().release_unused()  # three times what the rows take
    return rows


def _sightings(table: pa.Table, result: dict[str, Any], share: float) -> ResidualRows:
    """Every labelled point as a row: the 3D distance from its place, and where that is."""
    names, poses, values = _views_and_values(table, result)
    targets = tuple(sorted(set(table["partner"].to_pylist())))
    return ResidualRows(
        views=names,
        view=_numbers(table["view"], names),
        residual=values[:, 6],
        place=values[:, :3],
        normal=values[:, 3:6],
        poses=poses,
        share=share,
        targets=targets,
        target=_numbers(table["partner"], targets),
    )


def _both_sides(table: pa.Table, result: dict[str, Any], share: float) -> ResidualRows:
    names, poses, values = _views_and_values(table, result)
    e = values[:, 6]
    # As the rms of a run: what lies beyond the gate is an edge.
    inside = np.abs(e) < RMS_GATE * MAD_TO_SIGMA * float(np.median(np.abs(e))) if len(e) else np.zeros(0, bool)
    values, e = values[inside], e[inside]
    return ResidualRows(
        views=names,
        view=np.concatenate([_numbers(table[side], names)[inside] for side in ("view", "partner")]),
        residual=np.concatenate([e, -e]),
        place=np.vstack([values[:, :3]] * 2),
        normal=np.vstack([values[:, 3:6]] * 2),
        poses=poses,
        share=share,
    )


def _views_and_values(table: pa.Table, result: dict[str, Any]) -> tuple[tuple[str, ...], Array, Array]:
    """Names (V,) and poses (V, 4, 4) of the views, and the values (N, 7) of a table."""
    names = tuple(row["view"] for row in result["views"])
    poses = np.array([row["pose"] for row in result["views"]], float)
    return names, poses, np.column_stack([table[name].to_numpy() for name in _COLUMNS])


def _numbers(column: pa.ChunkedArray, names: tuple[str, ...]) -> Indices:
    """(N,) where each text stands among the names; -1 where it does not."""
    told = column.combine_chunks().dictionary_encode()
    number = {name: i for i, name in enumerate(names)}
    known = np.array([number.get(text, -1) for text in told.dictionary.to_pylist()], np.int64)
    return known[told.indices.to_numpy()]
