"""Where model and measurement part: the distance between views against everything that is known of them.

Every correspondence counts twice, with its distance as seen from either view: + e with the properties of
one point, − e with those of the other. A mean that differs from zero then says that one end of the property
sits off against the other end. Intervals count views: points of one view share its error.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.comparison.table import ResidualTable, table_of
from stitch.comparison.tables import (
    PLACE,
    ResidualTables,
    equal_count_bins,
    property_varies,
    values_of_views,
    view_properties,
)
from stitch.comparison.view_scatter import BinStatistics, view_statistics
from stitch.frames import Array, Indices
from stitch.model.forward import corrected_capture
from stitch.observations.surfaces.gram import RMS_GATE
from stitch.observations.surfaces.match import Match, sample_points
from stitch.observations.surfaces.overlaps import FINE_SAMPLES, collect_overlaps
from stitch.runs.state import RunState
from stitch.system.threads import library_threads_off

# Correspondences of a view in a bin that make a sample.
_ENOUGH = 30
_PLACES = 4  # cells along each axis of the part


def compare_surfaces(state: RunState) -> ResidualTables:
    """Tables of the residual by view, pair, joint, torque, approach, range, incidence, field, time, covariate, place.

    Raises:
        NoResultError: no two views overlap.
    """
    with library_threads_off():
        own = corrected_capture(state.measurement, state.model)
        poses = own.poses(state.model.T_mount)
        overlaps = collect_overlaps(own, poses, state.gate, [sample_points(s, FINE_SAMPLES) for s in own.scans])
    rows = _CorrespondenceRows(state, poses, overlaps.matches, overlaps.gram.scale)
    names = state.session.names
    tables = [_view_table(rows, names), _pair_table(rows, names)]
    tables += [
        _property_table(rows, name, unit, values) for name, unit, values in _correspondence_properties(state, rows)
    ]
    tables.append(_regions(rows))
    return ResidualTables(
        tables=tuple(t for t in tables if len(t.count) > (0 if t.label else 1)),
        rms=overlaps.gram.rms,
        scale=overlaps.gram.scale,
        views=tuple(names),
        of_views=values_of_views(state.measurement.views),
    )


class _CorrespondenceRows:
    """Both sides of every correspondence inside the robust gate."""

    def __init__(self, state: RunState, poses: Array, matches: Sequence[Match], scale: float) -> None:
        self.count = len(poses)
        parts: list[list[Array]] = [[], [], [], [], [], []]
        for m in matches:
            inside = np.abs(m.residual) < RMS_GATE * scale
            for sign, v, w, index in ((1.0, m.v, m.w, m.index_v), (-1.0, m.w, m.v, m.index_w)):
                size = int(inside.sum())
                points = state.measurement.capture.scans[v].points[index[inside]]
                cosine = state.measurement.scan_views[v].cosine[index[inside]]
                views = np.full(size, v), np.full(size, w)
                values = (*views, sign * m.residual[inside], points, cosine, m.middle[inside])
                for part, value in zip(parts, values, strict=True):
                    part.append(value)
        view, partner, self.residual, self.points, self.cosine, self.place = (np.concatenate(p) for p in parts)
        self.view, self.partner = view.astype(np.int64), partner.astype(np.int64)

    def sums(self, bins: Indices, size: int) -> tuple[Array, Array, Array]:
        """(size, V, V) counts, sums of e and of e² by bin, view and partner."""
        key = (bins * self.count + self.view) * self.count + self.partner
        shape, length = (size, self.count, self.count), size * self.count**2
        return tuple(  # type: ignore[return-value]
            np.bincount(key, w, length).reshape(shape) for w in (None, self.residual, self.residual**2)
        )


def _bin_statistics(rows: _CorrespondenceRows, bins: Indices, size: int) -> BinStatistics:
    n, s, q = (x.sum(axis=2) for x in rows.sums(bins, size))  # (B, V)
    return view_statistics(n, s, q, _ENOUGH)


def _labelled_table(rows: _CorrespondenceRows, name: str, bins: Indices, labels: Sequence[str]) -> ResidualTable:
    number = np.arange(len(labels), dtype=float)
    return table_of(name, "", (number, number), tuple(labels), _bin_statistics(rows, bins, len(labels)))


def _view_table(rows: _CorrespondenceRows, names: Sequence[str]) -> ResidualTable:
    """One sample each: how well its own mean is known nothing says."""
    table = _labelled_table(rows, "view", rows.view, names)
    nothing = np.full(len(names), np.nan)
    return replace(table, mean_sigma=nothing, rms_sigma=nothing, p_value=nothing)


def _pair_table(rows: _CorrespondenceRows, names: Sequence[str]) -> ResidualTable:
    n, s, q = (x[0] for x in rows.sums(np.zeros(len(rows.view), np.int64), 1))
    v, w = np.nonzero(np.triu(n, 1))
    count, mean, square = n[v, w], s[v, w], q[v, w]
    nothing, number = np.full(len(v), np.nan), np.arange(len(v), dtype=float)
    return ResidualTable(
        name="pair",
        unit="",
        low=number,
        high=number,
        label=tuple(f"{names[int(a)]}–{names[int(b)]}" for a, b in zip(v, w, strict=True)),
        mean=mean / count,
        mean_sigma=nothing,
        rms=np.sqrt(square / count),
        rms_sigma=nothing,
        count=count,
        views=np.full(len(v), 2),
        p_value=nothing,
    )


def _correspondence_properties(state: RunState, rows: _CorrespondenceRows) -> list[tuple[str, str, Array]]:
    """Name, unit and value of every property, per row."""
    views, unit = state.measurement.views, state.session.length_unit
    x, y, z = rows.points.T
    out = [
        ("range", unit, np.linalg.norm(rows.points, axis=1)),
        ("incidence", "deg", np.degrees(np.arccos(np.clip(rows.cosine, -1, 1)))),
        ("field a = x/z", "", x / z),
        ("field b = y/z", "", y / z),
        ("field ρ", "", np.hypot(x, y) / z),
    ]
    return out + [
        (name, u, values[rows.view]) for name, u, values in view_properties(views) if property_varies(name, values)
    ]


def _property_table(rows: _CorrespondenceRows, name: str, unit: str, values: Array) -> ResidualTable:
    edges, bins = equal_count_bins(values)
    return table_of(name, unit, (edges[:-1], edges[1:]), (), _bin_statistics(rows, bins, len(edges) - 1))


def _regions(rows: _CorrespondenceRows) -> ResidualTable:
    """Cells of the part along the axes of the reference frame."""
    low, high = np.quantile(rows.place, [0.005, 0.995], axis=0)
    cell = np.clip(((rows.place - low) / np.maximum(high - low, 1e-12) * _PLACES).astype(np.int64), 0, _PLACES - 1)
    bins = (cell[:, 0] * _PLACES + cell[:, 1]) * _PLACES + cell[:, 2]
    used, bins = np.unique(bins, return_inverse=True)
    centre = [low + (np.array(np.unravel_index(b, (_PLACES,) * 3)) + 0.5) / _PLACES * (high - low) for b in used]
    labels = [f"({c[0]:.4g}, {c[1]:.4g}, {c[2]:.4g})" for c in centre]
    return _labelled_table(rows, PLACE, bins.astype(np.int64), labels)
