"""Effects of every kind of parameters, alone and in pairs, at every place: none ends a diagnosis or a fit."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.candidates import candidate_of
from stitch.diagnosis.diagnose import linear_model_of
from stitch.diagnosis.score import score
from stitch.diagnosis.sensitivity import detectable_sizes
from stitch.effects import (
    EFFECTS,
    effect,
    event,
    number,
    offset,
    per_joint,
    per_moment,
    per_torque,
    temperature,
    twist,
    vector,
)
from stitch.effects.contract import PLACES, parameters_in, separable_groups
from stitch.effects.user_file import _KINDS
from stitch.errors import InputError

VIEWS = 12
KINDS = {
    "number": number("mm", 0.1, 10.0),
    "gridded": number("s", 60.0, 1e5, grid=(30.0, 300.0)),
    "event": event(),
    "temperature": temperature(),
    "vector": vector("rad", 1e-4, 0.01),
    "axes": vector("mm", 0.1, 1.0, axes=("_xx", "_yz")),
    "offset": offset("mm", 0.1, 1.0),
    "joint": per_joint("rad", 1e-4, 0.01),
    "torque": per_torque("rad/(N m)", 1e-6, 1e-3),
    "moment": per_moment("rad/(N m)", 1e-6, 1e-3),
    "twist": twist("", 1e-4, 0.1),
}
ALONE_OR_PAIRED = [
    kinds for n in (1, 2) for kinds in combinations(KINDS, n) if not all(KINDS[kind].grid for kind in kinds)
]


@cache
def session():
    """Labelled points on an arm, with times, a temperature and loads."""
    rng = np.random.default_rng(3)
    cell = labelled_cell(6, VIEWS)[0]
    warm = 20 + np.cumsum(rng.uniform(0, 1, VIEWS))
    rows = [
        replace(view, time_s=60.0 * v, covariates={"ambient_c": warm[v], "payload_kg": 2.0 + v % 3})
        for v, view in enumerate(cell.views)
    ]
    return replace(cell, views=tuple(rows))


@cache
def linear():
    return linear_model_of(run(session()))


def registered(place, kinds):
    """An effect that moves something by all of its parameters, each by its plausible size about as much."""

    def share(given):
        return sum(
            float(np.sum(np.sin(np.arange(1, 1 + np.size(given[k])) * np.atleast_1d(given[k]) / KINDS[k].typical)))
            for k in kinds
        )

    def course(views, given):
        return np.sin(views.number + 1.0) * 1e-4 * share(given)

    def body(views, **given):
        """a twist of all of them"""
        return np.outer(course(views, given), [1, 1, 1, 300, 300, 300])

    def arm(joints, views, **given):
        """joints by all of them"""
        return joints + np.outer(course(views, given), np.ones(joints.shape[1]))

    def links(of_arm, views, **given):
        """links by all of them"""
        return replace(of_arm, da=of_arm.da + 0.1 * share(given))

    def points(given_points, view, **given):
        """points by all of them"""
        return given_points + 0.05 * share(given) * np.sin(view.index + 1.0)

    function = {"robot": arm, "links": links, "sensor": points, "shape": points}.get(place, body)
    function.__name__ = "of_every_kind"
    effect(place, needs=("joints",), **{kind: KINDS[kind] for kind in kinds})(function)
    return EFFECTS.pop("of_every_kind")


def test_every_kind_is_among_those_that_are_tried():
    assert {spec.kind for spec in KINDS.values()} == set(_KINDS)


# External axes have kinds of their own, and tests beside them.
OWN_PLACES = [place for place in PLACES if place != "axis"]


@pytest.mark.parametrize(
    ("place", "most"),
    [(place, 1 + (place == "robot")) for place in OWN_PLACES]
    + [pytest.param(place, 2, marks=pytest.mark.slow) for place in OWN_PLACES if place != "robot"],
)
def test_no_kind_and_no_pair_of_kinds_ends_a_diagnosis(place, most):
    model = linear()
    for kinds in (kinds for kinds in ALONE_OR_PAIRED if len(kinds) <= most):
        own = registered(place, kinds)
        names = [p.name for p in parameters_in(model.measurement, own) if not p.grid]
        candidate = candidate_of(model, own)
        assert all(form.keep.any() for form in candidate.forms), kinds
        assert np.isfinite(score(model, candidate).log_bayes_factor), kinds
        assert set(detectable_sizes(model, candidate, 10)) == set(names), kinds
        held = [i for i, p in enumerate(candidate.parameters) if p.grid]
        groups = separable_groups(own, candidate.parameters)
        assert {i for group in groups for i in group} >= set(range(len(candidate.parameters))) - set(held), kinds
        assert all(set(group) - set(held) for group in groups), kinds


@pytest.mark.parametrize("kinds", [("event",), ("gridded", "temperature"), ()])
def test_an_effect_of_which_nothing_is_fitted_is_refused(kinds):
    with pytest.raises(InputError, match="has nothing to fit"):
        registered("mount", kinds)


@pytest.mark.parametrize(
    "kinds", [("joint", "event"), ("twist", "temperature"), ("torque", "gridded"), ("joint", "twist")]
)
def test_an_effect_of_two_kinds_is_fitted(kinds):
    EFFECTS["of_every_kind"] = registered("robot", kinds)
    try:
        (term,) = run(session(), effects=["of_every_kind"]).terms
    finally:
        del EFFECTS["of_every_kind"]
    assert any(p.fitted for p in term.parameters) and all(np.isfinite(term.values))
