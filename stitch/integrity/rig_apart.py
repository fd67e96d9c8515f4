"""Whether sessions of a rig share the effects that were fitted to all of them: each against a fit of its own.

Two arms of one make have the same table and other errors. In one fit with both, what the one does wrong is left in the
other, and looks like an effect that is missing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.integrity.arm_here import squares_of_views
from stitch.stages.fitted import Fitted
from stitch.statistics.tails import f_tail
from stitch.units import length_text

# That one session of sound rigs is doubted.
_CHANCE = 0.001
# Numbers that the views show of each pose at the least, and that a session has of its own: base or hand-eye, and tool.
_OF_A_VIEW, _OF_ITS_OWN = 3, 12


@dataclass(frozen=True)
class SessionApart:
    """Rms over the views of one session, length_unit, with the effects of all and with its own."""

    name: str
    together: float
    alone: float
    p_value: float  # that effects of its own explain so much by chance

    def doubt(self, unit: str) -> str:
        """As a sentence."""
        here, own = length_text(self.together, unit), length_text(self.alone, unit)
        return (
            f"{self.name} does not share the effects of this rig: they leave {here}, fitted to it alone {own}; another "
            "arm, or something that has changed between the sessions: stitch each by itself."
        )


def sessions_apart(names: Sequence[str], found: Fitted, alone: Callable[[int], Fitted]) -> list[SessionApart]:
    """Sessions that want effects of their own, beyond chance (F test, Bonferroni over sessions).

    Args:
        found: the fit of all.
        alone: fits the session of that index by itself.
    """
    ends = np.cumsum([own.measurement.views.count for own in found.sessions])[:-1]
    every = np.split(squares_of_views(found), ends)
    out = []
    for i, (name, together) in enumerate(zip(names, every, strict=True)):
        own = alone(i)
        tested = _tested(name, together, squares_of_views(own), _numbers(own))
        out += [tested] if tested.p_value < _CHANCE / len(names) else []
    return out


def _numbers(fitted: Fitted) -> int:
    """Of the effects that were fitted."""
    return sum(int(np.count_nonzero(term.values)) for term in fitted.model.terms)


def _tested(name: str, together: Array, alone: Array, numbers: int) -> SessionApart:
    seen = np.isfinite(together) & np.isfinite(alone)
    whole, own = float(together[seen].sum()), float(alone[seen].sum())
    left = _OF_A_VIEW * int(seen.sum()) - numbers - _OF_ITS_OWN
    views, p = max(int(seen.sum()), 1), 1.0
    if numbers and left > 0:
        F = (whole - own) / numbers / max(own / left, 1e-300)
        p = f_tail(max(F, 0.0), numbers, left)
    return SessionApart(name, float(np.sqrt(whole / views)), float(np.sqrt(own / views)), p)
