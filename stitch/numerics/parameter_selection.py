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
# GROSS is the scale of what is grossly wrong: one effect of a hundred.
GROSS, _GROSS_SHARE = 30.0, 0.01
# Scale → weight, of amplitudes of plausible size or grossly wrong.
PLAUSIBLE = {1.0: 1 - _GROSS_SHARE, GROSS: _GROSS_SHARE}
# The same where the plausible size is only a guess: from a tenth to three times it.
ANY_SIZE = dict.fromkeys((1.0, 3.0, 0.3, 0.1), (1 - _GROSS_SHARE) / 4) | {GROSS: _GROSS_SHARE}
# Log Bayes factor that a group must add: 12 to 1, as a name must in the diagnosis.
_LOG_BAYES_FACTOR = 2.5
# A parameter that these views know worse than this many times its plausible size stays at zero: it would
# only borrow from the hand-eye.
UNSEEN = 4.0
# A parameter of an effect of which nobody knows more is there or not.
_EVEN_ODDS = 0.5


def log_evidence(information: Array, vector: Array, precision: Array | None = None, mean: Array | None = None) -> Array:
    """Return (...) log ∫ exp(vᵀθ − ½ θᵀIθ) p(θ) dθ, with a normal prior p of the amplitudes θ (k,).

    It is the log Bayes factor of the amplitudes over θ = 0: ½(qᵀ(I + P)⁻¹q − mᵀPm − log det(I + P) + log det P), with
    the prior's precision P and mean m, and q = v + Pm.

    Args:
        information: (..., k, k) I of the log likelihood.
        vector: (..., k) v of the log likelihood.
        precision: (k, k) inverse covariance of the prior; None: unit matrix.
        mean: (k,) of the prior; None: zero.
    """
    # In units of the prior: amplitudes may differ by powers of ten.
    P, unit = equilibrated(np.eye(vector.shape[-1]) if precision is None else precision)
    m = np.zeros(len(unit)) if mean is None else mean / unit
    posterior = information * np.outer(unit, unit) + P
    q = vector * unit + P @ m
    square = np.sum(q * np.linalg.solve(posterior, q[..., None])[..., 0], axis=-1) - m @ P @ m
    return 0.5 * (square - np.linalg.slogdet(posterior)[1] + np.linalg.slogdet(P)[1])


def log_evidence_at_scales(information: Array, vector: Array, scales: dict[float, float]) -> Array:
    """Return (s,) log ∫ exp(vᵀθ − ½ θᵀIθ) p(θ) dθ, for priors p of mean 0 and standard deviations `scales`.

    Args:
        information: (k, k) I of the log likelihood, θ in units of plausible size.
        vector: (k,) v of the log likelihood.
        scales: standard deviations; the weights of the mixture, its values, are not used here.
    """
    logs, k = np.zeros(len(scales)), len(vector)
    for i, scale in enumerate(scales if k else ()):
        # Precision of the posterior, with amplitudes in units of the prior's standard deviation.
        posterior = scale**2 * information
        posterior.flat[:: k + 1] += 1.0
        L, _ = dpotrf(posterior, lower=1, clean=0)
        white = dtrtrs(L, scale * vector, lower=1)[0]
        logs[i] = 0.5 * float(white @ white) - float(np.log(L.diagonal()).sum())
    return logs


def log_mixture(logs: Array, scales: dict[float, float]) -> float:
    """Return the log evidence under a mixture of priors, from that under each of its scales, (s,).

    Args:
        scales: standard deviation → weight of the mixture, in the order of `logs`.
    """
    return float(np.logaddexp.reduce(logs + np.log(list(scales.values()))))


def log_mean_exp(logs: Sequence[float] | Array) -> Array:
    """Return the log (…) of the mean over n factors, from their logs (n, …): Bayes factors of which one is meant."""
    return logsumexp(logs, axis=0) - np.log(len(logs))


@dataclass(frozen=True)
class WhitenedData:
    """The linear model z = base·b + further·p + e in units of its scatter: cov e = 1."""

    base: Array  # (N, a) columns of what is fitted in any case: hand-eye, landmarks
    further: Array  # (N, P) columns per unit of the effects' parameters p
    z: Array  # (N,) observations less the prediction without effects


def select_supported(
    whitened: WhitenedData, sizes: Array, groups: Sequence[Sequence[int]], effects: Sequence[int]
) -> Mask:
    """Return a mask (P,) of the parameters to fit: the set of groups with the greatest evidence that was found.

    The better of two searches: forward selection followed by elimination, and elimination from all groups. An effect
    without a chosen group gets its best one, since it was asked for.

    Args:
        sizes: (P,) plausible sizes: standard deviations of the prior.
        groups: of each, the indices of parameters that are fitted together; a group may contain another.
        effects: of each group, the index of its effect.
    """
    G = project_out(whitened.base, whitened.further * sizes)
    y = project_out(whitened.base, whitened.z[:, None])[:, 0]
    M, v = G.T @ G, G.T @ y

    @cache
    def gain_of_parameters(*index: int) -> float:
        """Return the log Bayes factor, nats, of these parameters over none."""
        information, vector = M[np.ix_(index, index)], v[list(index)]
        return log_mixture(log_evidence_at_scales(information, vector, PLAUSIBLE), PLAUSIBLE)

    def gain(chosen: Sequence[int]) -> float:
        """Return the log Bayes factor, nats, of all parameters of these groups over none."""
        return gain_of_parameters(*sorted({i for k in chosen for i in groups[k]}))

    all_groups = list(range(len(groups)))
    # Two joints may explain together what neither does alone: adding one by one never meets them, leaving out does.
    forward = eliminate_backward(gain, select_forward(gain, all_groups))
    chosen = max((forward, eliminate_backward(gain, all_groups)), key=gain)
    seen = np.linalg.norm(G, axis=0) >= 1 / UNSEEN
    for effect in dict.fromkeys(effects):
        if not any(effects[k] == effect for k in chosen):
            of_effect = [k for k in all_groups if effects[k] == effect]
            # A group of which the views show something goes before one that would only borrow from the hand-eye.
            chosen.append(max(of_effect, key=lambda k: (seen[groups[k]].any(), gain([*chosen, k]))))
    selected = np.zeros(len(sizes), bool)
    selected[[i for k in chosen for i in groups[k]]] = True
    return selected


def omitted_rms(whitened: WhitenedData, sizes: Array, fitted: Mask, effects: Indices) -> Array:
    """Return the rms (P,) that parameters left out of the fit may have, in their own units; 0 for those in the fit.

    A parameter is present with probability π; then it has the mean μ and the sigma σ that the views give it. Its mean
    square is π(μ² + σ²) (Bayesian model averaging; Hoeting et al. 1999).

    The prior of π and of the size comes from the other parameters of the same effect, each weighted by how well the
    views show it. The share of those present, with one more at even odds, is the prior of π (Jeffreys). Their mean
    square, with one more of plausible size, is the prior's variance (credibility; Bühlmann 1967, ASTIN Bulletin 4:199).
    So, where one joint of five is off, an unobserved sixth is likelier right than off; where all five are, it is off.

    Args:
        whitened: the model with all parameters.
        sizes: (P,) plausible sizes.
        fitted: (P,) True for parameters in the fit.
        effects: (P,) index of the effect that each belongs to.
    """
    information, vector = _marginal_information(whitened, sizes, fitted)
    # How well the views show each, from 0 to 1: the weight of what it says of others.
    seen = information / (1 + information)
    # First under the usual prior, then under the one that the others of the same effect give.
    log_odds, square = _inclusion_odds(information, vector)
    others = np.equal.outer(effects, effects) & ~np.eye(len(sizes), dtype=bool)
    present = seen * expit(log_odds)
    share = (_EVEN_ODDS + others @ present) / (1 + others @ seen)
    scale = np.sqrt((1 + others @ (present * square)) / (1 + others @ present))
    log_odds, square = _inclusion_odds(scale**2 * information, scale * vector)
    rms = sizes * scale * np.sqrt(expit(logit(share) + log_odds) * square)
    return np.where(fitted, 0.0, rms)


def _inclusion_odds(precision: Array, vector: Array) -> tuple[Array, Array]:
    """Return log odds (P,) that parameters are present, at even prior odds, and their mean squares (P,) if they are.

    Each by itself, with a standard normal prior.

    Args:
        precision: (P,) information I of each in the log likelihood vθ − ½Iθ².
        vector: (P,) v.
    """
    mean, variance = vector / (1 + precision), 1 / (1 + precision)
    return 0.5 * vector * mean - 0.5 * np.log1p(precision), mean**2 + variance


def _marginal_information(whitened: WhitenedData, sizes: Array, fitted: Mask) -> tuple[Array, Array]:
    """Return information I (P,) on each parameter, all others in the fit being free, and I times its estimate (P,).

    Parameters count in units of their plausible sizes.

    Args:
        sizes: (P,) plausible sizes.
        fitted: (P,) True for parameters in the fit.
    """

    def beside(others: Mask, of: Mask) -> tuple[Array, Array]:
        """Return I and v of the parameters `of`, each alone beside the base and the parameters `others`."""
        base = np.hstack([whitened.base, whitened.further[:, others]])
        G = project_out(base, whitened.further[:, of] * sizes[of])
        y = project_out(base, whitened.z[:, None])[:, 0]
        return np.einsum("np,np->p", G, G), G.T @ y

    information, vector = np.zeros(len(sizes)), np.zeros(len(sizes))
    information[~fitted], vector[~fitted] = beside(fitted, ~fitted)
    for p in np.flatnonzero(fitted):
        only = np.arange(len(sizes)) == p
        information[only], vector[only] = beside(fitted & ~only, only)
    return information, vector


def select_forward(
    gain: Callable[[Sequence[int]], float], groups: Sequence[int], begin: Sequence[int] = (), most: int | None = None
) -> list[int]:
    """Return groups chosen one by one, that of the largest gain next, until none adds `_LOG_BAYES_FACTOR`.

    Args:
        gain: log Bayes factor, nats, of a list of groups together over none.
        groups: indices of the groups to choose from.
        begin: groups that are chosen from the start.
        most: largest number of groups, those of `begin` included; None: no limit.
    """
    chosen = list(begin)
    while (left := [k for k in groups if k not in chosen]) and (most is None or len(chosen) < most):
        best = max(left, key=lambda k: gain([*chosen, k]))
        if gain([*chosen, best]) - gain(chosen) < _LOG_BAYES_FACTOR:
            break
        chosen.append(best)
    return chosen


def eliminate_backward(gain: Callable[[Sequence[int]], float], groups: Sequence[int]) -> list[int]:
    """Return the groups that remain when the least important ones are left out one by one.

    It ends once leaving out any one would lose `_LOG_BAYES_FACTOR` or more.

    Args:
        gain: log Bayes factor, nats, of a list of groups together over none.
        groups: indices of the groups to begin with.
    """
    chosen = list(groups)
    while chosen:
        rests = [[other for other in chosen if other != k] for k in chosen]
        rest = max(rests, key=gain)
        if gain(chosen) - gain(rest) >= _LOG_BAYES_FACTOR:
            break
        chosen = rest
    return chosen
