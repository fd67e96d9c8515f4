"""Rows in few numbers: every likelihood is that of all rows, and so is a fit of them."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.regime import regime_of
from stitch.model.model import Model
from stitch.numerics.least_squares import BlockLeastSquares, column_space
from stitch.numerics.reml import at_variances, whitener
from stitch.observations.targets.target_model import target_model
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of

EXACT = 1e-9
VARIANCES = np.array([4e-9, 3e-4, 1.3])


def all_rows(linear):
    """The rows (B, m) of a linear model with all unknowns free, before any reduction."""
    rows = linear.observation.rows
    extra = rows.columns_in_use(linear.measurement, linear.model)
    return rows, rows.mixed_model(np.concatenate([rows.hand_eye, rows.landmarks, extra], axis=2))


def built(targets, views, seen):
    """A linear model of an arm whose views show some share of the targets."""
    rng = np.random.default_rng(targets)
    places = rng.uniform(-120, 120, (targets, 3)) + np.array([0, 0, 100])
    session, T_mount, *_ = labelled_cell(targets, views=views, targets=places)
    views = []
    for view in session.views:
        shown = rng.permutation(targets) < max(round(seen * targets), 1)
        s = view.sighting
        names = tuple(name for name, there in zip(s.targets, shown, strict=True) if there)
        sigma = s.sigma[shown] * rng.uniform(0.5, 2, shown.sum()) if seen < 1 else s.sigma[shown]
        views.append(replace(view, sighting=replace(s, targets=names, points=s.points[shown], sigma=sigma)))
    session = replace(session, views=tuple(views))
    return target_model(measurement_of(session, prepare_capture(session)), Model(T_mount), None)


@pytest.mark.parametrize(("targets", "views", "seen"), [(1, 12, 1.0), (3, 14, 1.0), (9, 60, 1.0), (8, 12, 0.6)])
def test_likelihood_and_information_of_every_effect_are_those_of_all_rows(targets, views, seen):
    linear = built(targets, views, seen)
    rows, whole = all_rows(linear)
    few = at_variances(linear.mixed, VARIANCES).deviance
    every = at_variances(whole, VARIANCES).deviance
    other = VARIANCES * [2.0, 0.5, 1.7]
    # Both but for a constant.
    gained = at_variances(linear.mixed, other).deviance - few
    assert gained == pytest.approx(at_variances(whole, other).deviance - every, rel=1e-7)
    half = whitener(whole, VARIANCES)
    at = replace(linear, null=at_variances(linear.mixed, VARIANCES))
    basis = column_space((half @ whole.A).reshape(whole.z.size, -1))
    z = (half @ whole.z[..., None]).reshape(-1)
    asked = 0
    for candidate in candidates_of(linear)[0]:
        for form in candidate.forms[:1]:
            (columns,) = rows.effect_columns(linear.measurement, linear.model, [form.term])
            white = (half @ (columns * form.term.typical)).reshape(whole.z.size, -1)[:, form.keep]
            white = white - basis @ (basis.T @ white)
            of_few = at.residual(form.columns * form.sizes)
            size = max(float(np.linalg.norm(white) ** 2), 1.0)
            np.testing.assert_allclose(of_few.T @ of_few, white.T @ white, atol=100 * EXACT * size)
            seen_by_all = white.T @ (z - basis @ (basis.T @ z))
            scale = size**0.5 * np.linalg.norm(z)
            np.testing.assert_allclose(of_few.T @ at.white_residual, seen_by_all, atol=100 * EXACT * scale)
            asked += 1
    assert asked > 10 and regime_of(linear).prior is False


@pytest.mark.parametrize(("targets", "views", "seen"), [(3, 14, 1.0), (9, 20, 1.0), (8, 12, 0.6)])
def test_a_trial_without_some_views_is_that_of_all_rows(targets, views, seen):
    linear = built(targets, views, seen)
    rows, whole = all_rows(linear)
    candidate = next(c for c in candidates_of(linear)[0] if c.name == "joint_offset")
    form = candidate.forms[0]
    (columns,) = rows.effect_columns(linear.measurement, linear.model, [form.term])
    X = np.concatenate([whole.A, columns[..., form.keep]], axis=2)
    covariance = whole.covariance(linear.null.variances)
    blocks = BlockLeastSquares(whole.z, X, covariance, np.zeros(X.shape[2]), np.zeros(X.shape[2]))
    trial = linear.trial(np.hstack([linear.design, form.response]))
    fold = np.array([2, 5])
    by_all, by_few = blocks.solve(fold), trial.solve(fold)
    rest = whole.z - X @ by_all
    squares = np.sum(rest[: len(rows.lever)] ** 2 * rows.used, axis=1)
    np.testing.assert_allclose(trial.squares(by_few), squares, rtol=1e-6)
    white = whitener(whole, linear.null.variances)[fold] @ (rest[fold] * rows.used[fold])[..., None]
    assert trial.scatter(fold, by_few) == pytest.approx(float(np.sum(white**2)), rel=1e-6)
