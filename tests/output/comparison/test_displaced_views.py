"""What whole views follow, of flanges that are off by amounts that are known in closed form."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.output.comparison.displaced_views import FOLLOWS, VIEW_ORDER, also_clear, equally_clear, followed_covariates
from stitch.output.comparison.residual_tables import compare_targets, comparison_document
from tests.diagnosis.freed_blade import freed_blade

VIEWS, START = 30, 12


def followed(joints=None, flange=None, seed=4):
    """Of targets on a flange that errs so: joints (V, 6) rad, and the flange in its own frame (V, 6) rad and mm."""
    nothing = np.zeros((VIEWS, 6))
    errors = (nothing if joints is None else joints, nothing if flange is None else flange)
    return compare_targets(run(labelled_cell(seed, views=VIEWS, errors=errors)[0])).followed


@pytest.fixture(scope="module")
def blade():
    return freed_blade(3, 14)


def test_scans_that_only_scatter_follow_nothing(blade):
    found = followed_covariates(blade.seen(blade.measurement.T_base_flange))
    assert found[0].p_value > FOLLOWS and not equally_clear(found) and not also_clear(found)


def test_targets_that_only_scatter_follow_nothing():
    """Two sessions at a hundredth each."""
    assert not any(equally_clear(followed(seed=seed)) for seed in range(2))


def test_a_step_is_told_with_its_view_its_size_and_its_sign():
    """0.3 mm against y of the flange: the views move along it, against the targets that the flange carries."""
    flange = np.zeros((VIEWS, 6))
    flange[START:, 4] = -0.3
    first = followed(flange=flange)[0]
    assert first.covariate == VIEW_ORDER and first.shape == f"a step at view v{START}" and first.p_value < 1e-12
    assert first.direction[1] > 0.98
    assert first.mean[1] - first.mean[0] == pytest.approx(0.3, abs=0.03)
    assert first.at == pytest.approx([(START - 1) / 2, (START + VIEWS - 1) / 2])


def test_a_joint_is_told_from_time_and_from_the_others():
    session, *_ = labelled_cell(4, views=VIEWS)
    joints = np.zeros((VIEWS, 6))
    joints[:, 4] = 5e-4 * np.sin(session.joints[:, 4])
    found = followed(joints=joints)
    assert found[0].covariate == "j5" and found[0].shape == "a wave, once a turn"
    assert not also_clear(found)


def test_two_things_are_both_told():
    """A step of the flange and a joint's eccentricity: the second stands beside the first."""
    session, *_ = labelled_cell(4, views=VIEWS)
    joints, flange = np.zeros((VIEWS, 6)), np.zeros((VIEWS, 6))
    joints[:, 2] = 1e-3 * np.sin(session.joints[:, 2])
    flange[START:, 4] = 0.3
    found = followed(joints=joints, flange=flange)
    assert found[0].p_beside == 1
    assert {VIEW_ORDER, "j3"} <= {found[0].covariate} | {own.covariate for own in also_clear(found)}


def test_the_document_holds_it_as_lists():
    found = compare_targets(run(labelled_cell(4, views=VIEWS)[0]))
    rows = comparison_document(found)["follows"]
    assert [row["covariate"] for row in rows] == [own.covariate for own in found.followed]
    assert len(rows[0]["direction"]) == 3 and len(rows[0]["at"]) == len(rows[0]["mean"]) == len(rows[0]["sigma"])
