"""Effects that are missing at once: found one by one, each asked to hold its place beside all the others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import promising
from stitch.diagnosis.selection.ranking import Ranked, certain, rank, score_all
from stitch.diagnosis.validation.extrapolation import extrapolation
from stitch.observations.evidence import ViewEvidence

# Effects that are sought together, and candidates tried in earnest for each of them.
_AT_ONCE, _TRIED = 6, 5


@dataclass(frozen=True)
class ForwardSelection:
    """Effects beside each other; first the one without which most would stay unexplained."""

    effects: tuple[Ranked, ...]
    explained: float  # log posterior of what was found one by one
    refused: dict[str, str]  # effects that explain much and are not among them, and why


def forward_selection(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> ForwardSelection:
    """Effects that are missing at once.

    One effect alone may explain more than each of two that are there, because it imitates a part of both. So
    effects are added one by one as long as one can be named beside those before; then each must hold its
    place beside all the others. Of those that err beyond the measured poses the one without which the others err
    least is left out, and the search goes on: what it imitated others may explain. For that choice nothing is
    believed to be larger than found: beside an imitation the right effect is hardly known without an end.
    """
    candidates = [c for c in candidates if c.effect.tier != "empirical"]
    chain, refused = _grown(evidence, candidates, [best]), dict[str, str]()
    explained = sum(r.log_posterior for r in chain)
    while True:
        chain = _holding(evidence, chain)
        tried = [(r.name, extrapolation(_without(evidence, chain, r), r.score)) for r in chain]
        erring = {name: found for name, found in tried if found is not None and not found.helps}
        if not erring:
            return ForwardSelection(tuple(sorted(chain, key=lambda r: -r.log_posterior)), explained, refused)
        name = max(erring, key=lambda name: erring[name].believed)
        refused[name] = erring[name].told(name)
        candidates = [c for c in candidates if c.name != name]
        chain = _grown(evidence, candidates, [r for r in chain if r.name != name])


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


def _holding(evidence: ViewEvidence, chain: Sequence[Ranked]) -> list[Ranked]:
    """The effects that can still be named beside all the others."""
    chain = list(chain)
    for r in list(chain):
        own = rank(score_all(_without(evidence, chain, r), [r.score.candidate]))[0][0]
        others = [other for other in chain if other.name != r.name]
        chain = [*others, own] if certain(own) else others
    return chain


def _without(evidence: ViewEvidence, chain: Sequence[Ranked], one: Ranked) -> ViewEvidence:
    """The evidence beside all effects but one."""
    return _beside(evidence, [r for r in chain if r.name != one.name])


def _beside(evidence: ViewEvidence, chain: Sequence[Ranked]) -> ViewEvidence:
    columns = [r.score.form.columns for r in chain]
    return evidence.conditioned_on(np.hstack(columns)) if columns else evidence
