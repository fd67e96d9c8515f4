"""A session of another arm or scanner is refused; one whose arm was calibrated since is not."""

import pytest

from data_synth.arms import ARMS
from data_synth.write import robot_table
from stitch.plugins.watch.cell_identity import cell_identity, other_cell


def rows_of(arm):
    keys = ("a", "alpha_deg", "d", "theta_deg")
    return [[float(joint.get(key, 0.0)) for key in keys] for joint in robot_table(arm)["joints"]]


def test_arms_of_the_generator_are_told_apart_by_their_rows_alone():
    arms = [arm for arm in ARMS.values() if len(robot_table(arm)["joints"]) == 6]
    assert len(arms) > 1
    for one in arms:
        for other in arms:
            told = other_cell({"rows": rows_of(one)}, {"rows": rows_of(other)}, "mm")
            assert (told is None) == (rows_of(one) == rows_of(other))


def test_a_calibrated_arm_is_the_same_arm():
    rows = rows_of(next(iter(ARMS.values())))
    corrected = [[a + 0.8, alpha + 0.1, d - 0.5, theta + 0.2] for a, alpha, d, theta in rows]
    assert other_cell({"rows": rows}, {"rows": corrected}, "mm") is None


@pytest.mark.parametrize("key", ["arm", "scanner"])
def test_another_name_is_another_cell_and_a_missing_one_is_none(key):
    assert other_cell({key: "left"}, {key: "right"}, "mm") == f"has {key} right, the cell left"
    assert other_cell({key: "left"}, {}, "mm") is None


def test_the_identity_is_what_the_session_states(tmp_path):
    text = '[scanner]\nname = "left"\n[robot]\nname = "KR"\njoints = [{ a = 150, alpha_deg = -90 }]\n'
    (tmp_path / "session.toml").write_text(text)
    assert cell_identity(tmp_path) == {"arm": "KR", "scanner": "left", "rows": [[150.0, -90.0, 0.0, 0.0]]}
    assert cell_identity(tmp_path / "none") == {}
