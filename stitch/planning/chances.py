"""Chances, before measuring: that an effect would be detected, named, or taken for another.

What planned views would see is drawn: an effect of a given size, beside everything that poses err by otherwise. Every
candidate effect is then judged as a diagnosis judges it (`diagnosis/selection`), at the expected variances: family-wise
p, Bayes factor, and odds over every rival in the model in which neither of the two is among the errors that remain, and
over each joint that follows the joint angles by no law.
What a diagnosis asks of views left out is not drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import SEEN, form_weights
from stitch.diagnosis.thresholds import ALPHA_NAME, LOG_BAYES_FACTOR, ODDS, PRIOR_PHYSICAL, PRIOR_UNKNOWN
from stitch.diagnosis.unknown.joint_laws import TIMES, WIDTH
from stitch.frames import Array, Mask
from stitch.observations.linear_model import LinearModel
from stitch.statistics.tails import f_limit

DRAWS = 100
# Combinations that views see less than this share of a sigma, at plausible size, count in no p-value.
_TOLD = 1e-2


@dataclass(frozen=True)
class Chance:
    """Probabilities of what a diagnosis would say of one effect."""

    effect: str
    detected: float  # that something is said to be missing
    named: float  # that it is named, alone
    misnamed: float  # that another is named, alone
    taken_for: str | None  # the one that is named most often in its place


@dataclass(frozen=True)
class _Judge:
    """One form of a candidate beside a model: turns what is seen into its log Bayes factor and its squares."""

    weight: float  # share of the candidate's prior
    against: Array  # (p, n) Wᵀ of whitened columns at plausible sizes
    inverse: Array  # (p, p) of 1 + WᵀW
    occam: float  # ½ log det of that
    solved: Array  # (r, p) whitens Wᵀz over the combinations that are seen
    limit: float  # of the sum of r squares, beyond which the family-wise p is small enough


def _judge(linear: LinearModel, columns: Array, weight: float, tests: int) -> _Judge:
    """Of columns (n, p) at plausible sizes."""
    rest = max(linear.mixed.size - linear.mixed.A.shape[2] - 1, 1)
    white = linear.residual(columns)
    information = white.T @ white
    values, vectors = np.linalg.eigh(information)
    keep = values > _TOLD
    solved = (vectors[:, keep] / np.sqrt(values[keep])).T
    limit = keep.sum() * f_limit(ALPHA_NAME * weight / tests, max(int(keep.sum()), 1), rest)
    with_prior = np.eye(len(values)) + information
    return _Judge(
        weight,
        against=white.T,
        inverse=np.asarray(np.linalg.inv(with_prior), float),
        occam=float(np.linalg.slogdet(with_prior)[1]) / 2,
        solved=solved,
        limit=float(limit) if keep.any() else np.inf,
    )


@dataclass(frozen=True)
class _Bench:
    """All forms of a candidate beside one model."""

    linear: LinearModel
    judges: tuple[_Judge, ...]

    def judged(self, numbers: Array) -> tuple[Array, Mask]:
        """(D,) log Bayes factors, and whether they are significant, of numbers (n, D) of the channel."""
        white, logs, significant = self.linear.whiten(numbers), [], np.zeros(numbers.shape[1], bool)
        for judge in self.judges:
            b = judge.against @ white
            logs.append(0.5 * np.sum(b * (judge.inverse @ b), axis=0) - judge.occam + np.log(judge.weight))
            significant |= np.sum((judge.solved @ b) ** 2, axis=0) > judge.limit
        highest = np.max(logs, axis=0)
        return np.asarray(highest + np.log(np.sum(np.exp(logs - highest), axis=0))), significant


class Court:
    """All candidate effects of planned views, ready to judge what these would see."""

    def __init__(self, linear: LinearModel, candidates: Sequence[Candidate]) -> None:
        self.linear, self.candidates = linear, [c for c in candidates if _visible(linear, c)]
        self.tests = max(len(self.candidates), 1)
        self._half = np.linalg.cholesky(linear.covariance[0])
        self._of_arm = set({} if linear.pose_errors is None else linear.pose_errors.effects)
        self._benches: dict[tuple[frozenset[str], str], _Bench] = {}
        self._laws: dict[int, tuple[_Bench, ...]] = {}

    def seen(self, shift: Array, rng: np.random.Generator) -> Array:
        """(n, D) numbers of the channel: shifts (n, D) under all other errors."""
        return np.asarray(self._half @ rng.standard_normal(shift.shape) + shift)

    def chance(self, effect: str, shift: Array, rng: np.random.Generator) -> Chance:
        """What would be said of an effect that shifts the channel by (n, D)."""
        numbers = self.seen(shift, rng)
        own = [self._bench({c.name}, c).judged(numbers) for c in self.candidates]
        factor, significant = np.array([f for f, _ in own]), np.array([s for _, s in own])
        best = self._best(numbers, np.where(significant & (factor > 0), factor, -np.inf))
        alarm = (significant & (factor > LOG_BAYES_FACTOR)).any(axis=0)
        counts = {c.name: float(np.mean(alarm & (best == k))) for k, c in enumerate(self.candidates)}
        named = counts.pop(effect, 0.0)
        other = max(counts, key=lambda name: counts[name], default=None)
        taken_for = other if other is not None and counts[other] > 0 else None
        return Chance(effect, float(alarm.mean()), named, sum(counts.values()), taken_for)

    def _bench(self, removed: set[str], candidate: Candidate) -> _Bench:
        """A candidate where some effects are none of the errors that remain."""
        key = frozenset(removed & self._of_arm), candidate.name
        if key not in self._benches:
            linear = self.linear.without(removed)
            weights = form_weights(candidate)
            forms = zip(candidate.forms, weights, strict=True)
            self._benches[key] = _Bench(
                linear, tuple(_judge(linear, f.columns * f.sizes, float(w), self.tests) for f, w in forms)
            )
        return self._benches[key]

    def _best(self, numbers: Array, factor: Array) -> Array:
        """(D,) the candidate that is ahead of every contender by the odds that a name needs; −1 where none is.

        Args:
            factor: (K, D) log Bayes factors, −∞ where a candidate does not contend.
        """
        leader = factor.argmax(axis=0)
        out = np.where(np.isfinite(factor.max(axis=0)), leader, -1)
        for k in np.unique(leader[out >= 0]):
            led = np.flatnonzero((leader == k) & (out >= 0))
            out[led[~self._lawful(int(k), numbers[:, led])]] = -1
            for other in np.flatnonzero(np.isfinite(factor[:, led]).any(axis=1)):
                contested = led[np.isfinite(factor[other, led])]
                if other != k:
                    out[contested[~self._ahead(int(k), int(other), numbers[:, contested])]] = -1
        return out

    def _lawful(self, k: int, numbers: Array) -> Mask:
        """(D,) whether a candidate is ahead of every joint that follows by no law (`joint_laws.py`)."""
        own = self._bench({self.candidates[k].name}, self.candidates[k])
        linear, errors = own.linear, own.linear.pose_errors
        if errors is None or errors.of_joints is None or errors.of_ways is None:
            return np.ones(numbers.shape[1], bool)
        usual = float(errors.scales[errors.names.index("smooth")])
        lawless = [smooth.of(p) for smooth in (errors.of_joints, errors.of_ways) for p in range(smooth.count)]
        if k not in self._laws:
            halves = [_factor(linear.reduce(linear.reduce(covariance).T)) for covariance in lawless]
            sizes = [usual * np.sqrt(times) for times in TIMES]
            laws = tuple(_judge(linear, size * half, 1.0, 1) for half in halves for size in sizes)
            self._laws[k] = tuple(_Bench(linear, (law,)) for law in laws)
        found = np.max([law.judged(numbers)[0] for law in self._laws[k]], axis=0)
        rival = found - WIDTH + np.log(PRIOR_UNKNOWN / len(lawless))
        return np.asarray(own.judged(numbers)[0] + np.log(PRIOR_PHYSICAL / self.tests) > rival + ODDS)

    def _ahead(self, k: int, other: int, numbers: Array) -> Mask:
        pair = [self.candidates[k], self.candidates[other]]
        own, rival = (self._bench({c.name for c in pair}, c).judged(numbers)[0] for c in pair)
        return np.asarray(own > rival + ODDS)


def _factor(covariance: Array) -> Array:
    """(n, r) columns whose products make a covariance (n, n)."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * values[-1]
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


def _visible(linear: LinearModel, candidate: Candidate) -> bool:
    """True if one parameter at its plausible size is half a sigma at the least, as a diagnosis has it."""
    white = linear.without([candidate.name]).residual(candidate.forms[0].columns) * candidate.forms[0].sizes
    return bool((np.linalg.norm(white, axis=0) > SEEN).any())


def usual_shifts(candidate: Candidate, rng: np.random.Generator, draws: int = DRAWS) -> Array:
    """(n, D) what an effect of usual size does: each parameter of a form that is drawn, as large as is plausible."""
    chosen = rng.choice(len(candidate.forms), draws, p=form_weights(candidate))
    out = []
    for k in chosen:
        form = candidate.forms[k]
        out.append(form.columns @ (form.sizes * rng.choice([-1.0, 1.0], len(form.sizes))))
    return np.array(out).T
