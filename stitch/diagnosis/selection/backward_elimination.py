"""Whether the effects of a model still hold their place beside each other."""

from collections.abc import Collection
from functools import partial

from stitch.diagnosis.candidates import candidate_as_fitted
from stitch.diagnosis.selection.ranking import is_certain, rank_one
from stitch.diagnosis.thresholds import MANY_POSES
from stitch.diagnosis.validation.cross_validation import cross_validate
from stitch.model.term import Term
from stitch.runs.state import RunState
from stitch.stages.course import linearise
from stitch.system.threads import parallel


def find_effect_to_drop(state: RunState, names: Collection[str]) -> tuple[str, str] | None:
    """The weakest effect of labelled points that does not hold its place beside all others, and why; None if all do.

    Effects are asked at once, of many poses one after the other. Scans, whose overlaps are found by all cores already,
    do not allow it.

    Args:
        names: effects of the model that may go.
    """
    asked = [term for term in state.model.terms if term.name in names]
    each = parallel if state.measurement.views.count < MANY_POSES else map
    found = zip(asked, each(partial(_test_effect, state), asked), strict=True)
    failing = [(factor, term.name, reason) for term, (factor, reason) in found if reason is not None]
    if not failing:
        return None
    _, name, reason = min(failing)
    return name, reason


def _test_effect(state: RunState, term: Term) -> tuple[float, str | None]:
    """Log Bayes factor of an effect beside the others, and why it should go, if it should."""
    name = term.name
    linear = linearise(state.session, state.measurement, state.model.without(name), state.gate)
    candidate = candidate_as_fitted(linear, term)
    if not candidate.forms[0].keep.any():
        return 0.0, f"{name} is not seen beside the others"
    own = rank_one(linear, candidate, tests=1)
    factor = own.score.log_bayes_factor
    if not is_certain(own):
        return factor, f"{name} explains too little beside the others"
    return factor, cross_validate(linear, own.score).rejection_reason(name)
