"""What is known of all effects together, against the matrix that was put in."""

from dataclasses import replace

import numpy as np
import pytest

from stitch.effects import EFFECTS
from stitch.model.model import EffectsCovariance, Term, covariance_of_fit, kept_root
from stitch.model.model_toml import ModelFile, convert_unit


@pytest.fixture
def term():
    parameters = EFFECTS["joint_offset"].parameters(6, (), "mm")
    return Term(EFFECTS["joint_offset"], parameters)


@pytest.fixture
def matrix():
    half = np.random.default_rng(0).normal(size=(3, 3)) * [1e-5, 2e-4, 3e-5]
    return half.T @ half


def known(term, matrix, names):
    sigma = dict(zip(names, np.sqrt(np.diag(matrix)), strict=True))
    return replace(
        term, parameters=tuple(replace(p, sigma=sigma.get(p.name, np.nan)) for p in term.parameters)
    ), EffectsCovariance(tuple(f"joint_offset.{n}" for n in names), matrix)


def test_the_root_squared_is_the_matrix_wherever_its_parameters_stand(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    L = covariance.root([own])
    whole = np.zeros((6, 6))
    at = [3, 1, 2]
    whole[np.ix_(at, at)] = matrix
    np.testing.assert_allclose(L @ L.T, whole, rtol=1e-9, atol=1e-22)


def test_a_sigma_that_was_edited_counts_alone(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    edited = tuple(replace(p, sigma=7e-4) if p.name == "d2" else p for p in own.parameters)
    L = covariance.root([replace(own, parameters=edited)])
    whole = L @ L.T
    assert whole[1, 1] == pytest.approx(49e-8) and not whole[1, [0, 2, 3, 4, 5]].any()
    np.testing.assert_allclose(whole[np.ix_([3, 2], [3, 2])], matrix[np.ix_([0, 2], [0, 2])], rtol=1e-9)


def test_only_what_another_run_brought_is_kept_and_it_stays_beside_what_is_fitted(term, matrix):
    own, covariance = known(term, matrix, ["d4", "d2", "d3"])
    assert kept_root([own], covariance).shape == (6, 0)
    own = replace(own, parameters=tuple(replace(p, kept=p.name in ("d2", "d3", "d4")) for p in own.parameters))
    root = kept_root([own], covariance)
    fitted = np.array([False, False, False, False, True, False])
    both = covariance_of_fit([own], fitted, np.array([[4e-10]]), root)
    assert both.names == tuple(f"joint_offset.d{i}" for i in (2, 3, 4, 5))
    at = [both.names.index(f"joint_offset.{n}") for n in ("d4", "d2", "d3")]
    np.testing.assert_allclose(both.matrix[np.ix_(at, at)], matrix, rtol=1e-9, atol=1e-22)
    assert both.matrix[3, 3] == pytest.approx(4e-10)


def test_lengths_of_the_matrix_follow_the_unit():
    rows = EFFECTS["link_geometry"].parameters(2, (), "mm")
    lengths, angles = (next(p for p in rows if p.unit == unit) for unit in ("mm", "rad"))
    names = tuple(f"link_geometry.{p.name}" for p in (lengths, angles))
    file = ModelFile("mm", "eye_to_hand", np.eye(4), np.eye(4), np.eye(6), {"link_geometry": {p.name: p for p in rows}})
    file = replace(file, effects_covariance=EffectsCovariance(names, np.array([[4.0, 0.2], [0.2, 1.0]])))
    np.testing.assert_allclose(convert_unit(file, "m").effects_covariance.matrix, [[4e-6, 2e-4], [2e-4, 1.0]])
