"""Where model and labelled points part: offsets of the targets against everything that is known of the views.

A mean is that of the offset along the direction in which the bins of a property differ most, and its p-value knows
that the direction was chosen; rms is that of the 3D distance. Intervals count views: targets of one view share its
error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.comparison.table import ResidualTable, table_of
from stitch.comparison.tables import ResidualTables, equal_count_bins, property_varies, view_properties
from stitch.comparison.view_scatter import view_statistics
from stitch.frames import Array, Indices
from stitch.model.forward import corrected_capture
from stitch.observations.targets.landmarks import drawing_of, initial_landmarks
from stitch.observations.targets.rows import target_rows
from stitch.runs.state import RunState
from stitch.statistics.block_least_squares import BlockLeastSquares

# A direction is chosen for every table among so many dimensions.
_DIRECTIONS = 3


@dataclass(frozen=True)
class _Offsets:
    """N targets in views: where the view puts them less where they are."""

    view: Indices  # (N,)
    target: Indices  # (N,)
    offset: Array  # (N, 3) reference frame
    points: Array  # (N, 3) sensor frame
    views: int


def compare_targets(state: RunState) -> ResidualTables:
    """Tables of the offsets by view, target, joint, move, torque, approach, range, time and covariate."""
    rows = _target_offsets(state)
    s = state.measurement.capture.sightings
    assert s is not None
    labels = {"view": (rows.view, state.session.names), "target": (rows.target, list(s.targets))}
    tables = [
        _offset_table(rows, name, "", bins, _numbered_labels(names), names) for name, (bins, names) in labels.items()
    ]
    for name, unit, values in _offset_properties(state, rows):
        edges, bins = equal_count_bins(values)
        if len(edges) > 2:
            tables.append(_offset_table(rows, name, unit, bins, (edges[:-1], edges[1:]), ()))
    rms = float(np.sqrt(np.mean(np.sum(rows.offset**2, axis=1))))
    of_views = {name: values for name, _, values in _offset_view_properties(state)}
    return ResidualTables(tuple(tables), rms, rms, tuple(state.session.names), of_views)


def _target_offsets(state: RunState) -> _Offsets:
    """With the targets where hand-eye and effects of the model put them best."""
    own = corrected_capture(state.measurement, state.model)
    s = own.sightings
    assert s is not None
    T_mount = state.model.T_mount
    rows = target_rows(own, T_mount, initial_landmarks(own, T_mount, drawing_of(state.session.nominal, s)))
    diagonal = np.zeros((*rows.residual.shape, rows.residual.shape[1]))
    diagonal[:, np.arange(rows.residual.shape[1]), np.arange(rows.residual.shape[1])] = rows.noise + rows.fixed
    k = rows.landmarks.shape[2]
    left = (
        rows.residual
        + rows.landmarks @ BlockLeastSquares(-rows.residual, rows.landmarks, diagonal, np.zeros(k), np.zeros(k)).solve()
    )
    v, slot = np.nonzero(s.used)
    offset = left[: len(s.used), : rows.positions].reshape(*s.used.shape, 3)[v, slot]
    return _Offsets(v, s.target[v, slot], offset, s.points[v, slot], len(s.used))


def _numbered_labels(names: Sequence[str]) -> tuple[Array, Array]:
    number = np.arange(len(names), dtype=float)
    return number, number


def _offset_table(
    rows: _Offsets, name: str, unit: str, bins: Indices, edges: tuple[Array, Array], labels: Sequence[str]
) -> ResidualTable:
    size = len(edges[0])
    count = np.asarray(np.bincount(bins, minlength=size), float)
    sums_3d = np.stack([np.bincount(bins, rows.offset[:, i], size) for i in range(3)], axis=1)
    mean = sums_3d / np.maximum(count, 1)[:, None]
    direction = np.linalg.svd(mean - mean.mean(axis=0), full_matrices=False)[2][0] if size > 1 else np.eye(3)[0]
    along = rows.offset @ direction
    key, shape = bins * rows.views + rows.view, (size, rows.views)
    weights = np.ones(len(along)), along, np.sum(rows.offset**2, axis=1)
    n, s, q = (np.asarray(np.bincount(key, w, size * rows.views), float).reshape(shape) for w in weights)
    return table_of(name, unit, edges, tuple(labels), view_statistics(n, s, q, directions=_DIRECTIONS))


def _offset_properties(state: RunState, rows: _Offsets) -> list[tuple[str, str, Array]]:
    """Name, unit and value of every property, per row."""
    out = [("range", state.session.length_unit, np.linalg.norm(rows.points, axis=1))]
    return out + [
        (name, unit, values[rows.view])
        for name, unit, values in _offset_view_properties(state)
        if property_varies(name, values)
    ]


def _offset_view_properties(state: RunState) -> list[tuple[str, str, Array]]:
    """Name, unit and value of every property, per view."""
    views = state.measurement.views
    moves = np.degrees(views.joints - views.previous)
    of_view = [(f"last move of j{i + 1}", "deg", moves[:, i]) for i in range(moves.shape[1])]
    return [*of_view, *view_properties(views), ("order", "view", np.arange(views.count, dtype=float))]
