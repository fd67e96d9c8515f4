"""Diagnose, add, and again, until nothing is left to add."""

from stitch.diagnosis.diagnose import Diagnosis, diagnose
from stitch.pipeline import change
from stitch.result import Run
from stitch.state import State, state_of

# New matches alone change a residual by a few per cent.
_RISE = 1.05


def suggest(state: State, at_most: int) -> tuple[Run | None, list[str], Diagnosis]:
    """The run with everything that the diagnosis names, the way in lines, and the last diagnosis.

    The run is None where nothing is named.

    An effect stays unless the held-out residual rises: the diagnosis has asked already whether it predicts the poses
    of views left out, and a small effect moves them by less than the sensor's noise shows in a residual.
    """
    lines: list[str] = []
    result: Run | None = None
    found = diagnose(state)
    for _ in range(at_most):
        lines.append(found.sentence)
        if found.verdict != "missing_effect":
            break
        tried = change(state, [*(t.effect.name for t in state.terms), found.effects[0]])
        if not _earned(state, tried):
            lines.append(f"{found.effects[0]} was tried and did not earn its place: the held-out residual rose.")
            break
        result, state = tried, state_of(tried)
        found = diagnose(state)
    else:
        lines.append(f"Stopped after {at_most} effects; run it again to go on.")
    return result, lines, found


def _earned(state: State, tried: Run) -> bool:
    return not state.ledger or tried.heldout_rms < _RISE * state.ledger[-1].heldout_rms
