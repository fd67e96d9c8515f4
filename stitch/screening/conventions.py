"""Find the convention of the poses that explains how the scanner moved: A·X = X·B under every hypothesis.

The motions B come from the scans alone (`register_scan_pairs`), A from the poses with one mistake undone. A hypothesis
is judged by the motions that close under its best hand-eye (`fit_motions`). Most hypotheses follow from the poses
(`hypotheses`); those of this file ask the motions too: poses between rows, tables of which one part was written in
another way than the rest (two programs made them, or two people), columns that are stuck or missing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import METRES
from stitch.screening.hypotheses import (
    MOST_EXCHANGED,
    UNITS,
    Hypothesis,
    distinct,
    hypotheses,
    known_unit_ratio,
    scale_text,
    sentence,
    stated_hypothesis,
)
from stitch.screening.motions import (
    FEWEST,
    ROTATION,
    TRANSLATION_M,
    MotionFit,
    RelativeScans,
    fit_motions,
    fit_positions,
    screen_hypotheses,
)
from stitch.session.session import SessionData

# A hypothesis closes if this share of the motions does; and it must leave clearly less open than another to be told
# from it: (1 − score) counts open motions.
_MIN_CLOSED_SHARE = 0.6
_CLEARER, _CLEAR_OPEN = 0.6, 0.02
# Short of that: this share under one reading, and under the stated one so little of it that chance does as much.
_MANY_CLOSED, _FEW_CLOSED, _AS_MANY = 0.4, 0.2, 0.75
# Poses whose motions nearly all close need no other convention.
_ALL = 0.95
# Mistakes that turn each pose by itself.
_OF_ONE_ROW = ("inverse", "quaternion", "euler", "degrees")
# Of the largest span of a column: less is one value.
_ONE_VALUE = 1e-6
# Of its length: how near the direction and the factor of a linear axis are to what they are taken for.
_AXIS_NEAR = 0.05
# Shares of a step by which poses may lag; angles that are off by so many times what closes say no more.
_LAGS, _LAG_OFF = np.linspace(0.02, 0.6, 30), 4.0


def rank_hypotheses(session: SessionData, motions: RelativeScans, rows: Indices | None = None) -> list[MotionFit]:
    """Return hypotheses about the poses of a session with their best hand-eyes, best first; [] with too few motions.

    The poses as stated are always among them. Others are only tried where those explain less than `_ALL` of the
    motions. A free scale of the robot's lengths is tried too, and dropped where a mistake explains clearly more.

    Args:
        motions: of the scanner between pairs of views, from the scans alone.
        rows: views of the session that the motions number; None: all.
    """
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[session.length_unit]
    every = np.arange(len(session.views)) if rows is None else rows
    stated = stated_hypothesis(session, every)
    as_stated = fit_motions(stated, motions, length)
    scaled = _in_another_unit(fit_motions(stated, motions, length, scaled=True))
    fits = [as_stated]
    if as_stated.closed < _ALL:
        tried = hypotheses(session, every, _accused_views(as_stated, motions, length))
        if not session.axes:
            tried += _with_stuck_columns_restored(as_stated, motions, length)
            tried += _on_linear_axis(session, every, as_stated, motions)
        tried += [*_between_rows(stated, motions, length), *lagging_poses(stated, motions)]
        tried += _by_table_part(tried, motions, [session.names[v] for v in every])
        fits += fit_hypotheses(tried, motions, session.length_unit)[1:]
    # A scale near zero removes the positions, and then explains as many motions as a reading that explains them.
    if scaled.hypothesis.kind != "scale" or scaled.closed * _AS_MANY > max(fit.closed for fit in fits):
        fits.append(scaled)
    return sorted(fits, key=lambda fit: (fit.open, fit.hypothesis.kind != "stated"))


def fit_hypotheses(
    tried: Sequence[Hypothesis], motions: RelativeScans, length_unit: str, *, scaled: bool = False
) -> list[MotionFit]:
    """Return the best hand-eye per hypothesis, in their order, without those that cannot explain the motions.

    The first is always kept; of hypotheses with the same relative motions, the first one. [] with too few motions.

    Args:
        scaled: fit a factor on the robot's lengths too.
    """
    if len(motions.pairs) < FEWEST:
        return []
    length = TRANSLATION_M / METRES[length_unit]
    kept = distinct(screen_hypotheses(tried, motions), 1e-3 * length)
    return [fit_motions(h, motions, length, scaled=scaled) for h in kept]


def equivalent_hypotheses(fits: Sequence[MotionFit]) -> list[MotionFit]:
    """Return the hypotheses that explain the motions about as well as the best, best first; [] if that explains few.

    `open` of a fit is the mean truncated square, 0 to 1, of what its motions leave. About as well: at most 1/`_CLEARER`
    of the best one's, plus `_CLEAR_OPEN` for rounding.
    """
    ranked = sorted(fits, key=lambda fit: fit.open)
    if not ranked or ranked[0].closed < _MIN_CLOSED_SHARE:
        return []
    return [fit for fit in ranked if fit.open <= ranked[0].open / _CLEARER + _CLEAR_OPEN]


def proven_hypotheses(ranked: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """Return the hypotheses that explain the motions where the poses as stated do not: proof of a mistake; else ().

    Proof: the best closes `_MIN_CLOSED_SHARE` of the motions and leaves less than `_CLEARER` of what the stated one
    leaves. Those that explain nearly as much follow it.

    Args:
        ranked: best first, as `rank_hypotheses` returns them.
    """
    if not ranked:
        return ()
    best = ranked[0]
    stated = next(fit for fit in ranked if fit.hypothesis.kind == "stated" and fit.scale == 1.0)
    if stated.open <= best.open / _CLEARER + _CLEAR_OPEN or best.closed < _MIN_CLOSED_SHARE:
        return ()
    close = [fit for fit in ranked if fit.open <= best.open / _CLEARER + 0.01 and fit.closed >= 0.9 * best.closed]
    return tuple(fit for fit in close if fit.hypothesis.kind != "stated" or fit.scale != 1.0)


def likeliest_hypotheses(ranked: Sequence[MotionFit]) -> tuple[MotionFit, ...]:
    """Return the hypotheses that close many motions where the stated poses close hardly any, best first; else ().

    It is weaker than `proven_hypotheses`, since a part that slides on itself closes half of the motions under any
    hypothesis. So it is asked only for sessions whose poses are known to contradict the scans.

    Args:
        ranked: as `rank_hypotheses` returns them.
    """
    if not ranked:
        return ()
    stated = max(fit.closed for fit in ranked if fit.hypothesis.kind == "stated" and fit.scale == 1.0)
    most = max(fit.closed for fit in ranked)
    if most < _MANY_CLOSED or stated > _FEW_CLOSED * most:
        return ()
    return tuple(sorted((fit for fit in ranked if fit.closed >= _AS_MANY * most), key=lambda fit: -fit.closed))


def _in_another_unit(fit: MotionFit) -> MotionFit:
    """Return a fit of the stated poses with free scale as a hypothesis: another unit, or a factor that is none.

    A scale that is not positive explains nothing.
    """
    if fit.scale <= 0:
        return replace(fit, open=1.0, closed=0.0)
    factor = known_unit_ratio(fit.scale)
    T = fit.hypothesis.T_base_flange
    if factor is not None:
        return replace(fit, hypothesis=fit.hypothesis.undone("clouds", T, factor=factor, units=UNITS[factor]))
    return replace(fit, hypothesis=replace(fit.hypothesis, kind="scale", fix=scale_text(fit.scale)))


def _accused_views(stated: MotionFit, motions: RelativeScans, length: float) -> list[int]:
    """Return the `MOST_EXCHANGED` views, sorted, with the largest share of motions that stay open as stated.

    A motion is open if rotation or translation differ by more than `ROTATION` (rad) or `length` (length_unit).
    """
    T = stated.hypothesis.T_reference_mount
    v, w = np.array(motions.pairs).T
    off = frames.inverse(stated.T_mount) @ frames.inverse(T[v]) @ T[w] @ stated.T_mount @ frames.inverse(motions.T)
    wrong = (frames.angle_between(np.eye(4), off) > ROTATION) | (np.linalg.norm(off[:, :3, 3], axis=1) > length)
    open_share = np.array(
        [wrong[(v == i) | (w == i)].mean() if np.any((v == i) | (w == i)) else 1 for i in range(len(T))]
    )
    return sorted(np.argsort(-open_share, kind="stable")[:MOST_EXCHANGED].tolist())


def _with_stuck_columns_restored(stated: MotionFit, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """Yield the poses with a column of positions that has one value in all rows replaced by what the motions ask for.

    Only if most of these values differ from their median by more than `length`.

    Args:
        stated: fit of the poses as stated.
        length: what a motion may leave open, length_unit.
    """
    h = stated.hypothesis
    T = h.T_base_flange
    position = T[:, :3, 3]
    count = len(T)
    span = np.ptp(position, axis=0)
    for axis in np.flatnonzero(span <= _ONE_VALUE * span.max()):
        Q = np.zeros((count, 3, count))
        Q[np.arange(count), axis, np.arange(count)] = 1.0
        moved = fit_positions(T[:, :3, :3], (position, Q), h.mount, motions, range(count), stated.T_mount[:3, :3])
        column = moved[:, axis]
        if np.median(np.abs(column - np.median(column))) > length:
            value = position[0, axis]
            yield h.undone("stuck column", frames.make(T[:, :3, :3], moved), axis="xyz"[axis], value=value)


def _on_linear_axis(
    session: SessionData, rows: Indices, stated: MotionFit, motions: RelativeScans
) -> Iterator[Hypothesis]:
    """Yield the poses moved by a covariate of views.csv along one direction, as if it were a rail or lift of the robot.

    The direction is the one that explains the motions best. Its length must be a ratio of length units (1, 1000 or
    0.001); near an axis of the base it is that axis.

    Args:
        rows: views of the session that the motions number.
        stated: fit of the poses as stated.
    """
    h = stated.hypothesis
    T = h.T_base_flange
    R, position = T[:, :3, :3], T[:, :3, 3]
    for name in session.views[0].covariates:
        column = np.array([session.views[v].covariates.get(name, np.nan) for v in rows])
        if not np.isfinite(column).all() or np.ptp(column) == 0:
            continue
        Q = column[:, None, None] * np.eye(3)
        moved = fit_positions(R, (position, Q), h.mount, motions, range(len(T)), stated.T_mount[:3, :3])
        farthest = int(np.argmax(np.abs(column)))
        direction = (moved - position)[farthest] / column[farthest]
        length = float(np.linalg.norm(direction))
        unit = min((1.0, 1000.0, 0.001), key=lambda factor: abs(np.log(max(length, 1e-12) / factor)))
        if abs(length / unit - 1) > _AXIS_NEAR:
            continue
        axis = int(np.argmax(np.abs(direction)))
        along_axis = np.eye(3)[axis] * np.sign(direction[axis]) * unit
        if np.linalg.norm(direction - along_axis) < _AXIS_NEAR * unit:
            direction = along_axis
            times = "" if unit == 1 else f" {unit:g} *"
            where = f"write {'xyz'[axis]} {'+' if direction[axis] > 0 else '-'}{times} {name} in place of {'xyz'[axis]}"
        else:
            direction = direction * unit / length
            where = f"add {name} times ({', '.join(f'{x:.4g}' for x in direction)}) to x, y, z"
        poses = frames.make(R, position + column[:, None] * direction)
        yield h.undone("linear axis", poses, column=name, where=where)


def _between_rows(stated: Hypothesis, motions: RelativeScans, length: float) -> Iterator[Hypothesis]:
    """Yield the poses at the scans, if each pose stated lies midway between those of its scan and of a neighbour's.

    Let B_v be the scanner's motion from row v to the next, by the scans, and h_v half of the one to the neighbour, as
    a twist. Between the places that the stated poses mean, the scanner moves by exp(−h_v) · B_v · exp(h_w), with
    w = v + 1. The hand-eye X that explains the stated poses by these motions makes the pose at scan v the stated one
    times X · exp(−h_v) · X⁻¹, if poses were interpolated as screws. If along lines, rotations are the same, and
    positions are found from the motions.

    Args:
        length: what a motion may leave open, length_unit.
    """
    to_next = {v: frames.log(motions.T[i]) for i, (v, w) in enumerate(motions.pairs) if w == v + 1}
    count = len(stated.T_base_flange)
    for ahead, where, neighbour in ((1, "after", "next"), (-1, "before", "previous")):
        half = {v: 0.5 * ahead * to_next[min(v, v + ahead)] for v in range(count) if min(v, v + ahead) in to_next}
        pairs = tuple((v, v + 1) for v in half if v + 1 in half and v in to_next)
        if len(pairs) < FEWEST:
            continue
        of_stated = [frames.exp(-half[v]) @ frames.exp(to_next[v]) @ frames.exp(half[w]) for v, w in pairs]
        X = fit_motions(stated, RelativeScans(pairs, np.array(of_stated)), length).T_mount
        used = tuple(sorted(half))
        T = np.array(stated.T_reference_mount)
        for v in used:
            T[v] = T[v] @ X @ frames.exp(-half[v]) @ frames.inverse(X)
        by_screws = T if stated.mount == "eye_in_hand" else frames.inverse(T)
        R = by_screws[:, :3, :3]
        middles = _positions_of_middles(stated.T_base_flange[:, :3, 3], ahead)
        along_lines = fit_positions(R, middles, stated.mount, motions, used, X[:3, :3])
        for poses in (by_screws, frames.make(R, along_lines)):
            yield replace(stated.undone("between rows", poses, where=where, neighbour=neighbour), used=used)


def lagging_poses(stated: Hypothesis, motions: RelativeScans) -> Iterator[Hypothesis]:
    """Yield the poses at the scans, if each pose stated lags by the same share of the way from the pose before.

    The share is the one under which the flange turns by the same angles as the scanner, by two grids. Interpolation
    along screws and along lines are both undone.
    """
    T = stated.T_base_flange
    v, w = np.array(motions.pairs).T
    angles = frames.angle_between(np.eye(4), motions.T)
    shares = _LAGS
    # A coarse grid of shares, then a fine one about its best.
    for width in (0.0, _LAGS[1] - _LAGS[0]):
        shares = np.clip(shares + np.linspace(-width, width, len(_LAGS)), 0, _LAGS[-1])
        ahead = _without_lag(T, shares, along_lines=False)
        turned = frames.angle_between(ahead[:, v], ahead[:, w])
        off = np.abs(turned - angles).clip(max=_LAG_OFF * ROTATION).mean(axis=1)
        shares = np.full(len(_LAGS), shares[np.argmin(off)])
    if shares[0] > _LAGS[0]:
        for along_lines in (False, True):
            poses = _without_lag(T, shares[:1], along_lines)[0]
            yield stated.undone("lagging", poses, share=float(shares[0]))


def _without_lag(T: Array, shares: Array, along_lines: bool) -> Array:
    """Return the poses (S, V, 4, 4) from which those stated lag by S shares of each step from the pose before.

    Args:
        T: (V, 4, 4) T_base_flange as stated.
        shares: (S,) from 0 (no lag) to 1.
        along_lines: positions were interpolated along lines; else with the rotation, along screws.
    """
    out = [np.tile(T[0], (len(shares), 1, 1))]
    for pose in T[1:]:
        last = out[-1]
        ahead = last @ frames.exp(frames.log(frames.inverse(last) @ pose) / (1 - shares)[:, None])
        if along_lines:
            ahead[:, :3, 3] = last[:, :3, 3] + (pose[:3, 3] - last[:, :3, 3]) / (1 - shares)[:, None]
        out.append(ahead)
    return np.stack(out, axis=1)


def _positions_of_middles(middle: Array, ahead: int) -> tuple[Array, Array]:
    """Return p (V, 3) and Q (V, 3, 3) such that the positions p + Q·u have the given middles, for any u (3,).

    Args:
        middle: (V, 3) positions as stated, each midway between its own and a neighbour's.
        ahead: 1: the neighbour is the next row; −1: the previous one.
    """
    p = np.zeros((len(middle), 3))
    Q = np.tile(np.eye(3), (len(middle), 1, 1))
    for v in range(1, len(middle)):
        p[v] = 2 * middle[v - 1 if ahead > 0 else v] - p[v - 1]
        Q[v] = -Q[v - 1]
    return p, Q


def _by_table_part(tried: Sequence[Hypothesis], motions: RelativeScans, names: Sequence[str]) -> Iterator[Hypothesis]:
    """Yield the stated poses with a mistake of rotations undone only in a part of the table: its beginning or its end.

    For each mistake, the parts under which most motions turn by the scanner's angle, if these are more than under all
    rows or none. Under any hand-eye mount and scanner turn by the same angle (Chen 1991), so that this needs none.

    Args:
        tried: hypotheses, the first of which is the poses as stated.
        names: of the views.
    """
    count = len(names)
    v, w = np.array(motions.pairs).T
    # Masks (V,) of the rows up to each place in the table, and from there on, with motions inside and outside of them.
    parts = [part for k in range(1, count) for part in (np.arange(count) < k, np.arange(count) >= k)]
    parts = [part for part in parts if min((part[v] & part[w]).sum(), (~part[v] & ~part[w]).sum()) >= FEWEST]
    stated = tried[0]
    scanner_angles = frames.angle_between(np.eye(4), motions.T)
    for h in tried[1:]:
        if h.kind not in _OF_ONE_ROW or not parts:
            continue
        R = np.array([stated.T_reference_mount[:, :3, :3], h.T_reference_mount[:, :3, :3]])
        if np.abs(R[1] - R[0]).max() < ROTATION:
            continue
        # agrees[a, b, m]: motion m turns as far as the scanner, its first row read as stated (a = 0) or with the
        # mistake undone (1), its second row likewise (b).
        cosine = (np.einsum("amij,bmij->abm", R[:, v], R[:, w]) - 1) / 2
        agrees = np.abs(np.arccos(np.clip(cosine, -1, 1)) - scanner_angles) < ROTATION
        shares = [agrees[part[v].astype(int), part[w].astype(int), np.arange(len(v))].mean() for part in parts]
        if max(shares) <= max(agrees[0, 0].mean(), agrees[1, 1].mean()):
            continue
        # Several parts may agree with as many angles: which one is right only the hand-eye shows, later.
        for part in (part for part, share in zip(parts, shares, strict=True) if share == max(shares)):
            rows = tuple(np.flatnonzero(part).tolist())
            T = np.where(part[:, None, None], h.T_base_flange, stated.T_base_flange)
            fix = sentence("part of the table", first=names[rows[0]], last=names[rows[-1]], fix=h.fix)
            yield replace(h, T_base_flange=T, fix=fix, rows=rows)
