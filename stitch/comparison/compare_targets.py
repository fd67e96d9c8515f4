"""Where model and labelled points part: offsets of the targets against everything that is known of the views.

A mean is that of the offset along the direction in which the bins of a property differ most; rms is that of the
3D distance. Intervals count views: targets of one view share its error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.comparison.tables import Comparison, Table, binned, view_properties
from stitch.frames import Array, Indices
from stitch.model.forward import corrected
from stitch.observations.targets.landmarks import drawing_of, initial_landmarks
from stitch.observations.targets.rows import rows_of
from stitch.runs.state import State
from stitch.statistics.block_least_squares import Blocks


@dataclass(frozen=True)
class _Offsets:
    """N targets in views: where the view puts them less where they are."""

    view: Indices  # (N,)
    target: Indices  # (N,)
    offset: Array  # (N, 3) reference frame
    points: Array  # (N, 3) sensor frame
    views: int


def compare_targets(state: State) -> Comparison:
    """Tables of the offsets by view, target, joint, move, torque, approach, range, time and covariate."""
    rows = _offsets(state)
    s = state.measurement.capture.sightings
    assert s is not None
    labels = {"view": (rows.view, state.session.names), "target": (rows.target, list(s.targets))}
    tables = [_table(rows, name, "", bins, _numbers(names), names) for name, (bins, names) in labels.items()]
    for name, unit, values in _properties(state, rows):
        edges, bins = binned(values)
        tables.append(_table(rows, name, unit, bins, (edges[:-1], edges[1:]), ()))
    rms = float(np.sqrt(np.mean(np.sum(rows.offset**2, axis=1))))
    of_views = {name: values for name, _, values in _of_views(state)}
    return Comparison(tuple(tables), rms, rms, tuple(state.session.names), of_views)


def _offsets(state: State) -> _Offsets:
    """With the targets where hand-eye and effects of the model put them best."""
    own = corrected(state.measurement, state.model)
    s = own.sightings
    assert s is not None
    T_mount = state.model.T_mount
    rows = rows_of(own, T_mount, initial_landmarks(own, T_mount, drawing_of(state.session.nominal, s)))
    diagonal = np.zeros((*rows.residual.shape, rows.residual.shape[1]))
    diagonal[:, np.arange(rows.residual.shape[1]), np.arange(rows.residual.shape[1])] = rows.noise + rows.fixed
    k = rows.landmarks.shape[2]
    left = (
        rows.residual
        + rows.landmarks @ Blocks(-rows.residual, rows.landmarks, diagonal, np.zeros(k), np.zeros(k)).solve()
    )
    v, slot = np.nonzero(s.used)
    offset = left[: len(s.used), : rows.positions].reshape(*s.used.shape, 3)[v, slot]
    return _Offsets(v, s.target[v, slot], offset, s.points[v, slot], len(s.used))


def _numbers(names: Sequence[str]) -> tuple[Array, Array]:
    number = np.arange(len(names), dtype=float)
    return number, number


def _table(
    rows: _Offsets, name: str, unit: str, bins: Indices, edges: tuple[Array, Array], labels: Sequence[str]
) -> Table:
    size = len(edges[0])
    count = np.asarray(np.bincount(bins, minlength=size), float)
    share = np.maximum(count, 1)
    mean = np.stack([np.bincount(bins, rows.offset[:, i], size) for i in range(3)], axis=1) / share[:, None]
    square = np.bincount(bins, np.sum(rows.offset**2, axis=1), size) / share
    direction = np.linalg.svd(mean - mean.mean(axis=0), full_matrices=False)[2][0] if size > 1 else np.eye(3)[0]
    along = rows.offset @ direction
    views = np.array([len(np.unique(rows.view[bins == b])) for b in range(size)], float)
    signed = np.bincount(bins, along, size) / share
    # The sample is a view: the mean of its targets in the bin, spread about the bin's mean.
    key = bins * rows.views + rows.view
    n = np.bincount(key, minlength=size * rows.views).reshape(size, rows.views)
    of_view = np.bincount(key, along, size * rows.views).reshape(n.shape) / np.maximum(n, 1)
    lengths = np.linalg.norm(rows.offset, axis=1)
    distance = np.bincount(key, lengths, size * rows.views).reshape(n.shape) / np.maximum(n, 1)
    sigmas = [
        np.sqrt(np.where(n > 0, (x - m[:, None]) ** 2, 0).sum(axis=1) / np.maximum(views - 1, 1) / np.maximum(views, 1))
        for x, m in ((of_view, signed), (distance, np.sqrt(square)))
    ]
    unknown = np.where(views > 1, 1.0, np.nan)
    low, high = edges
    return Table(
        name=name,
        unit=unit,
        low=low,
        high=high,
        label=tuple(labels),
        mean=signed,
        mean_sigma=sigmas[0] * unknown,
        rms=np.sqrt(square),
        rms_sigma=sigmas[1] * unknown,
        count=count,
        views=views,
    )


def _properties(state: State, rows: _Offsets) -> list[tuple[str, str, Array]]:
    """Name, unit and value of every property, per row."""
    out = [("range", state.session.length_unit, np.linalg.norm(rows.points, axis=1))]
    return out + [(name, unit, values[rows.view]) for name, unit, values in _of_views(state) if np.ptp(values) > 1e-9]


def _of_views(state: State) -> list[tuple[str, str, Array]]:
    """Name, unit and value of every property, per view."""
    views = state.measurement.views
    moves = np.degrees(views.joints - views.previous)
    of_view = [(f"last move of j{i + 1}", "deg", moves[:, i]) for i in range(moves.shape[1])]
    return [*of_view, *view_properties(views), ("order", "view", np.arange(views.count, dtype=float))]
