"""From scores to an answer: which effects are named, which cannot be told apart, whether something unknown is there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch.diagnosis.candidates import Candidate
from stitch.diagnosis.selection.forward_selection import forward_selection
from stitch.diagnosis.selection.ranking import PHYSICAL, Ranked, certain, contends, rank, score_all
from stitch.diagnosis.selection.thresholds import ALPHA_UNKNOWN, GAIN, ODDS
from stitch.observations.evidence import ViewEvidence

# Hundreds of views show several missing effects at once; among few, one is all that can be told.
MANY = 100
# No arm that is fit for use scatters more than this; larger is something systematic (rad, mm).
IMPLAUSIBLE = (2.5e-4, 0.12)

# Errors of one and two periods a turn have a name; those of three and four have not.
_GEARS, _NAMELESS_ORDERS = ("gear_eccentricity", "gear_harmonic"), ("fourier_3", "fourier_4")


@dataclass(frozen=True)
class Selection:
    """The answer before it is put into words."""

    verdict: str  # adequate | missing_effect | cannot_tell | unknown_effect
    named: tuple[Ranked, ...]  # the effect, or the group
    ranked: tuple[Ranked, ...]  # physical, best first, unobservable last
    empirical: tuple[Ranked, ...]  # best first
    second: Ranked | None = None  # a further effect that the views show beside the first
    notes: tuple[str, ...] = ()  # effects that explain much and are not named, and why


def select(evidence: ViewEvidence, candidates: Sequence[Candidate], length_unit: str) -> Selection:
    """Name what is missing, or abstain."""
    ranked, empirical = rank(score_all(evidence, candidates))
    contenders = [r for r in ranked if contends(r)]
    stray = next((r for r in empirical[:1] if r.adjusted < ALPHA_UNKNOWN and r.score.gain > GAIN), None)
    if stray is None and not any(certain(r) for r in contenders):
        verdict = "unknown_effect" if implausible(evidence, length_unit) else "adequate"
        return Selection(verdict, (), ranked, empirical)
    if not contenders:
        return Selection("unknown_effect", (), ranked, empirical)
    best, second, refused = contenders[0], None, dict[str, str]()
    if evidence.measurement.views.count >= MANY:
        found = forward_selection(evidence, candidates, best)
        refused = found.refused
        explained = max(found.explained, best.log_posterior)
        if (stray is not None and stray.log_posterior > explained + ODDS) or (refused and not found.effects):
            return Selection("unknown_effect", (), ranked, empirical, notes=tuple(refused.values()))
        best = found.effects[0] if found.effects else best
        second = found.effects[1] if len(found.effects) > 1 else None
    elif stray is not None and stray.log_posterior > best.log_posterior + ODDS:
        # Two known effects at once may look like none of them: try the best with a second one.
        second = _second(evidence, candidates, best)
        both = best.log_posterior + (0.0 if second is None else second.score.gain + np.log(PHYSICAL / len(ranked)))
        if stray.log_posterior > both + ODDS:
            return Selection("unknown_effect", (), ranked, empirical)
    if _order_open(best, empirical):
        return Selection("unknown_effect", (), ranked, empirical)
    likely = (r for r in contenders if r.log_posterior > best.log_posterior - ODDS)
    others = (r for r in likely if r.name != best.name and r.name not in refused)
    group = (best, *(() if second is not None else others))
    if len(group) > 1 and evidence.measurement.views.count < MANY:
        two = _both(evidence, candidates, best)
        if two is not None:
            return Selection("missing_effect", two[:1], ranked, empirical, two[1])
    verdict, notes = "missing_effect" if len(group) == 1 else "cannot_tell", tuple(refused.values())
    return Selection(verdict, group, ranked, empirical, second, notes)


def implausible(evidence: ViewEvidence, length_unit: str) -> bool:
    """True if the poses scatter as no arm does."""
    rotation, translation = np.sqrt(evidence.null.variances[:2])
    return bool(rotation > IMPLAUSIBLE[0] or translation * {"mm": 1.0, "m": 1e3}[length_unit] > IMPLAUSIBLE[1])


def _order_open(best: Ranked, empirical: Sequence[Ranked]) -> bool:
    """True for a gear error that over so short a range may be one of an order without a name."""
    near = (r.name for r in empirical if r.log_posterior > best.log_posterior - ODDS)
    return best.name in _GEARS and any(name.startswith(_NAMELESS_ORDERS) for name in near)


def _both(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> tuple[Ranked, Ranked] | None:
    """Two effects that are both missing, where one alone left several as likely: what one of them took for itself.

    Each must be certain beside the other, and beside the second no other may come near the first.
    """
    second = _second(evidence, candidates, best)
    if second is None:
        return None
    others = [c for c in candidates if c.name != second.name and c.effect.tier != "empirical"]
    first, *rest = rank(score_all(evidence.conditioned_on(second.score.form.columns), others))[0]
    if not certain(first) or any(contends(r) and r.log_posterior > first.log_posterior - ODDS for r in rest):
        return None
    beside_first = evidence.conditioned_on(first.score.form.columns)
    again = rank(score_all(beside_first, [second.score.candidate]))[0][0]
    return (first, again) if certain(again) else None


def _second(evidence: ViewEvidence, candidates: Sequence[Candidate], best: Ranked) -> Ranked | None:
    """The effect that explains most beside the best one, if it is certain."""
    others = [c for c in candidates if c.name != best.name and c.effect.tier != "empirical"]
    ranked, _ = rank(score_all(evidence.conditioned_on(best.score.form.columns), others))
    return next((r for r in ranked if certain(r)), None)
