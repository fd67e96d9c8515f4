"""Which parameters of the effects in use the views support, and how large the others may be.

An effect with a number for every joint would lend each of them to the noise, and what the views hardly know
they borrow from the hand-eye. A group of parameters is fitted where the evidence for it, the likelihood
integrated over amplitudes of plausible size, exceeds that of leaving it at zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.special import expit, logit, logsumexp

from stitch.numerics.frames import Array, Indices, Mask
from stitch.numerics.least_squares import equilibrated, project_out

# How large an amplitude may be over its plausible size: scales of a normal prior, and the share of belief in each. A
# mixture of normal distributions has tails that one of them has not (West 1987, Biometrika 74:646): a table of lengths
# in which a digit is wrong, or a joint mounted a tooth off, is no reason to believe in nothing at all.
# What is grossly wrong: one effect of a hundred.
GROSS, _GROSS_SHARE = 30.0, 0.01
# Of plausible size, or grossly wrong.
PLAUSIBLE = {1.0: 1 - _GROSS_SHARE, GROSS: _GROSS_SHARE}
# Of any size: what plausible sizes are is a guess.
ANY_SIZE = dict.fromkeys((1.0, 3.0, 0.3, 0.1), (1 - _GROSS_SHARE) / 4) | {GROSS: _GROSS_SHARE}
# Log Bayes factor that a group must add: 12 to 1, as a name must in the diagnosis.
_LOG_BAYES_FACTOR = 2.5
# A parameter that these views know worse than this many times its plausible size stays at zero: it would
# only borrow from the hand-eye.
UNSEEN = 4.0
# A parameter of an effect of which nobody knows more is there or not.
_EVEN_ODDS = 0.5


def log_evidence(information: Array, vector: Array, precision: Array | None = None, mean: Array | None = None) -> Array:
    """(...) log of the likelihood, vᵀθ − ½ θᵀIθ, integrated over a normal prior of the amplitudes θ (..., k).

    Args:
        information: (..., k, k) I.
        vector: (..., k) v.
        precision: (k, k) of the prior; one unless stated.
        mean: (k,) of the prior; zero unless stated.
    """
    # In units of the prior: amplitudes may differ by powers of ten.
    P, unit = equilibrated(np.eye(vector.shape[-1]) if precision is None else precision)
    m = np.zeros(len(unit)) if mean is None else mean / unit
    both = information * np.outer(unit, unit) + P
    pull = vector * unit + P @ m
    square = np.sum(pull * np.linalg.solve(both, pull[..., None])[..., 0], axis=-1) - m @ P @ m
    return 0.5 * (square - np.linalg.slogdet(both)[1] + np.linalg.slogdet(P)[1])


def log_evidence_at_scales(information: Array, vector: Array, scales: dict[float, float]) -> Array:
    """(s,) the same for a normal prior of unit size times each of the scales."""
    out, k = np.zeros(len(scales)), len(vector)
    for i, scale in enumerate(scales if k else ()):
        both = scale**2 * information
        both.flat[:: k + 1] += 1.0
        root, _ = dpotrf(both, lower=1, clean=0)
        half = dtrtrs(root, scale * vector, lower=1)[0]
        out[i] = 0.5 * float(half @ half) - float(np.log(root.diagonal()).sum())
    return out


def log_mixture(logs: Array, scales: dict[float, float]) -> float:
    """Log evidence over all scales from that of each (s,)."""
    return float(np.logaddexp.reduce(logs + np.log(list(scales.values()))))


def log_mean_exp(logs: Sequence[float] | Array) -> Array:
    """Return the log (…) of the mean over n factors, from their logs (n, …): Bayes factors of which one is meant."""
    return logsumexp(logs, axis=0) - np.log(len(logs))


@dataclass(frozen=True)
class WhitenedData:
    """An observation in units of its scatter."""

    base: Array  # (N, a) columns of what is fitted in any case: hand-eye, landmarks
    further: Array  # (N, P) columns per unit of the effects' parameters
    z: Array  # (N,) what was seen, without the effects


def select_supported(
    whitened: WhitenedData, sizes: Array, groups: Sequence[Sequence[int]], effects: Sequence[int]
) -> Mask:
    """(P,) bool: parameters that are fitted; of every effect at least its best group.

    Args:
        sizes: (P,) plausible sizes.
        groups: indices of parameters that stand or fall together; one may hold another.
        effects: number of the effect that each group belongs to.
    """
    G = project_out(whitened.base, whitened.further * sizes)
    y = project_out(whitened.base, whitened.z[:, None])[:, 0]
    M, v = G.T @ G, G.T @ y

    @cache
    def gain_of(*index: int) -> float:
        information, vector = M[np.ix_(index, index)], v[list(index)]
        return log_mixture(log_evidence_at_scales(information, vector, PLAUSIBLE), PLAUSIBLE)

    def gain(chosen: Sequence[int]) -> float:
        return gain_of(*sorted({i for k in chosen for i in groups[k]}))

    every = list(range(len(groups)))
    # Two joints may explain together what neither does alone: adding one by one never meets them, leaving out does.
    ways = (eliminate_backward(gain, select_forward(gain, every)), eliminate_backward(gain, every))
    chosen = max(ways, key=gain)
    seen = np.linalg.norm(G, axis=0) >= 1 / UNSEEN
    for effect in dict.fromkeys(effects):
        if not any(effects[k] == effect for k in chosen):
            of_effect = [k for k in every if effects[k] == effect]
            chosen.append(max(of_effect, key=lambda k: (seen[groups[k]].any(), gain([*chosen, k]))))
    out = np.zeros(len(sizes), bool)
    out[[i for k in chosen for i in groups[k]]] = True
    return out


def omitted_rms(whitened: WhitenedData, sizes: Array, fitted: Mask, effects: Indices) -> Array:
    """(P,) rms that parameters left at zero may well have, beside those that are fitted; zero for these.

    Each may be there or not: with probability π it has the mean μ and the sigma σ that the views give it, so that its
    mean square is π(μ² + σ²) (Bayesian model averaging; Hoeting et al. 1999). What to expect before they are asked the
    other parameters of its effect tell, each as far as the views tell it: how many of them are there, beside one at
    even odds (Jeffreys' prior of a share), and how large those are, beside one of plausible size (credibility; Bühlmann
    1967, ASTIN Bulletin 4:199). Where one joint of five is off, a sixth that nobody sees is likelier right than off;
    where all are off, it is so too.

    Args:
        sizes: (P,) plausible sizes.
        fitted: (P,) bool.
        effects: (P,) index of the effect that each belongs to.
    """
    information, pull = _marginal_information(whitened, sizes, fitted)
    seen = information / (1 + information)
    gain, square = _inclusion_odds(information, pull)
    others = np.equal.outer(effects, effects) & ~np.eye(len(sizes), dtype=bool)
    there = seen * expit(gain)
    share = (_EVEN_ODDS + others @ there) / (1 + others @ seen)
    scale = np.sqrt((1 + others @ (there * square)) / (1 + others @ there))
    gain, square = _inclusion_odds(scale**2 * information, scale * pull)
    rms = sizes * scale * np.sqrt(expit(logit(share) + gain) * square)
    return np.where(fitted, 0.0, rms)


def _inclusion_odds(precision: Array, vector: Array) -> tuple[Array, Array]:
    """(P,) log odds that a parameter of standard normal prior has over none, and its mean square if it is there."""
    mean, variance = vector / (1 + precision), 1 / (1 + precision)
    return 0.5 * vector * mean - 0.5 * np.log1p(precision), mean**2 + variance


def _marginal_information(whitened: WhitenedData, sizes: Array, fitted: Mask) -> tuple[Array, Array]:
    """(P,) what the views know of every parameter beside all others that are fitted, per plausible size: information,
    and that times the likeliest value."""

    def conditioned_on(others: Mask, asked: Mask) -> tuple[Array, Array]:
        base = np.hstack([whitened.base, whitened.further[:, others]])
        G = project_out(base, whitened.further[:, asked] * sizes[asked])
        y = project_out(base, whitened.z[:, None])[:, 0]
        return np.einsum("np,np->p", G, G), G.T @ y

    information, pull = np.zeros(len(sizes)), np.zeros(len(sizes))
    information[~fitted], pull[~fitted] = conditioned_on(fitted, ~fitted)
    for p in np.flatnonzero(fitted):
        only = np.arange(len(sizes)) == p
        information[only], pull[only] = conditioned_on(fitted & ~only, only)
    return information, pull


def select_forward(
    gain: Callable[[Sequence[int]], float], groups: Sequence[int], begin: Sequence[int] = (), most: int | None = None
) -> list[int]:
    """Return groups of parameters, chosen one after the other: the one that gains most, until none gains enough.

    Args:
        gain: log Bayes factor of some groups together, nats.
        groups: to choose from.
        begin: groups that are in from the start.
        most: groups in all; None: no limit.
    """
    chosen = list(begin)
    while (left := [k for k in groups if k not in chosen]) and (most is None or len(chosen) < most):
        best = max(left, key=lambda k: gain([*chosen, k]))
        if gain([*chosen, best]) - gain(chosen) < _LOG_BAYES_FACTOR:
            break
        chosen.append(best)
    return chosen


def eliminate_backward(gain: Callable[[Sequence[int]], float], groups: Sequence[int]) -> list[int]:
    """The group that is missed least is left out until all that remain gain enough beside each other."""
    chosen = list(groups)
    while chosen:
        rests = [[other for other in chosen if other != k] for k in chosen]
        rest = max(rests, key=gain)
        if gain(chosen) - gain(rest) >= _LOG_BAYES_FACTOR:
            break
        chosen = rest
    return chosen
