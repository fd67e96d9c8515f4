"""Whether sessions of a rig share the effects that were fitted to all of them: each against a fit of its own.

Two arms of one make have the same table and other errors. In one fit with both, what the one does wrong is left in the
other, and looks like an effect that is missing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.integrity.arm_here import view_mean_squares
from stitch.stages.fitted import FittedRig
from stitch.statistics.tails import f_tail
from stitch.units import length_text

# That one session of sound rigs is doubted.
_SESSION_CHANCE = 0.001
# Numbers that the views show of each pose at the least, and that a session has of its own: base or hand-eye, and tool.
_NUMBERS_PER_VIEW, _NUMBERS_PER_SESSION = 3, 12


@dataclass(frozen=True)
class SessionDisagreement:
    """Rms over the views of one session, length_unit, with the effects of all and with its own."""

    name: str
    shared_rms: float
    separate_rms: float
    p_value: float  # that effects of its own explain so much by chance

    def doubt(self, unit: str) -> str:
        """As a sentence."""
        here, own = length_text(self.shared_rms, unit), length_text(self.separate_rms, unit)
        return (
            f"{self.name} does not share the effects of this rig: they leave {here}, fitted to it alone {own}; another "
            "arm, or something that has changed between the sessions: stitch each by itself."
        )


def find_disagreeing_sessions(
    names: Sequence[str], found: FittedRig, fit_separately: Callable[[int], FittedRig]
) -> list[SessionDisagreement]:
    """Sessions that want effects of their own, beyond chance (F test, Bonferroni over sessions).

    Args:
        found: the fit of all.
        fit_separately: fits the session of that index by itself.
    """
    ends = np.cumsum([own.measurement.views.count for own in found.sessions])[:-1]
    every = np.split(view_mean_squares(found), ends)
    out = []
    for i, (name, together) in enumerate(zip(names, every, strict=True)):
        own = fit_separately(i)
        tested = _test_session(name, together, view_mean_squares(own), _count_fitted_parameters(own))
        out += [tested] if tested.p_value < _SESSION_CHANCE / len(names) else []
    return out


def _count_fitted_parameters(fitted: FittedRig) -> int:
    """Of the effects that were fitted."""
    return sum(int(np.count_nonzero(term.values)) for term in fitted.model.terms)


def _test_session(name: str, shared: Array, separate: Array, numbers: int) -> SessionDisagreement:
    seen = np.isfinite(shared) & np.isfinite(separate)
    whole, own = float(shared[seen].sum()), float(separate[seen].sum())
    left = _NUMBERS_PER_VIEW * int(seen.sum()) - numbers - _NUMBERS_PER_SESSION
    views, p = max(int(seen.sum()), 1), 1.0
    if numbers and left > 0:
        F = (whole - own) / numbers / max(own / left, 1e-300)
        p = f_tail(max(F, 0.0), numbers, left)
    return SessionDisagreement(name, float(np.sqrt(whole / views)), float(np.sqrt(own / views)), p)
