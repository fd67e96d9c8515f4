"""Clouds and labelled points in one session: each weighs by its own sigma, judged by the truth of simulated cells."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from data_synth.fixtures.drilled_plate import measured_plate
from data_synth.fixtures.in_memory import clouds_of, labelled_session_of, points_of
from stitch.api.pipeline import change, run
from stitch.session.session import Sighting

# Minutes of work: `make check` runs it, `make test` does not.
pytestmark = pytest.mark.slow


def error(T, true):
    """(6,) rotation vector and translation from T to the truth, scanner frame."""
    D = np.linalg.inv(T) @ true
    return np.concatenate([Rotation.from_matrix(D[:3, :3]).as_rotvec(), D[:3, 3]])


def in_sigmas(e, covariance):
    return float(e @ np.linalg.solve(covariance, e))


def far(runs, truths):
    """Rms distance of hand-eyes from the truth."""
    return np.sqrt(
        np.mean([error(r.T_mount, T)[3:] @ error(r.T_mount, T)[3:] for r, T in zip(runs, truths, strict=True)])
    )


SEEDS = range(2)


@pytest.fixture(scope="module")
def cells():
    """Sessions of several seeds with their runs: clouds alone, points alone, both."""
    measured = [measured_plate(seed) for seed in SEEDS]
    sessions = [labelled_session_of(m) for m in measured]
    return [m.T_mount for m in measured], sessions, {
        "clouds": [run(clouds_of(s)) for s in sessions],
        "points": [run(points_of(s)) for s in sessions],
        "both": [run(s) for s in sessions],
    }  # fmt: skip


def test_both_know_the_hand_eye_better_than_either_and_say_how_well(cells):
    truths, _, runs = cells
    assert far(runs["both"], truths) < min(far(runs["clouds"], truths), far(runs["points"], truths))
    z = [in_sigmas(error(r.T_mount, T), r.mount_covariance) for r, T in zip(runs["both"], truths, strict=True)]
    # χ² of six degrees of freedom a seed, between its 0.1 % and 99.9 % points.
    assert chi2.ppf(1e-3, 6 * len(z)) < sum(z) < chi2.ppf(0.999, 6 * len(z))


def test_targets_lie_where_they_are_within_their_sigma(cells):
    _, _, runs = cells
    for seed, found in zip(SEEDS, runs["both"], strict=True):
        true, covariance = measured_plate(seed), found.targets.landmarks_covariance
        z = []
        for k, name in enumerate(found.targets.rows.capture.sightings.targets):
            d = found.targets.landmarks.positions[k] - true.targets[name]
            z.append(in_sigmas(d, covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]))
        # The targets of one run share the error of its hand-eye: three degrees of freedom each, judged one by one.
        assert max(z) < chi2.ppf(1 - 1e-3 / len(z) / len(SEEDS), 3)


def test_points_of_huge_sigma_change_nothing(cells):
    _, sessions, runs = cells
    loose = replace(sessions[0], views=tuple(
        replace(v, sighting=v.sighting and replace(v.sighting, sigma=np.full(len(v.sighting.sigma), 1e6)))
        for v in sessions[0].views))  # fmt: skip
    found, alone = run(loose), runs["clouds"][0]
    assert in_sigmas(error(found.T_mount, alone.T_mount), alone.mount_covariance) < 1e-2


def test_clouds_of_huge_noise_leave_the_answer_of_the_points():
    session = labelled_session_of(measured_plate(1, noise=2.0))
    found, alone = run(session), run(points_of(session))
    assert in_sigmas(error(found.T_mount, alone.T_mount), alone.mount_covariance) < chi2.ppf(0.999, 6)


def test_points_weigh_by_their_own_sigma():
    measured = [measured_plate(seed, sigma=0.3) for seed in range(1)]
    truths = [m.T_mount for m in measured]
    honest, boasting = ([run(labelled_session_of(m, stated)) for m in measured] for stated in (0.3, 0.003))
    assert far(honest, truths) < far(boasting, truths)


def test_a_wrong_point_is_found_and_listed_and_pulls_nothing():
    session = labelled_session_of(measured_plate(2))
    views = list(session.views)
    s = views[4].sighting
    wrong, right = s.points.copy(), np.arange(len(s.targets)) != 3
    wrong[3] += [0.6, -0.8, 0.3]
    views[4] = replace(views[4], sighting=replace(s, points=wrong))
    found = run(replace(session, views=tuple(views)))
    assert [(o.view, o.target) for o in found.outliers] == [(4, s.targets[3])]
    assert any(f"{s.targets[3]} in view v004" in note for note in found.notes)
    named = tuple(np.array(s.targets)[right])
    views[4] = replace(views[4], sighting=Sighting(named, s.points[right], s.sigma[right]))
    without = run(replace(session, views=tuple(views)))
    np.testing.assert_allclose(found.T_mount, without.T_mount, atol=1e-9)


def test_a_sensor_effect_that_acts_on_both_is_found():
    measured = measured_plate(3, hidden={"range_scale": 4.0})
    after = change(run(labelled_session_of(measured)), ["range_scale"])
    value, sigma = after.terms[0].values[0], after.terms[0].sigmas[0]
    # Normal errors stay within 3.3 sigmas in 999 of 1000 cases; the effect itself is larger.
    assert abs(value - measured.hidden["range_scale"]["s"]) < 3.3 * sigma < abs(value)
