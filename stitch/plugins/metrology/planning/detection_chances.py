"""Chances, before measuring: that an effect would be detected, named, or taken for another.

What planned views would see is drawn: an effect of a given size, beside everything that poses err by otherwise. Every
candidate effect is then judged as a diagnosis judges it (`diagnosis.evidence`), at the expected variances: family-wise
p, Bayes factor, and odds over every rival in the model in which neither of the two is among the errors that remain, and
over joints that follow by no law; not over a flange that errs in time by no law. What a diagnosis asks of views left
out is not drawn. The variances stay as they are expected, so that a test is a few small matrices and thousands of draws
cost nothing.

Pair by pair, two effects are told apart by what of one's pattern the other cannot imitate, λ in units of the scatter;
it grows with the square of the size. The other may take all its parameters, each up to about ten times its plausible
size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import form_weights
from stitch.diagnosis.sensitivity import detectable_sizes
from stitch.diagnosis.unmodelled_joint_effects import joint_effect_covariances, log_posterior_of_any
from stitch.numerics.distributions import f_limit
from stitch.numerics.frames import Array, Mask
from stitch.numerics.parameter_selection import log_mean_exp
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import usual_sizes
from stitch.plugins.metrology.planning.expected_model import (
    CellModel,
    ExpectedHandEye,
    FittedScatter,
    expected_hand_eye,
    expected_model,
    expected_scatter,
    simulate_views,
    with_scatter,
)
from stitch.plugins.metrology.planning.information import RIDGE
from stitch.session.session import SessionData
from stitch.system.process import steps

# Combinations that views see less than this share of a sigma, at plausible size, count in no p-value.
_MIN_INFORMATION = 1e-2
_DRAWS = 100


@dataclass(frozen=True)
class _FormTest:
    """One form at one scale, with p columns: turns what is seen into its log Bayes factor and its squares."""

    weight: float  # share of the candidate's prior
    against: Array  # (p, n) Wᵀ of whitened columns at the sizes of its scale
    inverse: Array  # (p, p) of 1 + WᵀW
    occam: float  # ½ log det of that
    solved: Array  # (r, p) whitens Wᵀz over the combinations that are seen
    limit: float  # of the sum of r squares, beyond which the family-wise p is small enough


@dataclass(frozen=True)
class CandidateTest:
    """All forms of a candidate beside one model."""

    linear: LinearModel
    forms: tuple[_FormTest, ...]

    def evaluate(self, numbers: Array) -> tuple[Array, Mask]:
        """(D,) log Bayes factors, and whether they are significant, of D draws (n, D) of the channel."""
        white = self.linear.whiten(numbers)
        significant = np.zeros(numbers.shape[1], bool)
        logs = []
        for form in self.forms:
            b = form.against @ white
            logs.append(0.5 * np.sum(b * (form.inverse @ b), axis=0) - form.occam + np.log(form.weight))
            significant |= np.sum((form.solved @ b) ** 2, axis=0) > form.limit
        highest = np.max(logs, axis=0)
        return highest + np.log(np.sum(np.exp(logs - highest), axis=0)), significant


def covariance_tests(linear: LinearModel, covariance: Array, sigmas: Array) -> tuple[CandidateTest, ...]:
    """Build tests of errors with a covariance (n, n) in the channel, times the square of each sigma (s,)."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * values[-1]
    half = vectors[:, keep] * np.sqrt(values[keep])
    return tuple(CandidateTest(linear, (_form_test(linear, sigma * half, 1.0, 1),)) for sigma in sigmas)


def _form_test(linear: LinearModel, columns: Array, weight: float, tests: int, share: float = 1.0) -> _FormTest:
    """Build the test of columns (n, p) at one scale with its share of the prior; all scales are one test."""
    white = linear.residual(columns)
    known = max(linear.satterthwaite.degrees_of_freedom(linear.in_blocks(white)), 1.0)
    information = white.T @ white
    values, vectors = np.linalg.eigh(information)
    keep = values > _MIN_INFORMATION
    solved = (vectors[:, keep] / np.sqrt(values[keep])).T
    limit = keep.sum() * f_limit(limits.ALPHA_NAME * weight / tests, max(int(keep.sum()), 1), known)
    with_prior = np.eye(len(values)) + information
    return _FormTest(
        weight * share,
        against=white.T,
        inverse=np.asarray(np.linalg.inv(with_prior), float),
        occam=float(np.linalg.slogdet(with_prior)[1]) / 2,
        solved=solved,
        limit=float(limit) if keep.any() else np.inf,
    )


@dataclass(frozen=True)
class EffectPair:
    """Two effects, and the multiple of its usual size from which each is told from the other."""

    a: str
    b: str
    size_a: float  # of a, told from b; infinite where no size is
    size_b: float

    @property
    def size(self) -> float:
        """The larger of the two."""
        return max(self.size_a, self.size_b)


def effect_pairs(linear: LinearModel, candidates: Sequence[Candidate]) -> list[EffectPair]:
    """All pairs of some candidates, hardest first."""
    pairs = []
    for i, a in enumerate(candidates):
        for b in candidates[i + 1 :]:
            base = linear.without([a.name, b.name])
            pairs.append(EffectPair(a.name, b.name, identifiable_size(base, a, b), identifiable_size(base, b, a)))
    return sorted(pairs, key=lambda pair: -pair.size)


def identifiable_size(base: LinearModel, effect: Candidate, rival: Candidate) -> float:
    """Multiple of the usual size from which an effect is told from its rival: median over the forms it may have.

    Args:
        base: neither of the two is among its pose errors.
    """
    whole = [form for form in rival.forms if form.keep.sum() == rival.forms[0].keep.sum()]
    imitations = [base.residual(form.columns) * form.sizes for form in whole]
    sizes = []
    for form in effect.forms:
        pattern = base.residual(form.columns) * form.sizes
        apart = min(separation(pattern, X) for X in imitations)
        sizes.append(float(np.sqrt(limits.SEPARATION_LAMBDA / apart)) if apart > 0 else float("inf"))
    order = np.argsort(sizes)
    weights = form_weights(effect)
    share = np.cumsum(weights[order]) / weights.sum()
    return sizes[order[np.searchsorted(share, 0.5)]]


def separation(pattern: Array, rival: Array) -> float:
    """λ: squared length of what columns (n, p) of a pattern keep when a rival's (n, q) imitate it."""
    left = pattern - rival @ np.linalg.solve(rival.T @ rival + RIDGE * np.eye(rival.shape[1]), rival.T @ pattern)
    return float(np.sum(pattern * left))


@dataclass(frozen=True)
class Chance:
    """Probabilities of what a diagnosis would say of one effect."""

    effect: str
    detected: float  # that something is said to be missing
    named: float  # that it is named, alone
    misnamed: float  # that another is named, alone
    taken_for: str | None  # the one that is named most often in its place


class ExpectedDiagnosis:
    """What a diagnosis of planned views would say, whatever these may see: all candidate effects beside the model."""

    def __init__(self, linear: LinearModel, candidates: Sequence[Candidate]) -> None:
        self.linear = linear
        self.candidates = [c for c in candidates if _is_visible(linear, c)]
        priors = np.array([c.effect.prior for c in self.candidates])
        self.tests = max(round(priors.sum()), 1)
        self._belief = np.log(priors)
        self._half = np.linalg.cholesky(linear.covariance[0])
        self._of_arm = set({} if linear.pose_errors is None else linear.pose_errors.effects)
        self._tests: dict[tuple[frozenset[str], str], CandidateTest] = {}
        # By candidate the tests of all laws beside it, of each kind of each joint together, at several sizes.
        self._laws: dict[int, list[list[tuple[CandidateTest, ...]]]] = {}

    def chance(self, effect: str, shift: Array, rng: np.random.Generator) -> Chance:
        """Return what would be said of an effect that shifts the channel by (n, D), under all other errors."""
        numbers = self._half @ rng.standard_normal(shift.shape) + shift
        answers = [self._test({c.name}, c).evaluate(numbers) for c in self.candidates]
        factor = np.array([f for f, _ in answers])
        significant = np.array([s for _, s in answers])
        posterior = factor + self._belief[:, None]
        best = self._best(numbers, np.where(significant & (factor > 0), posterior, -np.inf))
        alarm = (significant & (factor > limits.LOG_BAYES_FACTOR)).any(axis=0)
        counts = {c.name: float(np.mean(alarm & (best == k))) for k, c in enumerate(self.candidates)}
        named = counts.pop(effect, 0.0)
        other = max(counts, key=lambda name: counts[name], default=None)
        taken_for = other if other is not None and counts[other] > 0 else None
        return Chance(effect, float(alarm.mean()), named, sum(counts.values()), taken_for)

    def _test(self, removed: set[str], candidate: Candidate) -> CandidateTest:
        """A candidate where some effects are none of the errors that remain."""
        key = frozenset(removed & self._of_arm), candidate.name
        if key not in self._tests:
            linear = self.linear.without(removed)
            forms = (
                _form_test(linear, scale * form.columns * form.sizes, float(weight), self.tests, share)
                for form, weight in zip(candidate.forms, form_weights(candidate), strict=True)
                for scale, share in regime_of(linear).scales.items()
            )
            self._tests[key] = CandidateTest(linear, tuple(forms))
        return self._tests[key]

    def _best(self, numbers: Array, posterior: Array) -> Array:
        """(D,) the candidate that is ahead of every contender by the odds that a name needs; −1 where none is.

        Args:
            posterior: (K, D) log Bayes factors with each one's belief, −∞ where a candidate does not contend.
        """
        leader = posterior.argmax(axis=0)
        out = np.where(np.isfinite(posterior.max(axis=0)), leader, -1)
        for k in np.unique(leader[out >= 0]):
            led = np.flatnonzero((leader == k) & (out >= 0))
            out[led[~self._ahead_of_laws(int(k), numbers[:, led])]] = -1
            for other in np.flatnonzero(np.isfinite(posterior[:, led]).any(axis=1)):
                contested = led[np.isfinite(posterior[other, led])]
                if other != k:
                    pair = [self.candidates[k], self.candidates[other]]
                    names = {c.name for c in pair}
                    ahead, rival = (self._test(names, c).evaluate(numbers[:, contested])[0] for c in pair)
                    apart = self._belief[k] - self._belief[other]
                    out[contested[~(ahead + apart > rival + limits.ODDS)]] = -1
        return out

    def _ahead_of_laws(self, k: int, numbers: Array) -> Mask:
        """(D,) whether a candidate is ahead of joints that follow by no law (`joint_effect_covariances`)."""
        test = self._test({self.candidates[k].name}, self.candidates[k])
        if k not in self._laws:
            sizes = np.sqrt(limits.UNMODELLED_VARIANCES)
            covariances = joint_effect_covariances(test.linear)
            self._laws[k] = [[covariance_tests(test.linear, C, sizes) for C in kind] for kind in covariances]
        kinds = self._laws[k]
        if not kinds:
            return np.ones(numbers.shape[1], bool)
        # Of each law the log Bayes factor at the likeliest of its sizes.
        factors = [[np.max([size.evaluate(numbers)[0] for size in law], axis=0) for law in kind] for kind in kinds]
        rival = log_posterior_of_any(np.array([log_mean_exp(np.array(kind)) for kind in factors]))
        prior = np.log(limits.PRIOR_PHYSICAL / self.tests) + self._belief[k]
        return test.evaluate(numbers)[0] + prior > rival + limits.ODDS


def _is_visible(linear: LinearModel, candidate: Candidate) -> bool:
    """True if one parameter at its plausible size is half a sigma at the least, as a diagnosis has it."""
    form = candidate.forms[0]
    white = linear.without([candidate.name]).residual(form.columns) * form.sizes
    return bool((np.linalg.norm(white, axis=0) > limits.SEEN_SIGMAS).any())


def usual_shifts(candidate: Candidate, rng: np.random.Generator) -> Array:
    """(n, D) what an effect of usual size does: each parameter of a form that is drawn, as large as is plausible."""
    chosen = [candidate.forms[k] for k in rng.choice(len(candidate.forms), _DRAWS, p=form_weights(candidate))]
    return np.array([f.columns @ (f.sizes * rng.choice([-1.0, 1.0], len(f.sizes))) for f in chosen]).T


@dataclass(frozen=True)
class EffectOutlook:
    """One effect that could be missing."""

    name: str
    observable: bool
    detectable: dict[str, float]  # smallest size of every parameter that is detected in 80 % of cases
    usual: dict[str, float]  # plausible sizes
    units: dict[str, str]
    chance: Chance | None  # at usual size; None where the views cannot show it, or where it was not asked for

    @property
    def multiple(self) -> float:
        """Return the multiple of usual size at which the clearest parameter is detected; infinite where none is."""
        return min((self.detectable[name] / self.usual[name] for name in self.detectable), default=float("inf"))


@dataclass(frozen=True)
class Outlook:
    """What V views would tell."""

    views: int
    hand_eye: ExpectedHandEye
    ordinary: ExpectedHandEye  # with an arm that is a little wrong in every joint and link
    effects: tuple[EffectOutlook, ...]  # likeliest to be detected first
    pairs: tuple[EffectPair, ...]  # of the effects that the views show, hardest first
    untestable: dict[str, tuple[str, ...]]  # effect: what it needs and the session has not
    fitted_scatter: FittedScatter  # errors that the views leave open


def view_outlook(
    session: SessionData,
    cell: CellModel,
    fitted_scatter: FittedScatter | None = None,
    feature: Array | None = None,
    chances: bool = True,
) -> Outlook:
    """Return what the views of a session would tell.

    Args:
        fitted_scatter: errors of the arm; None: as large as these views leave them open where it scatters only.
        feature: (3,) reference frame: the place whose displacement U counts; None: the middle of the field.
        chances: draw what a diagnosis would say of every effect.

    Raises:
        NoResultError: a view that would not see the part, or views that do not overlap.
    """
    views = simulate_views(session, cell)
    linear = expected_model(views, cell)
    fitted_scatter = expected_scatter(linear, cell.scatter.noise) if fitted_scatter is None else fitted_scatter
    diagnosed = with_scatter(linear, fitted_scatter.fitted)
    candidates, missing = candidates_of(linear, empirical=False)
    expected = ExpectedDiagnosis(diagnosed, candidates)
    # Errors of a usual arm, where they are not larger anyway.
    believed = fitted_scatter.believed
    usual = {name: max(size, believed.errors.get(name, 0.0)) for name, size in usual_sizes().items()}
    ordinary = replace(believed, errors=believed.errors | usual)
    return Outlook(
        views=len(session.views),
        hand_eye=expected_hand_eye(with_scatter(linear, believed), views, feature),
        ordinary=expected_hand_eye(with_scatter(linear, ordinary), views, feature),
        effects=_effect_outlooks(diagnosed, candidates, expected, chances),
        pairs=tuple(effect_pairs(diagnosed, expected.candidates)),
        untestable={name: needs for name, needs in missing.items() if name not in linear.model.effects},
        fitted_scatter=fitted_scatter,
    )


def _effect_outlooks(
    linear: LinearModel, candidates: Sequence[Candidate], expected: ExpectedDiagnosis, chances: bool
) -> tuple[EffectOutlook, ...]:
    shown = {c.name for c in expected.candidates}
    rng = np.random.default_rng(0)
    outlooks = []
    for c in steps("effects", candidates):
        sizes = detectable_sizes(linear, c, expected.tests)
        fitted = [p for p in c.parameters if not p.grid]
        outlooks.append(
            EffectOutlook(
                name=c.name,
                observable=c.name in shown,
                detectable={p.name: sizes[p.name] for p in c.parameters if sizes.get(p.name, np.inf) < p.limit},
                usual={p.name: p.typical for p in fitted},
                units={p.name: p.unit for p in fitted},
                chance=expected.chance(c.name, usual_shifts(c, rng), rng) if chances and c.name in shown else None,
            )
        )
    return tuple(sorted(outlooks, key=lambda e: (not e.observable, e.multiple)))
