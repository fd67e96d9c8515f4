"""Where external axes stand, from nothing: relative motions of the scans against readings and poses.

Neighbouring views are registered by features; a third of these motions may be wrong. Turns first: directions of rotary
axes and the turn of the hand-eye that explain most motions, from many random ones, each then improved. Given these, the
rest is linear: places of rotary axes, directions of linear ones, the shift of the hand-eye. Last all together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stitch.errors import InputError, NoResultError
from stitch.fit.coarse import neighbouring_views, register_pairs
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session.axes import Axes, Axis, AxisMotion
from stitch.session.axis_poses import axes_of, place_axes, reported_poses
from stitch.session.capture import Capture, build_capture, part_size, with_scanners
from stitch.session.measurement import Measurement, measurement_of
from stitch.session.session import SessionData

# Random sets of rotations that are tried, those that are improved, and those that differ and are kept.
_DRAWS, _IMPROVED, _MOST_ANSWERS = 20_000, 24, 4
# Angle, rad, at which a motion's error is capped: a larger one is a wrong registration.
_OFF = 0.3
# A motion is explained within so many rad and so much of the part's size.
_ANGLE, _SHARE = 0.03, 0.03
# Fewer explained motions place no axis: they say three times as many numbers as there are unknowns.
_FEWEST = 5
# Sets of rotations whose angles are computed at once: bounds the memory.
_BLOCK = 500
# Partners of a view by their orientation; weighted solutions for places.
_ALIKE, _REWEIGHTED = 3, 20


def locate_axes(
    sessions: Sequence[SessionData], measurements: Sequence[Measurement]
) -> tuple[list[SessionData], list[Measurement]]:
    """Return sessions and measurements in which every external axis has a place: unstated ones found from the scans.

    The axes are found in the first session and used in all. Where all are stated, nothing is changed.

    Raises:
        InputError: there are no clouds, or sessions differ in what they state.
        NoResultError: the scans do not say where.
    """
    axes = axes_of(sessions[0])
    unplaced = [axis.name for axis in axes.axes if not axis.is_placed]
    if not unplaced:
        return list(sessions), list(measurements)
    unknown = " and ".join(unplaced)
    fix = f"to fix: state direction (and point) of {unknown} in [[axis]], to some millimetres and milliradians"
    if not sessions[0].has_clouds:
        raise InputError(f"{sessions[0].path}: labelled points do not say where axis {unknown} stands; {fix}")
    found = _find(sessions[0], measurements[0].capture)
    if found is None:
        raise NoResultError(f"the scans do not say where axis {unknown} stands; {fix}")
    placed = [place_axes(session, found) for session in sessions]
    return placed, [_placed(session, m) for session, m in zip(placed, measurements, strict=True)]


def _placed(session: SessionData, measurement: Measurement) -> Measurement:
    """Return the measurement with its scans on the poses of the session, whose axes are placed now."""
    capture = measurement.capture
    T = np.array([view.T_base_flange for view in session.views])
    placed = build_capture(capture.name, capture.scans, T, session.mount, capture.sightings)
    return measurement_of(session, with_scanners(session, placed))


@dataclass(frozen=True)
class _Motions:
    """What the search begins with: readings, reported poses, and motions of the scanner between pairs of views."""

    axes: Axes  # K axes with their readings
    reported: Array  # (V, 4, 4) T_base_flange
    to_hand: bool  # the part is in the hand, the scanner stands in the cell
    pairs: Array  # (P, 2) views
    scanner: Array  # (P, 4, 4) registered motions, from the second view's scanner frame into the first's
    size: float  # of the part, length_unit

    def turned(self, directions: Array) -> Array:
        """Return rotations (N, V, 3, 3) of T_reference_mount for N guesses at the directions (N, K, 3) of K axes."""
        vectors = directions[:, None] * self.axes.readings[..., None]
        R = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
        # A linear axis does not turn.
        turns = [R[:, :, k] if axis.is_rotary else np.eye(3) for k, axis in enumerate(self.axes.axes)]
        return self._carried(turns, self.reported[:, :3, :3], lambda rotation: np.swapaxes(rotation, -1, -2))

    def _carried(self, moved: Sequence[Array], reported: Array, inverse: Callable[[Array], Array]) -> Array:
        """Return the pose of the mount, A_left⁻¹ · A_right · T_base_flange, or its inverse for a part in hand.

        Args:
            moved: per axis A (…, d, d), by which it moves what it carries: a factor of A_left or A_right
                (`Axes.stands_right`).
            reported: (V, d, d) T_base_flange, or its rotation.
            inverse: of such matrices.
        """
        left = right = np.eye(reported.shape[-1])
        for axis, A in zip(self.axes.axes, moved, strict=True):
            if self.axes.stands_right(axis):
                right = right @ A
            else:
                left = left @ A
        T = inverse(left) @ right @ reported
        return inverse(T) if self.to_hand else T

    def angles(self, directions: Array, R_mount: Array) -> Array:
        """Return angles (N, P), rad, between P motions of the scanner as registered and as N guesses predict them.

        Args:
            directions: (N, K, 3) of the axes.
            R_mount: (N, 3, 3) rotation of the hand-eye.
        """
        pose = self.turned(directions) @ R_mount[:, None]
        first, second = pose[:, self.pairs[:, 0]], pose[:, self.pairs[:, 1]]
        trace = np.einsum("npji,npjk,pik->np", first, second, self.scanner[:, :3, :3])
        return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))

    def places(self, directions: Array, R_mount: Array, use: Array) -> tuple[tuple[Axis, ...], Array] | None:
        """Return axes and hand-eye (4, 4) for given rotations: what is unknown of positions is linear least squares.

        The unknowns are vectors (1 + K, 3): the translation of the hand-eye, then of each axis its place as in
        `_mount_poses`, that of stated axes being known. Weights make wrong motions count little, in `_REWEIGHTED`
        solutions.

        Args:
            directions: (K, 3) of the rotary axes.
            R_mount: (3, 3) rotation of the hand-eye.
            use: (P,) bool, motions that count.

        Returns:
            None where a linear axis has no direction.
        """

        def residuals(x: Array) -> Array:
            """Return residuals (3P,) of the translations between views, first view's scanner frame, at x (1 + K, 3)."""
            pose = self._mount_poses(directions, x[1:]) @ frames.make(R_mount, x[0])
            first, second = pose[self.pairs[use, 0]], pose[self.pairs[use, 1]]
            translation = np.einsum("pji,pj->pi", first[:, :3, :3], second[:, :3, 3] - first[:, :3, 3])
            return np.asarray((translation - self.scanner[use, :3, 3]).ravel())

        x = np.zeros((1 + len(self.axes.axes), 3))
        for k, axis in enumerate(self.axes.axes, start=1):
            stated = axis.point if axis.is_rotary else axis.direction
            if axis.is_placed and stated is not None:
                x[k] = stated
        free = [0, *(k for k, axis in enumerate(self.axes.axes, start=1) if not axis.is_placed)]
        # They are linear in x: differences are the columns.
        at_stated = residuals(x)
        units = np.eye(x.size).reshape(*x.shape, *x.shape)[free].reshape(-1, *x.shape)
        columns = np.column_stack([residuals(x + unit) - at_stated for unit in units])
        weight = np.ones(len(at_stated))
        for _ in range(_REWEIGHTED):
            step = np.linalg.lstsq(columns * weight[:, None], -at_stated * weight, rcond=1e-4)[0]
            distances = np.linalg.norm((at_stated + columns @ step).reshape(-1, 3), axis=1)
            weight = np.repeat(1 / np.sqrt(1 + (distances / (_SHARE * self.size)) ** 2) ** 2, 3)
        x[free] += step.reshape(-1, 3)
        axes = []
        for axis, direction, place in zip(self.axes.axes, directions, x[1:], strict=True):
            if axis.is_placed:
                axes.append(axis)
            elif axis.is_rotary:
                axes.append(replace(axis, direction=direction, point=place))
            elif place.any():
                axes.append(replace(axis, direction=place / np.linalg.norm(place)))
            else:
                return None
        return tuple(axes), frames.make(R_mount, x[0])

    def _mount_poses(self, directions: Array, places: Array) -> Array:
        """Return T_reference_mount (V, 4, 4) for K axes with these places.

        Args:
            directions: (K, 3) of the rotary axes.
            places: (K, 3) a point of a rotary axis, the travel per unit of the reading of a linear one.
        """
        moved = []
        for axis, direction, place, readings in zip(
            self.axes.axes, directions, places, self.axes.readings.T, strict=True
        ):
            T = np.tile(np.eye(4), (len(readings), 1, 1))
            T[:, :3, 3] = place * readings[:, None]
            if axis.is_rotary:
                R = Rotation.from_rotvec(direction * readings[:, None]).as_matrix()
                T = frames.make(R, place - R @ place)
            moved.append(T)
        return self._carried(moved, self.reported, frames.inverse)

    def residual(self, axes: Axes, placement: Array, T_mount: Array) -> Array:
        """Return twists (P, 6), length_unit, between the scanner's motions as registered and as the axes predict them.

        Rotations are multiplied by the size of the part.

        Args:
            placement: (K, 6) twists by which the axes are displaced from their present places.
            T_mount: (4, 4) hand-eye.
        """
        motion = AxisMotion(axes.readings, placement, np.zeros((len(axes.axes), 3)), axes.as_read().error)
        T = axes.carried(motion) @ self.reported
        pose = (frames.inverse(T) if self.to_hand else T) @ T_mount
        predicted = frames.inverse(pose[self.pairs[:, 0]]) @ pose[self.pairs[:, 1]]
        return frames.log(frames.inverse(self.scanner) @ predicted) * np.repeat([self.size, 1.0], 3)


def _find(session: SessionData, capture: Capture) -> tuple[Axis, ...] | None:
    """Return the axes with places found from motions of the scans; None where fewer than `_FEWEST` motions agree.

    For each likely set of rotations: positions by linear least squares, then all together. The result under which most
    motions agree is taken.
    """
    axes = axes_of(session)
    reported = reported_poses(session)
    pairs = _pairs(axes, reported)
    motions = _Motions(
        axes,
        reported,
        session.mount == "eye_to_hand",
        np.array(pairs),
        register_pairs(capture, pairs),
        part_size([capture]),
    )
    best: tuple[Axis, ...] | None = None
    # Motions that agree, and their summed distances, negative: more and nearer is better.
    best_score = (_FEWEST, -np.inf)
    for directions, R_mount in _likely_rotations(motions, session.scanner.T_mount):
        use = motions.angles(directions[None], R_mount[None])[0] < 3 * _ANGLE
        placed = motions.places(directions, R_mount, use) if use.sum() >= _FEWEST else None
        if placed is None:
            continue
        refined, T_mount = _refined(motions, replace(axes, axes=placed[0]), placed[1])
        distances = np.linalg.norm(motions.residual(refined, np.zeros((len(axes.axes), 6)), T_mount), axis=1)
        agrees = distances < _SHARE * motions.size
        score = (int(agrees.sum()), -float(distances[agrees].sum()))
        if score > best_score:
            best, best_score = refined.axes, score
    return best


def _pairs(axes: Axes, reported: Array) -> list[tuple[int, int]]:
    """Return pairs of views (v < w) that may overlap: neighbours in time, in an axis's reading, and in orientation.

    Neighbours in orientation are the `_ALIKE` views whose flange is turned least from that of a view.

    Args:
        reported: (V, 4, 4) T_base_flange.
    """
    count = len(axes.readings)
    pairs = set(neighbouring_views(count))
    for column in axes.readings.T:
        order = np.argsort(column)
        pairs |= {(min(a, b), max(a, b)) for a, b in zip(order[:-1].tolist(), order[1:].tolist(), strict=True)}
    if not axes.has_robot:
        return sorted(pairs)
    trace = np.einsum("vij,wij->vw", reported[:, :3, :3], reported[:, :3, :3])
    near = np.argsort(-trace, axis=1, kind="stable")[:, 1 : 1 + _ALIKE]
    pairs |= {(min(a, int(b)), max(a, int(b))) for a, row in enumerate(near) for b in row if a != b}
    return sorted(pairs)


def _likely_rotations(motions: _Motions, T_mount: Array | None) -> list[tuple[Array, Array]]:
    """Return up to four distinct pairs of axis directions (K, 3) and hand-eye rotation (3, 3), likeliest first.

    Random guesses are scored by capped angles between motions as registered and as predicted; the best `_IMPROVED`
    are refined and scored again, more strictly.

    Args:
        T_mount: (4, 4) hand-eye whose rotation is then fixed; None: it is searched too.
    """
    rng = np.random.default_rng(0)
    stated = [axis.direction for axis in motions.axes.axes]
    wanted = [k for k, axis in enumerate(motions.axes.axes) if axis.is_rotary and stated[k] is None]
    draws = _DRAWS if T_mount is None or len(wanted) > 1 else _DRAWS // 10
    directions = rng.standard_normal((draws, len(stated), 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    for k, direction in enumerate(stated):
        if direction is not None:
            directions[:, k] = direction
    R_mount = np.asarray(Rotation.random(draws, rng=rng).as_matrix())
    if T_mount is not None:
        R_mount = np.broadcast_to(T_mount[:3, :3], (draws, 3, 3))
    blocks = range(0, draws, _BLOCK)
    capped = [np.minimum(motions.angles(directions[i : i + _BLOCK], R_mount[i : i + _BLOCK]), _OFF) for i in blocks]
    order = np.argsort((np.concatenate(capped) ** 2).sum(axis=1))[:_IMPROVED]
    trials = [_improved_rotations(motions, directions[i], R_mount[i], wanted) for i in order]
    costs = [float((np.minimum(motions.angles(d[None], R[None]), _ANGLE) ** 2).sum()) for d, R in trials]
    distinct: list[tuple[Array, Array]] = []
    for i in np.argsort(costs, kind="stable"):
        d, R = trials[i]
        if all(frames.angle_between(R, R2) > _ANGLE or np.abs(d - d2).max() > _ANGLE for d2, R2 in distinct):
            distinct.append((d, R))
    return distinct[:_MOST_ANSWERS]


def _improved_rotations(motions: _Motions, directions: Array, R_mount: Array, wanted: list[int]) -> tuple[Array, Array]:
    """Return directions (K, 3) and R_mount (3, 3) after robust least squares of the angles between motions.

    Args:
        directions: (K, 3) to begin with.
        R_mount: (3, 3) to begin with.
        wanted: numbers of the axes whose directions are sought; the others are fixed.
    """

    def moved(x: Array) -> tuple[Array, Array]:
        """Return both after a step x: a rotation vector of the hand-eye, then one of each wanted axis."""
        turned = directions.copy()
        for i, k in enumerate(wanted):
            turned[k] = Rotation.from_rotvec(x[3 + 3 * i : 6 + 3 * i]).as_matrix() @ directions[k]
        return turned, R_mount @ Rotation.from_rotvec(x[:3]).as_matrix()

    def residual(x: Array) -> Array:
        """Return the angles (P,) rad between motions as registered and as predicted after a step x."""
        d, R = moved(x)
        return motions.angles(d[None], R[None])[0]

    fit = least_squares(residual, np.zeros(3 + 3 * len(wanted)), loss="cauchy", f_scale=_ANGLE, max_nfev=40)
    return moved(fit.x)


def _refined(motions: _Motions, axes: Axes, T_mount: Array) -> tuple[Axes, Array]:
    """Return axes and hand-eye (4, 4) after robust least squares of the hand-eye's twist and the unstated axes' places.

    The placement of an axis is a twist in its own frame. A rotary one is free to tilt and shift across its direction,
    numbers 0, 1, 3 and 4; a linear one to tilt, 0 and 1.
    """
    free = [
        (k, i)
        for k, axis in enumerate(axes.axes)
        if not motions.axes.axes[k].is_placed
        for i in ((0, 1, 3, 4) if axis.is_rotary else (0, 1))
    ]
    unit = np.array([1.0] * 3 + [motions.size] * 3 + [1.0 if i < 3 else motions.size for _, i in free])

    def moved(x: Array) -> tuple[Array, Array]:
        """Return placements (K, 6) and hand-eye (4, 4) after a step x, length_unit; rotations are over the size."""
        x = x * unit
        placement = np.zeros((len(axes.axes), 6))
        for value, at in zip(x[6:], free, strict=True):
            placement[at] = value
        return placement, T_mount @ frames.exp(x[:6])

    fit = least_squares(
        lambda x: motions.residual(axes, *moved(x)).ravel(),
        np.zeros(len(unit)),
        loss="cauchy",
        f_scale=_SHARE / 3 * motions.size,
        max_nfev=60,
    )
    placement, T_refined = moved(fit.x)
    motion = replace(axes.as_read(), placement=placement)
    return replace(axes, axes=axes.placed(motion)), T_refined
