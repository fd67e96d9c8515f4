"""The residual of a run against everything that is known of it: tables in bins, their means judged by the views.

Between surfaces every correspondence counts twice, with its distance as seen from either view: + e with the properties
of one point, − e with those of the other. A mean that differs from zero then says that one end of the property sits off
against the other end. Of labelled points a mean is that of the offset along the direction in which the bins of a
property differ most, and its p-value knows that the direction was chosen; rms is that of the 3D distance.

Views are the samples: all points of a view share its pose error.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from stitch.diagnosis.dependence import Dependence, dependences
from stitch.fit.pipelines import linearise
from stitch.model.forward import corrected_capture
from stitch.numerics.distributions import f_tail
from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import BlockLeastSquares
from stitch.numerics.units import covariate_unit
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import RMS_GATE, collect_overlaps
from stitch.observations.targets.rows import drawing_of, initial_landmarks, target_rows
from stitch.output.schema import Document, Key
from stitch.run_data import RunData
from stitch.session.measurement import Views
from stitch.system.threads import library_threads_off
from stitch.system.values import Table, Value

PLACE = "place on the part"
APPROACH = "approach of j"
CLEAR = 0.05  # p over all means
_BINS = 6
_PLACES = 4  # cells along each axis of the part
_ENOUGH = 30  # correspondences of a view in a bin that make a sample
_FAIR = 50  # correspondences of a bin that may be called the worst
_DIRECTIONS = 3  # among so many dimensions a direction is chosen for every table of offsets
_SAME_VALUE = 1e-9  # numbers closer than that are one
# Of the size of the largest mean: sums of the same rows in another order differ by rounding.
_ROUNDING = 1e-6

_FOLLOWED = Document(
    *map(Key, ("covariate", "unit", "place", "shape", "p_value", "p_beside", "direction", "mean", "sigma")),
    Key("at", attribute="bins"),
)

# Name, unit and value of everything that is known, of the views (V,) or of the rows (N,).
Properties = list[tuple[str, str, Array]]


@dataclass(frozen=True, eq=False)
class BinStatistics(Value):
    """Of B bins; lengths in length_unit, counts of rows and of views that make a sample."""

    mean: Array  # (B,) signed
    mean_sigma: Array  # (B,) standard error of the mean where nothing is to be found; NaN where it is unknown
    rms: Array  # (B,)
    rms_sigma: Array
    count: Array
    views: Array
    p_value: Array  # (B,) that chance makes this one mean so large; NaN where that is unknown


@dataclass(frozen=True, eq=False)
class ResidualTable(BinStatistics):
    """One property in bins; lengths in length_unit, counts of correspondences and of views.

    Example:
        >>> table = stitch.compare(run).table("view")
        >>> table.label[0], table.rms.shape
        ('v000', (5,))
    """

    name: str
    unit: str
    low: Array  # (B,) edges, or the number of the view or cell
    high: Array  # (B,)
    label: tuple[str, ...] = ()  # (B,) names of views, pairs or cells

    @property
    def clearest(self) -> float:
        """Largest |mean| over its standard error; 0 where nothing is known."""
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.abs(self.mean) / self.mean_sigma
        return float(np.nanmax(np.where(np.isfinite(z), z, 0.0), initial=0.0))

    @property
    def least_p(self) -> float:
        """The smallest p-value of its means; 1 where nothing is known."""
        return float(np.nanmin(self.p_value, initial=1.0))

    def worst(self, at_most: int) -> list[int]:
        """Return the numbers of the bins of largest rms, of those with a fair count.

        Example:
            >>> len(stitch.compare(run).table("view").worst(2))
            2
        """
        fair = self.count > np.minimum(_FAIR, np.median(self.count) / 4)
        return [int(i) for i in np.argsort(-np.nan_to_num(self.rms), kind="stable") if fair[i]][:at_most]


@dataclass(frozen=True, eq=False)
class ResidualTables(Table, document="stitch.output.comparison.residual_tables:comparison_document"):
    """All tables, and the rms they share, length_unit.

    Example:
        >>> tables = stitch.compare(run)
        >>> [table.name for table in tables.labelled]
        ['view', 'pair', 'place on the part']
    """

    tables: tuple[ResidualTable, ...]
    rms: float
    views: tuple[str, ...] = ()  # names, V
    of_views: dict[str, Array] = field(default_factory=dict)  # property -> (V,) value of each view
    followed: tuple[Dependence, ...] = ()  # what the displacements of whole views follow, clearest first

    def table(self, name: str) -> ResidualTable:
        """Return one table by its name.

        Example:
            >>> stitch.compare(run).table("range").unit
            'mm'
        """
        return next(t for t in self.tables if t.name == name)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row a bin of every table.

        Example:
            >>> stitch.compare(run).rows()[0]["table"]
            'view'
        """
        columns = ("low", "high", "mean", "mean_sigma", "rms", "rms_sigma", "p_value", "count", "views")
        return [
            {"table": t.name, "unit": t.unit, "label": t.label[i] if t.label else None}
            | {name: getattr(t, name)[i].item() for name in columns}
            for t in self.tables
            for i in range(len(t.rms))
        ]

    @property
    def labelled(self) -> tuple[ResidualTable, ...]:
        """Tables by name: views, pairs, places, targets."""
        return tuple(t for t in self.tables if t.label)

    @cached_property
    def groups(self) -> tuple[tuple[ResidualTable, ...], ...]:
        """Tables of properties, clearest dependence first; those whose bins hold the same rows together."""
        groups = _group_same_bins([t for t in self.tables if not t.label])
        return tuple(sorted(groups, key=lambda g: (g[0].least_p, -g[0].clearest)))

    @property
    def places(self) -> tuple[ResidualTable, ...]:
        """The first table of every group, clearest dependence first."""
        return tuple(group[0] for group in self.groups)

    @cached_property
    def means(self) -> int:
        """Number of different means of bins that are tested, for Bonferroni's correction.

        Bins with the same rows count once, recognised by equal |sums|. A bin and its complement count once too: all
        rows together sum to zero, so that their sums differ in sign only.
        """
        sums = [np.abs(t.mean * t.count)[np.isfinite(t.p_value)] for t in self.places]
        ordered = np.sort(np.concatenate(sums)) if sums else np.zeros(0)
        if not len(ordered):
            return 0
        return 1 + int((np.diff(ordered) > _SAME_VALUE * ordered[-1]).sum())

    def p_of_all(self, table: ResidualTable) -> float:
        """Return the p-value of a table's clearest mean, times the number of all means (Bonferroni).

        Example:
            >>> tables = stitch.compare(run)
            >>> tables.p_of_all(tables.places[0]) >= tables.places[0].least_p
            True
        """
        return min(1.0, max(self.means, 1) * table.least_p)

    def is_clear(self, table: ResidualTable) -> bool:
        """Return True where chance does not explain its clearest mean (5 % over all means).

        Example:
            >>> tables = stitch.compare(run)
            >>> [table.name for table in tables.places if tables.is_clear(table)]
            []
        """
        return self.p_of_all(table) <= CLEAR


def compare_surfaces(state: RunData) -> ResidualTables:
    """Return the residual by view, pair, joint, torque, approach, range, incidence, field, time, covariate and place.

    Raises:
        NoResultError: no two views overlap.
    """
    with library_threads_off():
        capture = corrected_capture(state.measurement, state.model)
        poses = capture.poses(state.model.T_mount)
        overlaps = collect_overlaps(capture, poses, state.gate)
    rows = _CorrespondenceRows(state, poses, overlaps.matches, overlaps.gram.scale)
    names = state.session.names
    known = view_properties(state.measurement.views)
    tables = [
        _view_table(rows, names),
        _pair_table(rows, names),
        *_binned_tables([*rows.properties, *_of_rows(known, rows.view)], rows.statistics),
        _place_table(rows),
    ]
    return _comparison(state, tables, overlaps.gram.rms, known)


def compare_targets(state: RunData) -> ResidualTables:
    """Return the offsets by view, target, joint, move, torque, approach, range, time and covariate."""
    rows = _OffsetRows(state)
    names = state.session.names
    views = state.measurement.views
    moves = np.degrees(views.joints - views.previous)
    known = [
        *((f"last move of j{i + 1}", "deg", moves[:, i]) for i in range(moves.shape[1])),
        *view_properties(views),
        ("order", "view", np.arange(views.count, dtype=float)),
    ]
    distance = ("range", state.session.length_unit, np.linalg.norm(rows.points, axis=1))
    tables = [
        _labelled_table("view", names, rows.statistics(rows.view, len(names))),
        _labelled_table("target", rows.targets, rows.statistics(rows.target, len(rows.targets))),
        *_binned_tables([distance, *_of_rows(known, rows.view)], rows.statistics),
    ]
    rms = float(np.sqrt(np.mean(np.sum(rows.offset**2, axis=1))))
    return _comparison(state, tables, rms, known)


def _comparison(state: RunData, tables: Sequence[ResidualTable], rms: float, known: Properties) -> ResidualTables:
    """Return the result of a comparison: tables that are not empty, and on what the views' displacements depend.

    Args:
        rms: of all residuals, length_unit.
        known: properties of the views.
    """
    with library_threads_off():
        followed = dependences(linearise(state.session, state.measurement, state.model, state.gate))
    return ResidualTables(
        tables=tuple(table for table in tables if len(table.count)),
        rms=rms,
        views=tuple(state.session.names),
        of_views={name: values for name, _, values in known},
        followed=followed,
    )


def view_properties(views: Views) -> Properties:
    """Return name, unit and value (V,) of everything that is known of the views."""
    joints = range(views.joints.shape[1])
    known = [(f"j{i + 1}", "deg", np.degrees(views.joints[:, i])) for i in joints]
    known += [(f"{APPROACH}{i + 1}", "", views.approach[:, i]) for i in range(views.approach.shape[1])]
    known += [(f"torque {n}", "N m", views.torques.values[:, i]) for i, n in enumerate(views.torques.names)]
    if views.has("time"):
        known.append(("time", "s", views.time))
    return known + [(name, covariate_unit(name), values) for name, values in views.covariates.items()]


def _of_rows(known: Properties, view: Indices) -> Properties:
    """Return properties of the views that vary, for rows of these views (N,)."""
    return [(name, unit, values[view]) for name, unit, values in known if property_varies(name, values)]


def property_varies(name: str, values: Array) -> bool:
    """Return True if a property (V,) has two different values.

    A direction of approach is 0 in the first view, which nothing precedes: that is no value.

    Args:
        name: of the property.
    """
    known = values[values != 0] if name.startswith(APPROACH) else values
    return bool(len(known) and np.ptp(known) > _SAME_VALUE)


def _binned_tables(
    properties: Properties, statistics: Callable[[Indices, int], BinStatistics]
) -> Iterable[ResidualTable]:
    """Yield a table for each property of rows (N,) that takes more than one bin.

    Args:
        properties: name, unit and values (N,).
        statistics: function from bins (N,) and their number to the statistics of each bin.
    """
    for name, unit, values in properties:
        edges, bins = equal_count_bins(values)
        if len(edges) > 2:
            yield binned_table(name, unit, edges, statistics(bins, len(edges) - 1))


def equal_count_bins(values: Array) -> tuple[Array, Indices]:
    """Return (B + 1,) edges of bins with about equal counts, and the bin of every value (N,).

    Equal values stay together; of no more values than bins, each has its own.
    """
    different = np.unique(values)
    if len(different) == 1:
        edges = np.array([different[0] - 0.5, different[0] + 0.5])
    elif len(different) <= _BINS:
        edges = np.concatenate([different[:1], (different[1:] + different[:-1]) / 2, different[-1:]])
    else:
        edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return edges, bins.astype(np.int64)


def binned_table(name: str, unit: str, edges: Array, statistics: BinStatistics) -> ResidualTable:
    """Return the table of bins between edges (B + 1,) and their statistics."""
    return ResidualTable(**vars(statistics), name=name, unit=unit, low=edges[:-1], high=edges[1:])


def _labelled_table(name: str, labels: Sequence[str], statistics: BinStatistics) -> ResidualTable:
    """Return the table of rows with names and their statistics."""
    number = np.arange(len(labels), dtype=float)
    return ResidualTable(**vars(statistics), name=name, unit="", low=number, high=number, label=tuple(labels))


class _CorrespondenceRows:
    """Rows of residuals: two for every correspondence inside the robust gate, one as seen from either view.

    N rows have `view` and `partner` (N,), `residual` (N,) length_unit, positive where the view lies outside its
    partner, `place` (N, 3) in the reference frame, and `properties` of the view's point in the scanner frame.
    """

    def __init__(self, state: RunData, poses: Array, matches: Sequence[Match], scale: float) -> None:
        """Make two rows of each correspondence: of v with partner w, and of w with partner v and the other sign.

        Args:
            state: the run.
            poses: (V, 4, 4) T_reference_scanner.
            matches: correspondences at these poses.
            scale: robust sigma of their distances, length_unit.
        """
        self.count = len(poses)
        parts = list[tuple[Array, ...]]()
        for m in matches:
            inside = np.abs(m.residual) < RMS_GATE * scale
            for sign, v, w, index in ((1.0, m.v, m.w, m.index_v), (-1.0, m.w, m.v, m.index_w)):
                size = int(inside.sum())
                points = state.measurement.capture.scans[v].points[index[inside]]
                cosine = state.measurement.scan_views[v].cosine[index[inside]]
                views = np.full(size, v), np.full(size, w)
                parts.append((*views, sign * m.residual[inside], points, cosine, m.middle[inside]))
        view, partner, self.residual, points, cosine, self.place = map(np.concatenate, zip(*parts, strict=True))
        self.view, self.partner = view.astype(np.int64), partner.astype(np.int64)
        x, y, z = points.T
        self.properties = [
            ("range", state.session.length_unit, np.linalg.norm(points, axis=1)),
            ("incidence", "deg", np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            ("field a = x/z", "", x / z),
            ("field b = y/z", "", y / z),
            ("field ρ", "", np.hypot(x, y) / z),
        ]

    def sums(self, bins: Indices, size: int) -> tuple[Array, Array, Array]:
        """Return (size, V) counts, sums of e and of e² by bin and view."""
        return _sums_by_view(bins, size, self.view, self.count, self.residual, self.residual**2)

    def statistics(self, bins: Indices, size: int) -> BinStatistics:
        """Return what the views say of the means of so many bins."""
        return view_statistics(*self.sums(bins, size), _ENOUGH)


class _OffsetRows:
    """Rows of labelled points: offset (N, 3) of each sighting from the target's fitted position, reference frame.

    `view` and `target` (N,) say whose it is, `points` (N, 3) where it was seen, sensor frame; length_unit.
    """

    def __init__(self, state: RunData) -> None:
        """Fit the positions of the targets under the model of a run by weighted least squares; keep the residuals."""
        capture = corrected_capture(state.measurement, state.model)
        sightings = capture.sightings
        assert sightings is not None
        T_mount = state.model.T_mount
        landmarks = initial_landmarks(capture, T_mount, drawing_of(state.session.nominal, sightings))
        rows = target_rows(capture, T_mount, landmarks)
        covariance = (rows.noise + rows.fixed)[:, :, None] * np.eye(rows.residual.shape[1])
        no_prior = np.zeros(rows.landmarks.shape[2])
        placed = BlockLeastSquares(-rows.residual, rows.landmarks, covariance, no_prior, no_prior).solve()
        residual = rows.residual + rows.landmarks @ placed
        used = sightings.used
        self.count = len(used)
        self.targets = list(sightings.targets)
        self.view, slot = np.nonzero(used)
        self.target = sightings.target[self.view, slot]
        self.offset = residual[: len(used), : rows.positions].reshape(*used.shape, 3)[self.view, slot]  # reference
        self.points = sightings.points[self.view, slot]  # sensor frame

    def statistics(self, bins: Indices, size: int) -> BinStatistics:
        """Return the statistics of bins: means of offsets along the direction in which the bins differ most.

        That is the first principal direction of the bins' means. rms is that of the 3D offsets.

        Args:
            bins: (N,) bin of each row.
            size: number of bins.
        """
        count = np.bincount(bins, minlength=size)
        sums = np.stack([np.bincount(bins, self.offset[:, i], size) for i in range(3)], axis=1)
        mean = sums / np.maximum(count, 1)[:, None]
        direction = np.linalg.svd(mean - mean.mean(axis=0), full_matrices=False)[2][0] if size > 1 else np.eye(3)[0]
        squares = np.sum(self.offset**2, axis=1)
        n, s, q = _sums_by_view(bins, size, self.view, self.count, self.offset @ direction, squares)
        return view_statistics(n, s, q, directions=_DIRECTIONS)


def _sums_by_view(
    bins: Indices, size: int, view: Indices, views: int, e: Array, squares: Array
) -> tuple[Array, Array, Array]:
    """Return (size, V) counts, and sums of e (N,) and of squares (N,), by bin and view of N rows."""
    key = bins * views + view
    n, s, q = (np.bincount(key, w, size * views).reshape(size, views).astype(float) for w in (None, e, squares))
    return n, s, q


def _view_table(rows: _CorrespondenceRows, names: Sequence[str]) -> ResidualTable:
    """Return the table of views by name; sigmas and p-values are NaN, since each bin is a single sample, its view."""
    table = _labelled_table("view", names, rows.statistics(rows.view, len(names)))
    unknown = np.full(len(names), np.nan)
    return replace(table, mean_sigma=unknown, rms_sigma=unknown, p_value=unknown)


def _pair_table(rows: _CorrespondenceRows, names: Sequence[str]) -> ResidualTable:
    """Return the table of pairs of views that have correspondences: mean and rms of the distance, length_unit.

    Sigmas and p-values are NaN, since a pair is a single sample. Both halves of `rows.sums` by partner and view hold
    the same correspondences; where the view comes first they count v less w.
    """
    counts, sums, squares = (by_partner.T for by_partner in rows.sums(rows.partner, len(names)))
    v, w = np.nonzero(np.triu(counts, 1))
    count = counts[v, w]
    unknown = np.full(len(v), np.nan)
    statistics = BinStatistics(
        mean=sums[v, w] / count,
        mean_sigma=unknown,
        rms=np.sqrt(squares[v, w] / count),
        rms_sigma=unknown,
        count=count,
        views=np.full(len(v), 2),
        p_value=unknown,
    )
    return _labelled_table("pair", [f"{names[int(a)]}–{names[int(b)]}" for a, b in zip(v, w, strict=True)], statistics)


def _place_table(rows: _CorrespondenceRows) -> ResidualTable:
    """Return the table of cells of the part, a grid along the axes of the reference frame; labels are their centres.

    The grid spans all but the outermost 1 % of the points, which fall into the cells at the rim.
    """
    low, high = np.quantile(rows.place, [0.005, 0.995], axis=0)
    cell = np.clip(((rows.place - low) / np.maximum(high - low, 1e-12) * _PLACES).astype(np.int64), 0, _PLACES - 1)
    number = (cell[:, 0] * _PLACES + cell[:, 1]) * _PLACES + cell[:, 2]
    used, bins = np.unique(number, return_inverse=True)
    centre = [low + (np.array(np.unravel_index(b, (_PLACES,) * 3)) + 0.5) / _PLACES * (high - low) for b in used]
    labels = [f"({c[0]:.4g}, {c[1]:.4g}, {c[2]:.4g})" for c in centre]
    return _labelled_table(PLACE, labels, rows.statistics(bins.astype(np.int64), len(labels)))


def view_statistics(n: Array, s: Array, q: Array, enough: float = 1.0, directions: int = 1) -> BinStatistics:
    """Return means of bins with what the scatter between views says of them.

    A view off by its pose error ε is off in all its rows, so a mean over views with shares w of the rows has the
    variance σ² Σ w². All rows together have the mean zero: what a bin is off the others are off the other way, which
    leaves the factor 1 − (share of the bin). Where all rows of a view lie in one bin and views have equal counts,
    mean over sigma is Student's t of the views in the bin against the other views.

    Args:
        n, s, q: (B, V) counts, sums and sums of squares of rows by bin and view.
        enough: rows of a view in a bin that make a sample.
        directions: dimensions among which the direction of the mean was chosen for being the clearest. The
            p-value is that of the clearest (Scheffé 1953, Biometrika 40, 87).
    """
    use = n >= enough
    total = n.sum(axis=1)
    of_view = np.maximum(n.sum(axis=0), 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        dilution = ((n / total[:, None]) ** 2).sum(axis=1)
        mean = s.sum(axis=1) / total
        rms = np.sqrt(q.sum(axis=1) / total)
        variance, freedom = _view_scatter(s / n, s.sum(axis=0) / of_view, use)
        rms_variance, _ = _view_scatter(np.sqrt(q / n), np.sqrt(q.sum(axis=0) / of_view), use)
        sigma = np.sqrt(variance * dilution * (1 - total / total.sum()))
        z = np.abs(mean) / sigma
    p_values = [_mean_p_value(float(x), float(v), directions) for x, v in zip(z, freedom, strict=True)]
    return BinStatistics(
        mean=mean,
        mean_sigma=sigma,
        rms=rms,
        rms_sigma=np.sqrt(rms_variance * dilution),
        count=total,
        views=use.sum(axis=1),
        p_value=np.array(p_values),
    )


def _view_scatter(values: Array, whole: Array, use: Mask) -> tuple[Array, Array]:
    """Return the variance between views (B,) and its degrees of freedom (B,), pooled over two groups of views.

    The groups are the views in the bin, by their mean there, and those outside, by their mean over all rows. Each is
    taken about its own mean: a bin of one or two views alone would not know the variance. It is NaN without degrees of
    freedom, or without a view in the bin.

    Args:
        values: (B, V) means of the views in the bins.
        whole: (V,) means over all rows of the views.
        use: (B, V) where a view has enough rows in a bin.
    """
    others = use.any(axis=0) & ~use
    square = np.zeros(len(use))
    freedom = np.zeros(len(use))
    for chosen, sample in ((use, values), (others, np.broadcast_to(whole, use.shape))):
        count = chosen.sum(axis=1)
        middle = np.where(chosen, sample, 0.0).sum(axis=1) / np.maximum(count, 1)
        square += np.where(chosen, (sample - middle[:, None]) ** 2, 0.0).sum(axis=1)
        freedom += np.maximum(count - 1, 0)
    known = (freedom > 0) & use.any(axis=1)
    return np.where(known, square / np.maximum(freedom, 1), np.nan), freedom


def _mean_p_value(z: float, freedom: float, directions: int) -> float:
    """Return the p-value of a mean z sigmas from zero along the clearest of several directions; NaN for z of NaN.

    By Scheffé, z² (ν − d + 1) / (d ν) is F distributed with d and ν − d + 1 degrees of freedom: Student's t for d = 1.

    Args:
        z: |mean| over its standard error.
        freedom: degrees of freedom ν of that error.
        directions: number d of dimensions.
    """
    left = freedom - directions + 1
    if not np.isfinite(z):
        return float("nan")
    return f_tail(z**2 * left / (directions * freedom), directions, left) if left > 0 else 1.0


def _group_same_bins(tables: Sequence[ResidualTable]) -> list[tuple[ResidualTable, ...]]:
    """Return tables in groups whose bins hold the same rows, in whichever order; groups and tables as they come.

    Such properties say one thing under several names.
    """
    groups: list[list[ResidualTable]] = []
    for table in tables:
        group = next((group for group in groups if _same_rows(group[0], table)), None)
        if group is None:
            groups.append([table])
        else:
            group.append(table)
    return [tuple(group) for group in groups]


def _same_rows(a: ResidualTable, b: ResidualTable) -> bool:
    """Return whether two tables have the same bins in another order: counts, means and rms agree but for rounding."""
    if len(a.count) != len(b.count):
        return False
    first, second = (np.lexsort((np.nan_to_num(t.rms), np.nan_to_num(t.mean), t.count)) for t in (a, b))
    if not np.array_equal(a.count[first], b.count[second]):
        return False
    small = _ROUNDING * float(np.nanmax(a.rms, initial=0.0))
    pairs = ((a.mean, b.mean), (a.rms, b.rms))
    return all(np.allclose(x[first], y[second], rtol=0, atol=small, equal_nan=True) for x, y in pairs)


def comparison_document(comparison: ResidualTables) -> dict[str, object]:
    """Return compare.json: the tables as plain lists."""
    return {
        "rms": comparison.rms,
        "follows": _FOLLOWED.rows().write(comparison.followed),
        "means": comparison.means,
        "tables": [_table_row(comparison, table) for table in comparison.tables],
        "views": [
            {"view": name, "values": {key: float(values[v]) for key, values in comparison.of_views.items()}}
            for v, name in enumerate(comparison.views)
        ],
    }


def _table_row(comparison: ResidualTables, table: ResidualTable) -> dict[str, object]:
    """Return a table as a row of compare.json.

    A table of a property also has the p-value of its clearest mean and the names of tables with the same bins.
    """
    row = {"name": table.name, "unit": table.unit, "label": list(table.label), "clearest": table.clearest}
    if not table.label:
        group = next(group for group in comparison.groups if any(x is table for x in group))
        row |= {"p_of_all": comparison.p_of_all(table), "same_bins": [x.name for x in group if x is not table]}
    for key in ("low", "high", "mean", "mean_sigma", "rms", "rms_sigma", "p_value"):
        row[key] = getattr(table, key).tolist()
    return row | {"count": table.count.astype(int).tolist(), "views": table.views.astype(int).tolist()}
