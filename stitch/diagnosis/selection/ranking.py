"""Candidates in the order of their evidence, and which of them are enough for a name."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import Score, score
from stitch.diagnosis.selection.thresholds import ALPHA_NAME, GAIN
from stitch.observations.evidence import ViewEvidence

# Prior shares: nothing is missing, one effect of the library, something without a name.
_NOTHING, PHYSICAL, _UNKNOWN = 0.5, 0.45, 0.05


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


def score_all(evidence: ViewEvidence, candidates: Sequence[Candidate]) -> list[Score]:
    """Scores in the order of the candidates."""
    return [score(evidence, c) for c in candidates]


def rank(scores: Sequence[Score]) -> tuple[tuple[Ranked, ...], tuple[Ranked, ...]]:
    """Physical and empirical candidates, best first; posterior shares among all and nothing."""
    known = [s for s in scores if s.candidate.effect.tier != "empirical"]
    other = [s for s in scores if s.candidate.effect.tier == "empirical" and s.observable]
    seen = max(sum(s.observable for s in known), 1)
    weights = [(s, PHYSICAL / seen, seen) for s in known] + [(s, _UNKNOWN / len(other), len(other)) for s in other]
    logs = [s.gain + float(np.log(prior)) if s.observable else -np.inf for s, prior, _ in weights]
    total = float(logsumexp([*logs, np.log(_NOTHING)]))
    out = [
        Ranked(s, min(1.0, s.p_value * tests), log, float(np.exp(log - total)))
        for (s, _, tests), log in zip(weights, logs, strict=True)
    ]
    # Sorted by evidence; where there is none to tell them, by name, so that the order of a list decides nothing.
    out.sort(key=lambda r: (not r.score.observable, -round(r.log_posterior, 6) if r.score.observable else 0.0, r.name))
    return tuple(r for r in out if r.physical), tuple(r for r in out if not r.physical)


def contends(r: Ranked) -> bool:
    """Significant, more likely than nothing, seen, and of a size that somebody would believe.

    Both are asked for: a p-value forgets how little a small effect of many parameters explains, the evidence
    does not know how many were tried.
    """
    kept = [p for p, k in zip(r.score.candidate.parameters, r.score.form.keep, strict=True) if k]
    believable = all(abs(v) < p.limit for v, p in zip(r.score.values, kept, strict=True))
    return r.physical and r.score.observable and r.adjusted < ALPHA_NAME and r.score.gain > 0 and believable


def certain(r: Ranked) -> bool:
    """Enough for an alarm."""
    return contends(r) and r.score.gain > GAIN
