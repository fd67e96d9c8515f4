"""Whether the effects of a model still hold their place beside each other."""

from collections.abc import Collection
from dataclasses import replace

from stitch.diagnosis.candidates import as_fitted
from stitch.diagnosis.initial_values import evidence_of_state
from stitch.diagnosis.selection.ranking import certain, rank, score_all
from stitch.diagnosis.validation.cross_validation import cross_validate
from stitch.measurement.measurement import Term
from stitch.stored.load_state import State

# An effect that shortens the distances by less than a hundredth is not worth its place in a model.
_WORTH = 0.99**2


def eliminated_effect(state: State, names: Collection[str]) -> tuple[str, str] | None:
    """The weakest effect that does not hold its place beside all the others, and why; None if all do.

    Args:
        names: effects of the model that may go.
    """
    asked = [_doubt(state, term) for term in state.terms if term.effect.name in names]
    failing = [(gain, name, reason) for gain, name, reason in asked if reason is not None]
    if not failing:
        return None
    _, name, reason = min(failing)
    return name, reason


def _doubt(state: State, term: Term) -> tuple[float, str, str | None]:
    """Log evidence of an effect beside the others, its name, and why it should go, if it should."""
    name = term.effect.name
    evidence = evidence_of_state(replace(state, terms=tuple(t for t in state.terms if t is not term)))
    candidate = as_fitted(evidence, term)
    if not candidate.forms[0].keep.any():
        return 0.0, name, f"{name} is not seen beside the others"
    own = rank(score_all(evidence, [candidate]))[0][0]
    if not certain(own):
        return own.score.gain, name, f"{name} explains too little beside the others"
    left = cross_validate(evidence, own.score, None)
    if not left.helps or left.poses > _WORTH:
        share = f"{left.poses:.3f} ± {left.poses_sigma:.3f}"
        return own.score.gain, name, f"{name} hardly helps on views left out (mean square error {share} of without)"
    return own.score.gain, name, None
