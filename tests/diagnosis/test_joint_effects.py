"""Effects of joints and part diagnosed from labelled points of a cell whose truth is known."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TABLE, TARGETS, Growth, labelled_cell
from stitch.api.pipeline import change, diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.stepwise_selection import find_effect_to_drop


def test_a_hidden_joint_offset_is_named_and_found():
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=40, offset=offset)
    before = run(session)
    found = diagnose(before)
    assert "joint_offset" in found.effects, found.sentence
    after = change(before, ["joint_offset"])
    assert after.heldout_rms < 0.2 * before.heldout_rms
    values = {p.name: p.value for p in after.terms[0].parameters}
    for name, true in zip(("d2", "d3", "d5"), offset[[1, 2, 4]], strict=True):
        assert values[name] == pytest.approx(true, abs=2e-4)


@pytest.mark.slow
def test_offsets_and_gravity_together_are_found_by_their_names(few_effects):
    # Gravity on the flange's mass turns joint 2 by what the flange reaches out: 2 µrad a millimetre.
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(9, views=100, offset=offset, sag=2e-6, targets=TARGETS[:2])
    found, lines, _ = suggest(run(session), 3)
    assert set(found.effects) == {"joint_offset", "joint_compliance"}, lines
    assert found.heldout_rms < 0.1


def test_an_effect_that_another_made_idle_is_dropped():
    session, *_ = labelled_cell(12, views=100, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), targets=TARGETS[:2])
    state = run(session, effects=["gear_eccentricity", "joint_offset"])
    name, reason = find_effect_to_drop(state, {"gear_eccentricity", "joint_offset"})
    assert name == "gear_eccentricity", reason
    assert find_effect_to_drop(run(session, effects=["joint_offset"]), {"joint_offset"}) is None


def test_an_honest_cell_is_adequate():
    session, *_ = labelled_cell(5, views=40)
    found = diagnose(run(session))
    assert found.verdict == "adequate", found.sentence


@pytest.mark.parametrize("mount", ["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def test_growth_is_found_wherever_the_part_is_held(mount):
    """No session says which point of a part stands still; the flange and the robot's base need not be near it."""
    still = TARGETS[0] + [80.0, -40.0, -90.0] + (0 if mount == "eye_to_hand" else TABLE)
    session, *_ = labelled_cell(4, mount=mount, grown=Growth(2e-4, still))
    found = run(session)
    assert diagnose(found).effects == ("part_growth",)
    found = run(session, effects=["part_growth"])
    values, sigmas = found.terms[0].values, found.terms[0].sigmas
    true = 2e-4 * np.append(1.0, found.measurement.target_views[0].origin - still)
    assert (sigmas < [1e-5, 2e-3, 2e-3, 2e-3]).all()  # mm: a quarter of the motion of the middle
    assert (np.abs(values - true) < 4 * sigmas).all()


@pytest.mark.usefixtures("few_effects")
def test_hand_eye_is_pushed_by_what_is_too_small_to_be_seen():
    """Offsets of the smallest detectable size, put into the same measurements joint by joint."""
    session, *_ = labelled_cell(5)
    found = run(session)
    suspect = next(s for s in diagnose(found).candidates if s.name == "joint_offset")
    sizes = [min(suspect.detectable.get(f"d{i + 1}", np.inf), 1e-3) for i in range(6)]
    middle = np.mean([v.sighting.points.mean(axis=0) for v in session.views], axis=0)
    pushed = []
    for size, own in zip(sizes, np.eye(6), strict=True):
        T = np.linalg.inv(found.T_mount) @ run(labelled_cell(5, offset=size * own)[0]).T_mount
        pushed.append(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
    seen = [np.isfinite(suspect.detectable.get(f"d{i + 1}", np.inf)) for i in range(6)]
    assert suspect.hand_eye == pytest.approx(np.max(np.array(pushed)[seen]), rel=0.2)
