"""Which effects the data want beside everything else that an arm may do wrong.

A candidate is scored without its own share of the pose errors (`score.py`), while every other joint and link may err
by as much as the views show. What two effects can both do no single one is wanted for, since the errors that remain do
the other's part: then the smallest set is sought without which the views cannot do.
"""

from collections.abc import Sequence
from dataclasses import replace

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.score import score
from stitch.diagnosis.selection.ranking import Ranked, is_certain, is_contender, rank, rank_one
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unknown import rivals
from stitch.observations.linear_model import LinearModel


def rescore_contenders(linear: LinearModel, contenders: Sequence[Ranked]) -> tuple[list[Ranked], LinearModel]:
    """Contenders, likeliest first, where none of them is among the errors that remain; and the model in which they
    are not: there their Bayes factors are over one and the same."""
    base = linear.without([r.name for r in contenders])
    if len(contenders) < 2 or base is linear:
        return list(contenders), base
    return sorted((rescored_in(base, r) for r in contenders), key=lambda r: -r.log_posterior), base


def rescored_in(base: LinearModel, ranked: Ranked) -> Ranked:
    """The same candidate with its score in another model; it counts among as many as before."""
    own = score(base, ranked.score.candidate)
    return replace(
        ranked,
        score=own,
        adjusted=min(1.0, own.p_value * ranked.tests),
        log_posterior=ranked.log_posterior + own.log_bayes_factor - ranked.score.log_bayes_factor,
    )


def required_group(linear: LinearModel, candidates: Sequence[Candidate], tests: int) -> tuple[Ranked, ...]:
    """Effects of which some are wanted though none is alone, likeliest first; () if the views do without any.

    Args:
        tests: candidates among which the best is chosen.
    """
    families = () if linear.pose_errors is None else tuple(linear.pose_errors.effects)
    if not families or linear.without(families).null.deviance < linear.null.deviance:
        # No error of joints or links helps: none stands in for another.
        return ()
    known = {c.name: c for c in candidates if not c.empirical}
    ranked = rank([score(linear.without(families), c) for c in known.values()], tests)[0]
    best = next((r for r in ranked if is_certain(r)), None)
    if best is None:
        return ()
    removed = {best.name}
    while not is_certain(rank_one(linear.without(removed), known[best.name], tests)):
        others = [name for name in families if name in known and name not in removed]
        if not others:
            return ()
        removed.add(max(others, key=lambda name: _log_bayes_factor(linear.without({*removed, name}), known[best.name])))
    base = linear.without(removed)
    again = rank([score(base, c) for c in known.values() if c.name in removed], tests)[0]
    if rivals.unnamed_law_log_posterior(base) > again[0].log_posterior - ODDS:
        return ()
    near = [r for r in again if is_contender(r) and r.log_posterior > again[0].log_posterior - ODDS]
    # One that is far ahead of the others is still not wanted beside them, all of them being a little wrong.
    return tuple(near) if len(near) > 1 else again


def _log_bayes_factor(linear: LinearModel, candidate: Candidate) -> float:
    return score(linear, candidate).log_bayes_factor
