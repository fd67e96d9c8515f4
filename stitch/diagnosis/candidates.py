"""All effects that could be missing, each with the forms in which it may appear."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from stitch.effects.contract import EFFECTS, Effect, Parameter
from stitch.effects.empirical import empirical_effects
from stitch.effects.groups import by_joint, one_by_one, without_offset
from stitch.frames import Array
from stitch.measurement.measurement import Term
from stitch.observations.evidence import ViewEvidence
from stitch.observations.surfaces.point_effects import PointGram


@dataclass(frozen=True)
class Form:
    """One form of an effect: all its parameters, those of one joint, or all but an offset; one value of each grid."""

    term: Term  # at zero, gridded parameters at their value
    keep: Array  # (P,) bool: parameters that are free in this form
    twists: Array  # (·, p) of the free ones: the response of the views
    columns: Array  # (n, p) of the free ones in the channel
    sizes: Array  # (p,) plausible sizes


@dataclass(frozen=True)
class Candidate:
    """An effect with its forms; the first one has all parameters free."""

    effect: Effect
    parameters: tuple[Parameter, ...]
    forms: tuple[Form, ...]
    twists: Array  # (·, P) of the first form
    points: slice | None  # of the first form's columns in the PointGram

    @property
    def name(self) -> str:
        return self.effect.name


def candidates_of(evidence: ViewEvidence) -> tuple[list[Candidate], PointGram | None, dict[str, tuple[str, ...]]]:
    """Physical, user and empirical effects that are not in the model, and what each unavailable one lacks."""
    measurement = evidence.measurement
    used = {term.effect.name for term in evidence.terms}
    library = [e for e in EFFECTS.values() if e.name not in used]
    missing = {e.name: measurement.lacks(e) for e in library if measurement.lacks(e)}
    effects = [e for e in library if e.name not in missing] + empirical_effects(measurement.views)
    terms, owner = [], []
    for k, effect in enumerate(effects):
        for term in _grid_terms(effect, measurement.parameters(effect)):
            terms.append(term)
            owner.append(k)
    columns, sums, where = evidence.columns(terms)
    out = []
    for k, effect in enumerate(effects):
        own = [i for i, o in enumerate(owner) if o == k]
        parameters = measurement.parameters(effect)
        forms = [f for i in own for f in _forms(evidence, terms[i], parameters, columns[i])]
        if forms:
            out.append(Candidate(effect, parameters, tuple(forms), columns[own[0]], where[own[0]]))
    return out, sums, missing


def candidate_of(evidence: ViewEvidence, effect: Effect) -> Candidate | None:
    """One effect as a candidate."""
    parameters = evidence.measurement.parameters(effect)
    terms = _grid_terms(effect, parameters)
    columns, _, where = evidence.columns(terms)
    forms = [f for term, c in zip(terms, columns, strict=True) for f in _forms(evidence, term, parameters, c)]
    return Candidate(effect, parameters, tuple(forms), columns[0], where[0]) if forms else None


def as_fitted(evidence: ViewEvidence, term: Term) -> Candidate:
    """An effect with those of its parameters that a fit left in use, as the one form it may have."""
    parameters = evidence.measurement.parameters(term.effect)
    held = np.array([bool(p.grid) for p in parameters])
    zero, keep = replace(term, values=np.where(held, term.values, 0.0)), ~held & (term.values != 0)
    twists = evidence.columns([zero])[0][0]
    sizes = np.array([p.typical for p in parameters])[keep]
    form = Form(zero, keep, twists[:, keep], evidence.in_channel(twists)[:, keep], sizes)
    return Candidate(term.effect, parameters, (form,), twists, None)


def _grid_terms(effect: Effect, parameters: Sequence[Parameter]) -> list[Term]:
    """The effect at zero, once for every combination of its gridded parameters."""
    grids = [p.grid or (0.0,) for p in parameters]
    return [Term(effect, np.array(values)) for values in product(*grids)]


def _forms(evidence: ViewEvidence, term: Term, parameters: Sequence[Parameter], twists: Array) -> list[Form]:
    """All parameters together, then those that can be true alone."""
    free = np.array([not p.grid for p in parameters])
    sizes = np.array([p.typical for p in parameters])
    channel = evidence.in_channel(twists)
    alone = [free & np.isin(np.arange(len(parameters)), g) for g in _groups(term.effect, parameters)]
    keeps = [free, *(keep for keep in alone if (keep != free).any())]
    return [Form(term, keep, twists[:, keep], channel[:, keep], sizes[keep]) for keep in keeps]


def _groups(effect: Effect, parameters: Sequence[Parameter]) -> list[list[int]]:
    """Parameters of one joint, or all but an offset; links in single numbers too."""
    joints = by_joint(effect, parameters) or without_offset(effect, parameters)
    single = effect.place == "links" and len(effect.specs) > 1
    return joints + one_by_one(effect, parameters) if joints and single else joints


def with_values(form: Form, values: Array) -> Term:
    """The term of a form with fitted values of its free parameters."""
    filled = form.term.values.copy()
    filled[form.keep] = values
    return replace(form.term, values=filled)
