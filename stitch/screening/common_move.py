"""Find the view from which on everything that the sensor shows stands elsewhere: a tracker that was knocked over, a
table or a robot's base that was moved.

Two hypotheses are fitted to labelled points: one hand-eye with one set of targets for all views, and the same with one
rigid motion of the base (6 numbers) from some view on. What both leave is held against the scatter that the session
itself shows, so that a bad arm is not taken for one that moved: −2 log likelihood falls by n·d·log of the ratio of the
squares, of the views' means and of what is left about them. The six numbers and the choice of the view have their price
(BIC). Neighbouring views with like errors count as fewer.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import less_group_means
from stitch.observations.targets.closed_form_hand_eye import closed_form_hand_eye
from stitch.session.capture import Capture, Sightings

# Views that a side has at least, and targets of a view that are asked.
_SIDE_VIEWS, _TARGETS = 3, 8
# −2 log of the odds beyond the price of the numbers from which a move is believed: a thousand to one.
_BELIEVED = 2 * np.log(1000.0)
# A move of fewer times what the arm errs is a doubt only.
_SURE_TIMES = 3.0
# Gauss–Newton rounds at the most on the way to the move that fits best.
_STEPS = 12
# Lag-1 correlation of neighbouring views at the most: beyond it hardly any view would count as independent.
_MOST_CORRELATED = 0.95


def find_common_move(capture: Capture) -> "CommonMove | None":
    """Return the view from which on all labelled points stand elsewhere, and by which motion; None if none is proven.

    Two models are fitted: one hand-eye for all views, and the same with a rigid motion of the base from some view on.
    The second has to lower −2 log likelihood by more than its price (BIC), which counts the choice of the view too.
    """
    s = capture.sightings
    assert s is not None
    capture = replace(capture, sightings=_thinned(s))
    count = len(s.points)
    if count < 2 * _SIDE_VIEWS + 2:
        return None
    fits = [CommonMove(capture, T_mount) for T_mount in _starts(capture)]
    if not fits:
        return None
    # A move that begins after the last view is none.
    unmoved = min((fit.solved([count]) for fit in fits), key=lambda fit: fit.total)
    starts = list(range(_SIDE_VIEWS, count - _SIDE_VIEWS + 1))
    moved = max((fit.solved(starts) for fit in [*fits, unmoved]), key=unmoved.deviance_drop_to)
    price = 6 * np.log(count) + 2 * np.log(len(starts)) + _BELIEVED
    return moved if unmoved.deviance_drop_to(moved) > price else None


def _thinned(s: Sightings) -> Sightings:
    """Return sightings with at most `_TARGETS` targets in each view, those that most views show."""
    rank = np.argsort(np.argsort(-s.view_counts, kind="stable"))[s.target]
    place_in_view = np.argsort(np.argsort(np.where(s.used, rank, len(s.targets)), axis=1), axis=1)
    return replace(s, used=s.used & (place_in_view < _TARGETS))


def _starts(capture: Capture) -> Iterator[Array]:
    """Yield hand-eyes (4, 4) in closed form from all views, from the first third and from the last third.

    If the base moved, one of these thirds lies on one side of it. One that shows no hand-eye is left out.
    """
    count = len(capture.T_reference_mount)
    third = max(count // 3, _SIDE_VIEWS)
    for left_out in (np.arange(0), np.arange(third, count), np.arange(count - third)):
        try:
            yield closed_form_hand_eye(capture.without(left_out))
        except (NoResultError, np.linalg.LinAlgError):
            continue


def _placed(capture: Capture, T_mount: Array, T: Array, s: Sightings) -> tuple[Array, Array]:
    """Return labelled points (V, S, 3) in the base's and in the reference frame, with the base moved by T (…, 4, 4).

    With the sensor in hand both are the same; with a fixed sensor, the reference frame is the flange's.
    """
    if capture.scanner_rides:
        in_base = frames.transform(T @ capture.poses(T_mount), s.points)
        return in_base, in_base
    in_base = frames.transform(np.broadcast_to(T @ T_mount, capture.T_reference_mount.shape), s.points)
    return in_base, frames.transform(capture.T_reference_mount, in_base)


class CommonMove:
    """Hand-eye, targets, and a move of the base from a view on, by least squares."""

    def __init__(self, capture: Capture, T_mount: Array, T: Array | None = None, start: int | None = None) -> None:
        """Place all labelled points, those from view `start` on with the base moved by T (4, 4).

        `rest` (N, 3), length_unit, is what each point is off the mean of its target, reference frame.

        Args:
            T: motion of the base, in its own frame; None: it does not move.
            start: number of the first view after the motion; None: no view is.
        """
        self.capture, self.T_mount = capture, T_mount
        self.T = np.eye(4) if T is None else T
        self.start = len(capture.T_reference_mount) if start is None else start
        s = capture.sightings
        assert s is not None
        self.sightings = s
        self.view, self.slot = np.nonzero(s.used)
        self.target = s.target[self.view, self.slot]
        base = np.where((np.arange(len(s.points)) >= self.start)[:, None, None], self.T, np.eye(4))
        self.in_base, self.placed = (x[self.view, self.slot] for x in _placed(capture, T_mount, base, s))
        self.rest = less_group_means(self.placed, self.target)

    @property
    def total(self) -> float:
        """Sum of squares."""
        return float(np.sum(self.rest**2))

    @property
    def moved(self) -> float:
        """How far the points after the motion moved by it, rms, length_unit."""
        after = self.in_base[self.view >= self.start]
        displacement = after - frames.transform(frames.inverse(self.T), after)
        return float(np.sqrt(np.sum(displacement**2) / len(displacement)))

    @property
    def is_sure(self) -> bool:
        """True where the motion is more than `_SURE_TIMES` what the arm errs."""
        return self.moved > _SURE_TIMES * np.sqrt(self.total / len(self.rest))

    def shows(self, capture: Capture) -> Mask:
        """Return a mask of the views of another capture whose points fit the targets better with the base moved."""
        s = capture.sightings
        assert s is not None
        middles = np.full((len(s.targets), 3), np.nan)
        for k in np.unique(self.target):
            middles[k] = self.placed[self.target == k].mean(axis=0)
        distances = []
        for T in (np.eye(4), self.T):
            of_points = np.linalg.norm(_placed(capture, self.T_mount, T, s)[1] - middles[s.target], axis=2)
            distances.append(np.where(s.used, np.nan_to_num(of_points), 0.0).sum(axis=1))
        unmoved, moved = distances
        return moved < unmoved

    def solved(self, starts: list[int]) -> "CommonMove":
        """Return the move with the least sum of squares among those that begin at one of `starts`, views.

        Hand-eye and motion begin at those of this move. Each round takes one Gauss–Newton step for every view and keeps
        the best. It ends when neither the view nor the sum of squares changes, at the latest after `_STEPS` rounds.
        """
        best = self
        for _ in range(_STEPS):
            tried = [CommonMove(self.capture, best.T_mount, best.T, start)._stepped() for start in starts]
            nearer = min(tried, key=lambda fit: fit.total)
            if nearer.start == best.start and nearer.total > (1 - 1e-6) * best.total:
                break
            # From the second step on, only the best view and its neighbours are tried.
            best, starts = nearer, [k for k in starts if abs(k - nearer.start) <= 2]
        return best

    def _stepped(self) -> "CommonMove":
        """Return the move after one Gauss–Newton step of 12 unknowns: twist of the hand-eye, then twist of the base.

        Rotations are about the centroid of the points, sensor and base frame, so that they are well conditioned.
        """
        p = self.sightings.points[self.view, self.slot]
        centroid = p.mean(axis=0)
        base_centroid = self.in_base.mean(axis=0)
        size = float(np.linalg.norm(p - centroid, axis=1).mean()) or 1.0
        # Rotations that carry a displacement: of the mount to the base, of the base to the reference frame.
        moved = (self.view >= self.start)[:, None, None]
        to_base = np.where(moved, self.T[:3, :3], np.eye(3))
        to_reference = np.broadcast_to(np.eye(3), to_base.shape)
        R_reference_mount = self.capture.T_reference_mount[self.view, :3, :3]
        if self.capture.scanner_rides:
            to_base = to_base @ R_reference_mount
        else:
            to_reference = R_reference_mount
        of_mount = to_reference @ to_base @ self.T_mount[:3, :3]
        rows = [of_mount @ -frames.skew((p - centroid) / size), of_mount]
        rows += [moved * (to_reference @ -frames.skew((self.in_base - base_centroid) / size)), moved * to_reference]
        columns = less_group_means(np.concatenate(rows, axis=2), self.target).reshape(-1, 12)
        x = np.linalg.lstsq(columns, -self.rest.ravel(), rcond=1e-8)[0]
        # Rotations were counted in displacements at a distance of `size`.
        unit = np.repeat([1 / size, 1.0], 3)
        about, about_base = frames.make(np.eye(3), centroid), frames.make(np.eye(3), base_centroid)
        T_mount = self.T_mount @ about @ frames.exp(unit * x[:6]) @ frames.inverse(about)
        T = about_base @ frames.exp(unit * x[6:]) @ frames.inverse(about_base) @ self.T
        return CommonMove(self.capture, T_mount, T, self.start)

    def _view_means(self) -> Array:
        """Return the mean residual (V, 3) of each view, reference frame; zero for a view without points."""
        count = np.bincount(self.view, minlength=len(self.sightings.points))
        means = np.zeros((len(count), 3))
        np.add.at(means, self.view, self.rest)
        means /= np.maximum(count, 1)[:, None]
        return means

    def _squares(self, means: Array) -> tuple[Array, Array]:
        """Return the squares (3, 3) of the views' means (V, 3), and of residuals about them over their view's count."""
        count = np.bincount(self.view, minlength=len(means))
        within = self.rest - means[self.view]
        return means.T @ means, (within / count[self.view, None]).T @ within

    def deviance_drop_to(self, other: "CommonMove") -> float:
        """Return by how much −2 log likelihood falls from this fit to another one, whose residuals say how views err.

        It is n·d·log of the ratio of squares, for the means of the views and for residuals about them. n counts
        independent views, d the directions in which errors scatter: an error of one joint has one.
        """
        means = other._view_means()
        drop = 0.0
        for before, after in zip(self._squares(self._view_means()), other._squares(means), strict=True):
            # Participation ratio of the eigenvalues, (Σ λ)² / Σ λ².
            directions = np.trace(after) ** 2 / max(float(np.sum(after**2)), 1e-300)
            if np.trace(after) > 0:
                drop += directions * float(np.log(np.trace(before) / np.trace(after)))
        return _independent_views(means) * drop


def _independent_views(means: Array) -> float:
    """Return how many independent views tell as much as V neighbouring ones whose mean residuals (V, 3) are alike.

    It is (V − 3)(1 − ρ)/(1 + ρ) with the lag-1 correlation ρ, the sample size of a first-order autoregressive process.
    The mean over the views takes three numbers.
    """
    correlation = float(np.sum(means[1:] * means[:-1])) / max(float(np.sum(means**2)), 1e-300)
    correlation = float(np.clip(correlation, 0.0, _MOST_CORRELATED))
    return (len(means) - 3) * (1 - correlation) / (1 + correlation)
