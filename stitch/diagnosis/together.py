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
    refused: dict[str, str]  # effects that explain much and are not among them, and why


def together(evidence: ViewEvidence, candidates: Sequence[Candidate], ranked: Sequence[Ranked]) -> Together:
    """Effects that are missing at once.

    One effect alone may explain more than each of two that are there, because it imitates a part of both. So
    effects are added one by one as long as one can be named beside those before and does not err at an end of a
    joint's range that was left out; then each must hold its place beside all the others.

    Args:
        ranked: the candidates alone, best first.
    """
    physical = [c for c in candidates if c.effect.tier != "empirical"]
    chain, notes = list[Ranked](), dict[str, str]()
    while len(chain) < _AT_ONCE:
        beside = _beside(evidence, chain)
        if chain:
            others = [c for c in physical if c.name not in {r.name for r in chain}]
            ranked, _ = rank(score_all(beside, promising(beside, others, _TRIED)))
        following = _first_sound(beside, ranked, notes)
        if following is None:
            break
        chain.append(following)
    explained = sum(r.log_posterior for r in chain)
    chain = _holding(evidence, chain)
    refused = {name: note for name, note in notes.items() if name not in {r.name for r in chain}}
    return Together(tuple(sorted(chain, key=lambda r: -r.log_posterior)), explained, refused)


def told(name: str, beyond: Beyond) -> str:
    """Why an effect is not named though it explains much."""
    return (
        f"{name} would help among the poses that were measured, but not beyond: predicted from all others, "
        f"{beyond.end.name} would err by {beyond.share:.2f} ± {beyond.sigma:.2f} times as much (mean square)"
    )


def _first_sound(beside: ViewEvidence, ranked: Sequence[Ranked], notes: dict[str, str]) -> Ranked | None:
    """The best that can be named and does not err beyond; of those before it `notes` says where they do."""
    for r in ranked:
        if certain(r):
            beyond = errs_beyond(beside, r.score)
            if beyond is None:
                return r
            notes[r.name] = told(r.name, beyond)
    return None


def _holding(evidence: ViewEvidence, chain: list[Ranked]) -> list[Ranked]:
    """The effects that can still be named beside all the others."""
    for name in [r.name for r in chain]:
        others = [r for r in chain if r.name != name]
        candidate = next(r.score.candidate for r in chain if r.name == name)
        own = rank(score_all(_beside(evidence, others), [candidate]))[0][0]
        chain = [*others, own] if certain(own) else others
    return chain


def _beside(evidence: ViewEvidence, chain: Sequence[Ranked]) -> ViewEvidence:
    columns = [r.score.form.columns for r in chain]
    return evidence.beside(np.hstack(columns)) if columns else evidence
