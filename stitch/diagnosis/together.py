"""Effects that are missing at once: found one by one, each asked to hold its place beside all the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.beyond import Beyond, errs_beyond
from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.evidence import ViewEvidence
from stitch.diagnosis.ranking import Ranked, certain, rank, score_all
from stitch.diagnosis.score import promising

# Effects that are sought together, and candidates tried in earnest for each of them.
_AT_ONCE, _TRIED = 6, 5


@dataclass(frozen=True)
class Together:
    """Effects beside each other; first the one without which most would stay unexplained."""

    effects: tuple[Ranked, ...]
    explained: float  # log posterior of what was found one by one
    notes: tuple[str, ...]  # why what explains much is not among them


def together(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> Together:
    """Effects that are missing at once.

    One effect alone may explain more than each of two that are there, because it imitates a part of both. So
    effects are added one by one as long as one can be named beside those before; then each must hold its
    place beside all the others. One that errs at an end of a joint's range is left out and the search goes on,
    for what it imitated may be explained by another.
    """
    candidates = [c for c in candidates if c.effect.tier != "empirical"]
    chain, notes = _grown(evidence, candidates, [best]), list[str]()
    explained = sum(r.log_posterior for r in chain)
    while True:
        chain = _holding(evidence, chain)
        erring = [(beyond.share, r.name, beyond) for r, beyond in _errors_beyond(evidence, chain) if beyond is not None]
        if not erring:
            return Together(tuple(sorted(chain, key=lambda r: -r.log_posterior)), explained, tuple(notes))
        _, name, beyond = max(erring, key=lambda e: e[:2])
        notes.append(told(name, beyond))
        candidates = [c for c in candidates if c.name != name]
        chain = _grown(evidence, candidates, [r for r in chain if r.name != name])


def told(name: str, beyond: Beyond) -> str:
    """Why an effect is not named though it explains much."""
    return (
        f"{name} would help among the poses that were measured, but not beyond: predicted from all others, "
        f"{beyond.end.name} would err by {beyond.share:.2f} ± {beyond.sigma:.2f} times as much (mean square)"
    )


def _grown(evidence: ViewEvidence, candidates: Sequence[Candidate], chain: Sequence[Ranked]) -> list[Ranked]:
    """Further effects, one by one, as long as one can be named beside those before."""
    chain = list(chain)
    while len(chain) < _AT_ONCE:
        beside = _beside(evidence, chain)
        others = [c for c in candidates if c.name not in {r.name for r in chain}]
        ranked, _ = rank(score_all(beside, promising(beside, others, _TRIED)))
        following = next((r for r in ranked if certain(r)), None)
        if following is None:
            break
        chain.append(following)
    return chain


def _holding(evidence: ViewEvidence, chain: list[Ranked]) -> list[Ranked]:
    """The effects that can still be named beside all the others."""
    for name in [r.name for r in chain]:
        others = [r for r in chain if r.name != name]
        candidate = next(r.score.candidate for r in chain if r.name == name)
        own = rank(score_all(_beside(evidence, others), [candidate]))[0][0]
        chain = [*others, own] if certain(own) else others
    return chain


def _errors_beyond(evidence: ViewEvidence, chain: Sequence[Ranked]) -> list[tuple[Ranked, Beyond | None]]:
    """Where each effect, beside the others, errs at an end of a joint's range that was left out."""
    return [(r, errs_beyond(_beside(evidence, [other for other in chain if other is not r]), r.score)) for r in chain]


def _beside(evidence: ViewEvidence, chain: Sequence[Ranked]) -> ViewEvidence:
    columns = [r.score.form.columns for r in chain]
    return evidence.beside(np.hstack(columns)) if columns else evidence
