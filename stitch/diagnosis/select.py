"""From scores to an answer: which effects are named, which cannot be told apart, whether something unknown is there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.evidence import ViewEvidence
from stitch.diagnosis.score import ALPHA, Score, promising, score

# Prior shares: nothing is missing, one effect of the library, something without a name.
_NOTHING, _PHYSICAL, _UNKNOWN = 0.5, 0.45, 0.05
# The family-wise error is shared between names and the alarm without one.
ALPHA_NAME, ALPHA_UNKNOWN = 0.8 * ALPHA, 0.2 * ALPHA
# A name needs 20 to 1 over every other, and the unknown 20 to 1 over every name.
_ODDS = float(np.log(20.0))
# Log evidence over "nothing is missing" that a name needs: 12 to 1.
_GAIN = 2.5
# Hundreds of views show several missing effects at once; among few, one is all that can be told.
MANY = 100
# Effects that are sought together, and candidates tried in earnest for each of them.
_AT_ONCE, _TRIED = 6, 5
# No arm that is fit for use scatters more than this; larger is something systematic (mm, rad).
IMPLAUSIBLE = (2.5e-4, 0.12)


@dataclass(frozen=True)
class Ranked:
    """A score with its place among all."""

    score: Score
    adjusted: float  # family-wise p
    log_posterior: float  # not yet normalised
    posterior: float

    @property
    def name(self) -> str:
        return self.score.name

    @property
    def physical(self) -> bool:
        return self.score.candidate.effect.tier != "empirical"


@dataclass(frozen=True)
class Selection:
    """The answer before it is put into words."""

    verdict: str  # adequate | missing_effect | cannot_tell | unknown_effect
    named: tuple[Ranked, ...]  # the effect, or the group
    ranked: tuple[Ranked, ...]  # physical, best first, unobservable last
    empirical: tuple[Ranked, ...]  # best first
    second: Ranked | None = None  # a further effect that the views show beside the first


def score_all(evidence: ViewEvidence, candidates: Sequence[Candidate]) -> list[Score]:
    """Scores in the order of the candidates."""
    tests = sum(c.effect.tier != "empirical" for c in candidates)
    return [score(evidence, c, tests) for c in candidates]


def select(evidence: ViewEvidence, candidates: Sequence[Candidate], length_unit: str) -> Selection:
    """Name what is missing, or abstain."""
    ranked, empirical = rank(score_all(evidence, candidates))
    best = next((r for r in ranked if _nameable(r)), None)
    stray = next((r for r in empirical[:1] if r.adjusted < ALPHA_UNKNOWN and r.score.gain > _GAIN), None)
    if best is None and stray is None:
        verdict = "unknown_effect" if implausible(evidence, length_unit) else "adequate"
        return Selection(verdict, (), ranked, empirical)
    if best is None:
        return Selection("unknown_effect", (), ranked, empirical)
    second = None
    if evidence.chain.views.count >= MANY:
        chain, explained = _together(evidence, candidates, best)
        best, second = chain[0], chain[1] if len(chain) > 1 else None
        if stray is not None and stray.log_posterior > explained + _ODDS:
            return Selection("unknown_effect", (), ranked, empirical)
    elif stray is not None and stray.log_posterior > best.log_posterior + _ODDS:
        # Two known effects at once may look like none of them: try the best with a second one.
        best, second = _pair(evidence, candidates, best)
        together = best.log_posterior + (0.0 if second is None else second.score.gain + np.log(_PHYSICAL / len(ranked)))
        if stray.log_posterior > together + _ODDS:
            return Selection("unknown_effect", (), ranked, empirical)
    group = tuple(r for r in ranked if second is None and _nameable(r) and r.log_posterior > best.log_posterior - _ODDS)
    group = (best, *(r for r in group if r.name != best.name))
    return Selection("missing_effect" if len(group) == 1 else "cannot_tell", group, ranked, empirical, second)


def _together(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> tuple[list[Ranked], float]:
    """Effects that are missing at once, first the one without which most would stay unexplained; their log posterior.

    One effect alone may explain more than each of two that are there, because it imitates a part of both. So
    effects are added one by one as long as one can be named beside those before; then each must hold its
    place beside all the others.
    """
    chain = [best]
    while len(chain) < _AT_ONCE:
        beside = _beside(evidence, chain)
        others = [c for c in candidates if c.name not in {r.name for r in chain} and c.effect.tier != "empirical"]
        ranked, _ = rank(score_all(beside, promising(beside, others, _TRIED)))
        following = next((r for r in ranked if _nameable(r)), None)
        if following is None:
            break
        chain.append(following)
    explained = sum(r.log_posterior for r in chain)
    for name in [r.name for r in chain]:
        others_in = [r for r in chain if r.name != name]
        candidate = next(c for c in candidates if c.name == name)
        own = rank(score_all(_beside(evidence, others_in), [candidate]))[0][0]
        chain = [*others_in, own] if _nameable(own) else others_in
    return sorted(chain, key=lambda r: -r.log_posterior) or [best], explained


def _beside(evidence: ViewEvidence, chain: Sequence[Ranked]) -> ViewEvidence:
    columns = [r.score.form.columns for r in chain]
    return evidence.beside(np.hstack(columns)) if columns else evidence


def rank(scores: Sequence[Score]) -> tuple[tuple[Ranked, ...], tuple[Ranked, ...]]:
    """Physical and empirical candidates, best first; posterior shares among all and nothing."""
    known = [s for s in scores if s.candidate.effect.tier != "empirical"]
    other = [s for s in scores if s.candidate.effect.tier == "empirical" and s.observable]
    seen = max(sum(s.observable for s in known), 1)
    weights = [(s, _PHYSICAL / seen, seen) for s in known] + [(s, _UNKNOWN / len(other), len(other)) for s in other]
    logs = [s.gain + float(np.log(prior)) if s.observable else -np.inf for s, prior, _ in weights]
    total = float(logsumexp([*logs, np.log(_NOTHING)]))
    out = [
        Ranked(s, min(1.0, s.p_value * tests), log, float(np.exp(log - total)))
        for (s, _, tests), log in zip(weights, logs, strict=True)
    ]
    # Sorted by evidence; where there is none to tell them, by name, so that the order of a list decides nothing.
    out.sort(key=lambda r: (not r.score.observable, -round(r.log_posterior, 6) if r.score.observable else 0.0, r.name))
    return tuple(r for r in out if r.physical), tuple(r for r in out if not r.physical)


def implausible(evidence: ViewEvidence, length_unit: str) -> bool:
    """True if the poses scatter as no arm does."""
    rotation, translation = np.sqrt(evidence.null.variances[:2])
    return bool(rotation > IMPLAUSIBLE[0] or translation * {"mm": 1.0, "m": 1e3}[length_unit] > IMPLAUSIBLE[1])


def _nameable(r: Ranked) -> bool:
    """Significant, more likely than chance, seen, and of a size that somebody would believe.

    Both are asked for: a p-value forgets how little a small effect of many parameters explains, the evidence
    does not know how many were tried.
    """
    kept = [p for p, k in zip(r.score.candidate.parameters, r.score.form.keep, strict=True) if k]
    believable = all(abs(v) < p.limit for v, p in zip(r.score.values, kept, strict=True))
    likely = r.adjusted < ALPHA_NAME and r.score.gain > _GAIN
    return r.physical and r.score.observable and likely and believable


def _pair(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> tuple[Ranked, Ranked | None]:
    """The best effect and the one that explains most beside it; of the two the stronger comes first."""
    others = [c for c in candidates if c.name != best.name and c.effect.tier != "empirical"]
    ranked, _ = rank(score_all(evidence.beside(best.score.form.columns), others))
    second = next((r for r in ranked if _nameable(r)), None)
    if second is None:
        return best, None
    return best, second
