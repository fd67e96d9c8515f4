"""All effects that could be missing, each with the forms in which it may appear."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from stitch.effects.contract import (
    EFFECTS,
    Effect,
    Parameter,
    by_joint,
    is_asked,
    missing_need,
    of_each_scanner,
    separable_groups,
    without_offset,
)
from stitch.effects.empirical import empirical_effects
from stitch.model.model import Term, grid_terms
from stitch.numerics.common_covariance import SelectedColumns
from stitch.numerics.frames import Array, Mask
from stitch.observations.linear_model import LinearModel, PointSums, Response


@dataclass(frozen=True)
class Form:
    """One form of an effect: all its parameters, those of one joint, or all but an offset; one value of each grid."""

    term: Term  # at zero, gridded parameters at their value
    keep: Mask  # (P,) parameters that are free in this form
    whole: Array  # (·, P) response of the observation to all; held once for all forms of a term
    reduced: Array  # (n, P) the same in the reduced observations
    sizes: Array  # (p,) plausible sizes

    @property
    def response(self) -> Array:
        """(·, p) of the observation to the free ones."""
        return SelectedColumns(self.whole, self.keep).columns

    @property
    def columns(self) -> Array:
        """(n, p) of the free ones in the reduced observations."""
        return self.selected.columns

    @property
    def selected(self) -> SelectedColumns:
        """The same, of those whose sums are kept."""
        return SelectedColumns(self.reduced, self.keep)

    @property
    def free(self) -> list[Parameter]:
        """The p parameters that are free."""
        return [p for p, keep in zip(self.term.parameters, self.keep, strict=True) if keep]

    def at(self, values: Array) -> Term:
        """Return the term with fitted values (p,) of the free parameters."""
        filled = self.term.values
        filled[self.keep] = values
        return self.term.at(filled)


@dataclass(frozen=True)
class Candidate:
    """An effect with its forms; the first one has all parameters free."""

    effect: Effect
    forms: tuple[Form, ...]
    points: PointSums | None  # of the first form, where the effect changes points

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.effect.name

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All P parameters at zero."""
        return self.forms[0].term.parameters

    @property
    def forms_by_term(self) -> list[list[Form]]:
        """The forms of each term, one for each value of the effect's grid; they share the response of the term."""
        return [list(forms) for _, forms in groupby(self.forms, key=lambda form: id(form.term))]

    @property
    def empirical(self) -> bool:
        """True for a shape without a cause."""
        return self.effect.tier == "empirical"


def candidates_of(linear: LinearModel, empirical: bool = True) -> tuple[list[Candidate], dict[str, tuple[str, ...]]]:
    """Return all effects that could be missing in the model as candidates, and what unavailable effects lack.

    Args:
        empirical: include shapes without a physical cause.

    Returns:
        Candidates; and by name of an effect that cannot be tested, the data that it needs.
    """
    in_use = [term.name for term in linear.model.terms]
    # Effects that cannot arise here, as of external axes where there are none, are neither tried nor reported.
    views = linear.measurement.views
    library = of_each_scanner(views, EFFECTS.values())
    library = [e for e in library if e.name not in in_use and is_asked(linear.measurement, e)]
    missing = {e.name: needs for e in library if (needs := missing_need(linear.measurement, e))}
    effects = [e for e in library if e.name not in missing]
    shapes = of_each_scanner(views, empirical_effects(views)) if empirical else []
    effects += [e for e in shapes if not missing_need(linear.measurement, e)]
    # A term for each value of an effect's grid; all responses are computed in one pass over the points.
    terms_of = [grid_terms(linear.measurement, effect) for effect in effects]
    responses = iter(linear.responses([term for terms in terms_of for term in terms]))
    tried = [_build_candidate(linear, terms, [next(responses) for _ in terms]) for terms in terms_of]
    return [c for c in tried if c is not None], missing


def candidate_of(linear: LinearModel, effect: Effect) -> Candidate | None:
    """Return one effect as a candidate; None if it has no parameters here."""
    terms = grid_terms(linear.measurement, effect)
    return _build_candidate(linear, terms, linear.responses(terms))


def candidate_as_fitted(linear: LinearModel, term: Term) -> Candidate:
    """Return an effect with those of its parameters that a fit left in use, as the one form it may have.

    Gridded parameters, time constants and times of events, keep their values; a parameter at 0 was not fitted.
    """
    zero = term.at(np.where(term.gridded, term.values, 0.0))
    keep = ~term.gridded & (term.values != 0)
    response = linear.responses([zero])[0].columns
    form = Form(zero, keep, response, linear.reduce(response), term.typical[keep])
    return Candidate(term.effect, (form,), None)


def free_masks(term: Term) -> list[Mask]:
    """Return a mask (P,) of free parameters for each form of an effect: first all of them, then parts of them.

    Parts are tried since few parameters explain more credibly than many. They are the parameters of one joint, or all
    without a constant offset; of links also each alone, and of empirical shapes of the sensor each alone. Gridded
    parameters are never free. Parts that are empty, or equal to the whole, are left out.
    """
    effect, parameters = term.effect, term.parameters
    if effect.tier == "empirical" and effect.place == "sensor":
        groups = separable_groups(effect, parameters)
    else:
        groups = by_joint(effect, parameters) or without_offset(effect, parameters)
        if groups and effect.place == "links" and len(effect.specs) > 1:
            groups = groups + separable_groups(effect, parameters)
    free = ~term.gridded
    alone = [free & np.isin(np.arange(len(free)), group) for group in groups]
    return [keep for keep in (free, *(keep for keep in alone if (keep != free).any())) if keep.any()]


def _build_candidate(linear: LinearModel, terms: Sequence[Term], responses: Sequence[Response]) -> Candidate | None:
    """Return one effect as a candidate with all its forms; None where it has no free parameter.

    Args:
        terms: of the effect, one for each value of its grid.
        responses: change of the observation per unit of each parameter, one for each term.
    """
    forms = list[Form]()
    for term, response in zip(terms, responses, strict=True):
        reduced = linear.reduce(response.columns)
        forms += [Form(term, keep, response.columns, reduced, term.typical[keep]) for keep in free_masks(term)]
    if not forms:
        return None
    return Candidate(terms[0].effect, tuple(forms), responses[0].points)
