"""What several sessions of one arm decide together: which of its errors is missing, where each alone cannot tell.

Over one sweep of two joints a gear that runs out of true, gravity and a fixture that droops are one curve. Under
another load gravity's part grows and the gear's does not. So the numbers of an effect of the arm are the same in all
sessions, and its evidence is that of the sums of what the sessions say of them. Held against it: that every session
has numbers of its own, of another effect or of a law of the dictionary, and errors without a name. What begins at some
view, and time constants, are a session's own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from stitch.diagnosis import thresholds as limits
from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.law_ranking import rank_laws
from stitch.diagnosis.ranking import rank_all
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.score import Score, form_weights
from stitch.diagnosis.sentences import odds_text
from stitch.diagnosis.systematic_laws import dictionary_of, law_of
from stitch.diagnosis.unmodelled_time_effects import least_log_bayes_factor
from stitch.diagnosis.verdict import Verdict
from stitch.effects.contract import Parameter
from stitch.model.model import ARM_PLACES
from stitch.numerics.frames import Array
from stitch.numerics.parameter_selection import log_evidence_at_scales, log_mixture
from stitch.numerics.reml import at_variances
from stitch.observations.linear_model import LinearModel

# Parameters of a name that are told.
_LISTED = 3


@dataclass(frozen=True, eq=False)
class Shared:
    """An effect of the arm with the same numbers in all sessions, by its likeliest form."""

    name: str
    log_bayes_factor: float
    log_posterior: float  # not normalised
    parameters: tuple[Parameter, ...] = ()  # that are free, with values and sigmas


@dataclass(frozen=True, eq=False)
class Together:
    """What sessions of one arm decide together."""

    verdict: Verdict  # missing_effect, cannot_tell, or unknown_effect where something else does as well
    effects: tuple[str, ...]  # the name, or the group that the sessions do not tell apart
    candidates: tuple[Shared, ...]  # likeliest first
    otherwise: str  # the likeliest of what each session has numbers of its own of
    log_odds_otherwise: float  # of the likeliest candidate over that

    @property
    def log_odds(self) -> float:
        """Log odds of the likeliest candidate over the next, or over nothing being missing."""
        first, *others = self.candidates
        return first.log_posterior - max([float(np.log(limits.PRIOR_NOTHING)), *(c.log_posterior for c in others)])


def decide_together(linears: Sequence[LinearModel]) -> Together:
    """Return which effect of their common arm several sessions show.

    A name needs odds of 20 to 1 over each alternative: nothing missing, another effect or law with separate values in
    every session, and a smooth error without a name. Effects within 20 to 1 of the best form a group.

    Args:
        linears: the sessions, each linearised about a model without the effect.
    """
    tried = [candidates_of(linear, empirical=False)[0] for linear in linears]
    ranked = [rank_all(linear, candidates)[0] for linear, candidates in zip(linears, tried, strict=True)]
    by_name = [{r.name: r for r in of_session} for of_session in ranked]
    common = [name for name in by_name[0] if all(name in of_session for of_session in by_name)]
    names = [name for name in common if any(of_session[name].score.observable for of_session in by_name)]
    scores = {name: [of_session[name].score for of_session in by_name] for name in names}
    otherwise = _each_its_own(linears, tried, scores)
    shared = [
        _shared(linears, of_effect, len(names))
        for of_effect in scores.values()
        # Not an effect of the part or of the scanner, nor one that begins at some view or has a time constant.
        if of_effect[0].candidate.effect.place in ARM_PLACES and not of_effect[0].candidate.forms[0].term.gridded.any()
    ]
    # The same effect with separate values in every session is no rival: the name would be the same.
    separately = {s.name: otherwise.pop(s.name) for s in shared}
    shared = [
        s if np.isinf(s.log_posterior) else replace(s, log_posterior=max(s.log_posterior, separately[s.name]))
        for s in shared
    ]
    shared.sort(key=lambda s: -s.log_posterior)
    rival = max(otherwise, key=lambda name: otherwise[name], default="")
    least = float(np.log(limits.PRIOR_NOTHING)) + limits.ODDS
    if not shared or shared[0].log_posterior < least:
        alone = any(value > least for value in otherwise.values())
        return Together("unknown_effect" if alone else "adequate", (), tuple(shared), rival, -np.inf)
    best = shared[0]
    odds = best.log_posterior - otherwise.get(rival, -np.inf)
    near = tuple(s.name for s in shared if s.log_posterior > best.log_posterior - limits.ODDS)
    beside = sum(least_log_bayes_factor(*of)[0] for of in zip(linears, scores[best.name], strict=True))
    if odds < limits.ODDS or beside < limits.ODDS:
        return Together("unknown_effect", (), tuple(shared), rival, odds)
    return Together("missing_effect" if len(near) == 1 else "cannot_tell", near, tuple(shared), rival, odds)


def together_sentence(together: Together) -> str:
    """Return the decision of several sessions as a clause, by the verdict, with the odds of a name."""
    match together.verdict:
        case "adequate":
            return "they show no effect of their arm."
        case "unknown_effect":
            return f"no effect of the arm alone is it: {together.otherwise} in each session by itself explains as much."
        case "cannot_tell":
            return f"something of the arm is missing: {' or '.join(together.effects)}. They do not tell which."
    best = together.candidates[0]
    clear = sorted(best.parameters, key=lambda p: -abs(p.value) / p.sigma)[:_LISTED]
    amounts = ", ".join(f"{p.name} = {p.formatted}" for p in clear)
    over = f"the next of the arm {odds_text(together.log_odds)}"
    if together.otherwise:
        over += f", over {together.otherwise} in each session by itself {odds_text(together.log_odds_otherwise)}"
    return f"{best.name} is missing ({amounts}); the odds over {over}."


def together_document(together: Together, sessions: Sequence[str]) -> dict[str, Any]:
    """Return the decision of several sessions as `stitch diagnose --json` prints it."""
    return {
        "format": "stitch-together/1",
        "sessions": list(sessions),
        "verdict": together.verdict,
        "effects": list(together.effects),
        "sentence": together_sentence(together),
        "candidates": [
            {
                "name": c.name,
                "log_posterior": c.log_posterior,
                "parameters": {p.name: {"value": p.value, "sigma": p.sigma, "unit": p.unit} for p in c.parameters},
            }
            for c in together.candidates
        ],
    }


def _statistics(linear: LinearModel, scored: Score) -> tuple[Sequence[Parameter], Array, Array, float]:
    """Return what one session says of an effect: of its p free parameters θ the log likelihood is bᵀθ − ½ θᵀIθ + gain.

    Returns:
        The parameters; I = Xᵀ C⁻¹ X (p, p) and b = Xᵀ C⁻¹ y (p,), C at the variances that the effect leaves there; and
        the gain by these variances over those of the null fit.
    """
    variances = linear.null.variances
    # Variances of a model with other components of scatter are not this one's.
    if scored.variances is not None and len(scored.variances) == len(variances):
        variances = scored.variances
    at = replace(linear, null=at_variances(linear.mixed, variances))
    whole = scored.candidate.forms[0]
    ((information, vector),) = at.information([whole.selected])
    return whole.free, information, vector, 0.5 * (linear.null.deviance - at.null.deviance)


def _shared(linears: Sequence[LinearModel], scores: Sequence[Score], tests: int) -> Shared:
    """Return one effect fitted with common parameters to all sessions, with its log Bayes factor.

    I and b of the sessions (`_statistics`) are added: the estimate is (Σ I)⁻¹ Σ b. So are their gains by variances, to
    the log Bayes factor. An effect whose known load should show and does not has a log Bayes factor of −inf.

    Args:
        scores: of the effect, one a session.
        tests: number of effects among which it was chosen.
    """
    of_sessions = [_statistics(linear, scored) for linear, scored in zip(linears, scores, strict=True)]
    # Sessions may have different free parameters: all of them are numbered.
    parameters = {p.name: p for free, *_ in of_sessions for p in free}
    number = {name: k for k, name in enumerate(parameters)}
    information = np.zeros((len(number), len(number)))
    vector = np.zeros(len(number))
    for free, of_session, vector_of_session, _ in of_sessions:
        rows = [number[p.name] for p in free]
        information[np.ix_(rows, rows)] += of_session
        vector[rows] += vector_of_session
    scales = regime_of(linears[0]).scales
    # The session with the most free parameters has all forms of the effect.
    longest = max((scored.candidate for scored in scores), key=lambda c: len(c.forms[0].free))
    sizes = np.array([p.typical for p in parameters.values()])
    rows_of_forms = [np.array([number[p.name] for p in form.free]) for form in longest.forms]
    log_bayes_factors = []
    for of_form in rows_of_forms:
        in_sizes = information[np.ix_(of_form, of_form)] * np.outer(sizes[of_form], sizes[of_form])
        evidence = log_evidence_at_scales(in_sizes, vector[of_form] * sizes[of_form], scales)
        log_bayes_factors.append(log_mixture(evidence, scales))
    of_all_forms = float(logsumexp(np.array(log_bayes_factors) + np.log(form_weights(longest))))
    log_bayes_factor = of_all_forms + sum(gain for *_, gain in of_sessions)
    best = rows_of_forms[int(np.argmax(log_bayes_factors))]
    free = [list(parameters.values())[k] for k in best]
    fitted = _fitted(free, information[np.ix_(best, best)], vector[best])
    if not _grows_with_load(fitted):
        return Shared(longest.name, -np.inf, -np.inf, fitted)
    prior = float(np.log(limits.PRIOR_PHYSICAL * longest.effect.prior / tests))
    return Shared(longest.name, log_bayes_factor, log_bayes_factor + prior, fitted)


def _fitted(free: Sequence[Parameter], information: Array, vector: Array) -> tuple[Parameter, ...]:
    """Return the free parameters with values and sigmas, by information (p, p) and vector (p,).

    A prior of `FREE_SIZES` plausible sizes keeps parameters that the sessions do not show finite.
    """
    sizes = np.array([p.typical for p in free])
    covariance = np.linalg.inv(information + np.diag((limits.FREE_SIZES * sizes) ** -2.0))
    values, sigmas = covariance @ vector, np.sqrt(np.diag(covariance))
    return tuple(replace(p, value=v, sigma=s) for p, v, s in zip(free, values.tolist(), sigmas.tolist(), strict=True))


def _each_its_own(
    linears: Sequence[LinearModel], tried: Sequence[Sequence[Candidate]], scores: dict[str, list[Score]]
) -> dict[str, float]:
    """Return log posteriors of the alternatives with separate parameters in every session, by name of effect or law.

    Evidence adds over the sessions; the prior counts once. Laws that an effect of the library implies are left out, and
    those that one of the sessions does not have.

    Args:
        tried: candidates of each session.
        scores: of each effect, one a session.
    """
    log_posteriors = dict[str, float]()
    for name, of in scores.items():
        prior = float(np.log(limits.PRIOR_PHYSICAL * of[0].candidate.effect.prior / len(scores)))
        log_posteriors[name] = sum(scored.log_bayes_factor for scored in of) + prior
    laws = []
    for linear, candidates in zip(linears, tried, strict=True):
        dictionary = dictionary_of(linear, candidates)
        likeliest = [r for r in rank_laws(linear, dictionary) if not dictionary.said_by[law_of(r).key]]
        laws.append({law_of(r).key: r for r in likeliest})
    for key, first in laws[0].items():
        if all(key in of_session for of_session in laws):
            others = sum(of_session[key].score.log_bayes_factor for of_session in laws[1:])
            log_posteriors[law_of(first).words] = first.log_posterior + others
    return log_posteriors


def _grows_with_load(parameters: Sequence[Parameter]) -> bool:
    """Return False where a known load should bend the arm visibly, but its coefficients are not above zero.

    A coefficient per known load has no mass in its unit. Those of the links' weight, in units with kg, contain unknown
    masses, and can imitate any curve; so they prove nothing. True also where the load's effect would be too small to
    see, and where no mass is unknown.
    """
    known = [p for p in parameters if not p.unit.startswith("kg ")]
    if len(known) == len(parameters):
        return True
    visible = [p for p in known if 2 * p.sigma < p.typical]
    return not visible or any(p.value > limits.FAINT_SIGMAS * p.sigma for p in known)
