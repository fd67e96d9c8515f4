"""Candidates in the order of their log Bayes factor, and which of them are enough for a name."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import Score, score
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.system.threads import parallel


@dataclass(frozen=True)
class Ranked:
    """The score of a candidate, and what it means among all candidates."""

    score: Score
    adjusted: float  # family-wise p-value (Bonferroni)
    log_posterior: float  # log Bayes factor + log prior: not yet normalised
    posterior: float  # normalised over all candidates and that nothing is missing
    tests: int = 1  # number of tests for which the p-value is adjusted

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.score.name

    @property
    def physical(self) -> bool:
        """True for an effect of the library or a user's own; False for a shape without a cause."""
        return not self.score.candidate.empirical

    @property
    def log_odds_over_nothing(self) -> float:
        """Log odds over nothing being missing."""
        return self.log_posterior - float(np.log(limits.PRIOR_NOTHING))

    @property
    def log_belief(self) -> float:
        """Log prior of the effect over that of a usual one: how often it is met, a judgement."""
        return float(np.log(self.score.candidate.effect.prior))

    @property
    def log_evidence(self) -> float:
        """Log posterior without the judgement of how often the effect is met: what the views say."""
        return self.log_posterior - self.log_belief

    def comes_near(self, best: "Ranked") -> bool:
        """Return whether the best effect is less than 20 to 1 likelier, with or without the prior of how common it is.

        That prior is a judgement: it may order effects that explain equally much, but exclude none of them.
        """
        difference = min(best.log_posterior - self.log_posterior, best.log_evidence - self.log_evidence)
        return difference < limits.ODDS


def rank_all(linear: LinearModel, candidates: Sequence[Candidate]) -> tuple[tuple[Ranked, ...], tuple[Ranked, ...]]:
    """Return physical and empirical candidates, scored and ranked, best first.

    The number of tests is the sum of the priors of observable physical effects: rare ones count as a part of a test.
    """
    scores = list(parallel(partial(score, linear), candidates, "candidate effects"))
    beliefs = [s.candidate.effect.prior for s in scores if s.observable and not s.candidate.empirical]
    return rank(scores, round(sum(beliefs)))


def rank_one(linear: LinearModel, candidate: Candidate, tests: int, start: Array | None = None) -> Ranked:
    """Return one candidate scored and ranked, as one that was chosen among `tests` of them.

    Args:
        start: (c,) variances at which the fit begins; None: those of the null fit, and other likely ones.
    """
    return rank([score(linear, candidate, start)], tests)[0][0]


def rank(scores: Sequence[Score], tests: int) -> tuple[tuple[Ranked, ...], tuple[Ranked, ...]]:
    """Return physical and empirical candidates with p-values and posteriors, best first.

    The log posterior is log BF + log prior; probabilities are over all candidates and that nothing is missing. Physical
    effects share one prior, weighted by how common they are, and empirical shapes another. The p-value is multiplied by
    the number of tests of its kind (Bonferroni).

    Args:
        tests: number of physical candidates among which these were chosen, scored here or not.
    """
    physical = [s for s in scores if not s.candidate.empirical]
    empirical = [s for s in scores if s.candidate.empirical and s.observable]
    tests = max(tests, 1)
    weighted = [(s, limits.PRIOR_PHYSICAL * s.candidate.effect.prior / tests, tests) for s in physical]
    weighted += [(s, limits.PRIOR_UNKNOWN / len(empirical), len(empirical)) for s in empirical]
    logs = [s.log_bayes_factor + float(np.log(prior)) if s.observable else -np.inf for s, prior, _ in weighted]
    total = float(logsumexp([*logs, np.log(limits.PRIOR_NOTHING)]))
    ranked = [
        Ranked(s, min(1.0, s.p_value * family), log, float(np.exp(log - total)), family)
        for (s, _, family), log in zip(weighted, logs, strict=True)
    ]
    # Ties are ordered by name: the order of the library decides nothing.
    ranked.sort(
        key=lambda r: (not r.score.observable, -round(r.log_posterior, 6) if r.score.observable else 0.0, r.name)
    )
    return tuple(r for r in ranked if r.physical), tuple(r for r in ranked if not r.physical)


def too_large(named: Sequence[Ranked]) -> tuple[str, ...]:
    """Return the parameters of the first named effect that are implausibly large; () unless every one has such.

    Of a group that cannot be told apart, one effect of believable size is enough to be believed.
    """
    names = list[list[str]]()
    for scored in (r.score for r in named):
        fitted = zip(scored.form.free, scored.values, scored.sigmas, strict=True)
        names.append([p.name for p, value, sigma in fitted if p.beyond_belief(value, sigma)])
    return tuple(names[0]) if names and all(names) else ()


def beyond_belief_text(names: Sequence[str]) -> str:
    """Return which parameters are larger than is believed of them."""
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} larger than is believable"


def likeliest_first(ranked: Iterable[Ranked]) -> tuple[Ranked, ...]:
    """Return candidates in the order of their log posteriors, the largest first."""
    return tuple(sorted(ranked, key=lambda r: -r.log_posterior))


def rescored_against(ranked: Sequence[Ranked], best: Ranked, log_posterior: float) -> tuple[Ranked, ...]:
    """Return the ranking with posteriors reduced for a further hypothesis, so that all add up to 1 again.

    Args:
        best: candidate in the model in which the hypothesis was scored.
        log_posterior: of the hypothesis, in that model; its odds over `best` are carried over to the ranking.
    """
    of_best = next(r for r in ranked if r.name == best.name).posterior
    total = 1 + of_best * float(np.exp(min(log_posterior - best.log_posterior, 700.0)))
    return tuple(replace(r, posterior=r.posterior / total) for r in ranked)


def is_contender(ranked: Ranked) -> bool:
    """Return whether an effect may be named: physical, observable, significant, and with a Bayes factor over 1.

    A p-value alone ignores how little a small effect with many parameters explains; a Bayes factor alone ignores how
    many effects were tried.
    """
    scored = ranked.score
    significant = ranked.physical and scored.observable and ranked.adjusted < limits.ALPHA_NAME
    return significant and scored.log_bayes_factor > 0


def is_certain(ranked: Ranked) -> bool:
    """Return whether an effect is enough for an alarm by itself: a contender at 12 to 1 over nothing."""
    return is_contender(ranked) and ranked.score.log_bayes_factor > limits.LOG_BAYES_FACTOR


def stands_out(ranked: Ranked) -> bool:
    """Return whether a law, or an empirical shape, is enough for an alarm: significant, and 12 to 1 over nothing."""
    # Bonferroni over two families of such shapes: laws of the dictionary, and empirical effects.
    return ranked.adjusted < 0.5 * limits.ALPHA_UNKNOWN and ranked.score.log_bayes_factor > limits.LOG_BAYES_FACTOR


def conditioned_without(
    linear: LinearModel, chosen: Sequence[Ranked], one: Ranked, start: Array | None = None
) -> LinearModel:
    """Return the linear model with all chosen effects but `one` as further unknowns, as `conditioned_on_effects`."""
    return conditioned_on_effects(linear, [r for r in chosen if r.name != one.name], start)


def conditioned_on_effects(linear: LinearModel, chosen: Sequence[Ranked], start: Array | None = None) -> LinearModel:
    """Return the linear model with the chosen effects as further unknowns, with priors of their plausible sizes.

    A candidate that is scored in it is asked what it explains beside them. Without effects, the model itself.

    Args:
        start: (c,) variances at which their fit begins; None: those of the fit with the last of the effects.
    """
    if not chosen:
        return linear
    start = chosen[-1].score.variances if start is None else start
    by_name = sorted(chosen, key=lambda r: r.name)
    columns = [r.score.form.selected for r in by_name]
    return linear.conditioned_on(columns, np.concatenate([r.score.sizes for r in by_name]), start)
