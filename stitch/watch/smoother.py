"""Where every parameter was, seen from now: the fixed-interval smoother of the likeliest member of the bank.

Rauch, Tung & Striebel (1965, AIAA J. 3:1445). Backwards from the last session it needs the filtered states of as many
sessions as are shown, and no others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stitch.frames import Array
from stitch.watch.follow import CellState, Sessions, next_state
from stitch.watch.state_bank import Bank, predicted_bank, reset_moved, transition

# Directions of a predicted covariance below this share of its largest are not known to move.
_SINGULAR = 1e-13


@dataclass(frozen=True)
class SmoothedStates:
    """n sessions, P parameters, in their units."""

    values: Array  # (n, P) at the conditions of each session
    own_sigmas: Array  # (n, P) without what all sessions have in common


def smoothed_states(
    state: CellState, sessions: Sessions, moved: Mapping[int, Sequence[int]], last: CellState
) -> SmoothedStates:
    """The sessions after a state, smoothed.

    Args:
        state: just before the first of the sessions.
        moved: by session, parameters to which something happened before it.
        last: the state after the last of them; it says which member is likeliest.
    """
    members = last.bank.best
    # Parameters that came since the state join all members and are thinned with the others.
    filtered, state = list[Bank](), state
    for k, run in enumerate(sessions.ids):
        state = next_state(state, sessions, k, moved.get(run, ()))
        own = state.bank
        filtered.append(own.chosen(members[: len(own.origin)]))
    return _smooth_backwards(filtered, sessions, moved, last.bank.chosen(members))


def _smooth_backwards(
    filtered: Sequence[Bank], sessions: Sessions, moved: Mapping[int, Sequence[int]], last: Bank
) -> SmoothedStates:
    n, P, d = len(filtered), len(last.origin), last.mean.shape[2]
    means, covariances = np.full((n, P, d), np.nan), np.full((n, P, d, d), np.nan)
    mean, covariance = filtered[-1].mean[:, 0], filtered[-1].covariance[:, 0]
    means[-1], covariances[-1] = mean, covariance
    for k in range(n - 2, -1, -1):
        now, known = filtered[k], len(filtered[k].origin)
        days = sessions.days[k + 1] - sessions.days[k]
        ahead = predicted_bank(now, max(days, 0.0))
        if happened := moved.get(sessions.ids[k + 1], ()):
            ahead = reset_moved(ahead, np.isin(np.arange(known), list(happened)))
        F = transition(d, max(days, 0.0))
        P_ahead = ahead.covariance[:, 0]
        gain = now.covariance[:, 0] @ F.T @ _inverse(P_ahead)
        mean = now.mean[:, 0] + np.einsum("pij,pj->pi", gain, mean[:known] - ahead.mean[:, 0])
        covariance = now.covariance[:, 0] + gain @ (covariance[:known] - P_ahead) @ np.swapaxes(gain, -1, -2)
        means[k, :known], covariances[k, :known] = mean, covariance
    x = np.column_stack([np.ones(n), np.zeros(n), sessions.covariates])
    variance = np.einsum("ni,npij,nj->np", x, covariances, x) * last.scatter[:, 0]
    return SmoothedStates(
        values=last.origin + last.unit * np.einsum("npi,ni->np", means, x),
        own_sigmas=last.unit * np.sqrt(np.maximum(variance, 0.0)),
    )


def _inverse(covariance: Array) -> Array:
    """(P, d, d) of symmetric matrices of which some directions may be certain: these stay as they are."""
    diagonal = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    scale = np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0)
    unit = covariance * scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.pinv(unit, rcond=_SINGULAR, hermitian=True) * scale[:, :, None] * scale[:, None, :])
