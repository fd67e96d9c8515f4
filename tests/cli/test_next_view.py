"""`stitch next`: what its JSON says, and what is said where nothing has to be told apart."""

import pytest

from stitch.cli.next_view import next_view_row, write_program
from stitch.errors import InputError

POSE = {"do": "take a view", "separates": ["a", "b"], "joints_deg": [1.0, 2.0], "views": 1, "T_base_flange": [[1.0]]}
ARTEFACT = {"do": "scan a sphere", "separates": ["a", "b"], "joints_deg": None, "views": None, "T_base_flange": None}


def test_the_json_has_poses_rivals_expectations_and_the_odds_of_all_poses():
    first = POSE | {"wait_s": 0.0, "probability": 0.4}
    second = POSE | {"wait_s": 600.0, "probability": 0.8}
    expected = [{"effect": "a", "value": 1e-4, "sigma": 2e-5}]
    document = {"next": [first, second, ARTEFACT], "screen": {"deciding_view": {"expected": expected}}}
    told = next_view_row(document)
    assert [pose["joints_deg"] for pose in told["poses"]] == [[1.0, 2.0], [1.0, 2.0]]
    assert told["splits"] == ["a", "b"] and told["expected"] == expected
    assert told["probability_to_decide"] == 0.8


def test_without_a_pose_there_are_no_odds_and_no_program(tmp_path):
    told = next_view_row({"next": [ARTEFACT], "screen": None})
    assert told == {"poses": [], "splits": ["a", "b"], "expected": [], "probability_to_decide": None}
    assert next_view_row({"next": [], "screen": None})["splits"] == []

    class Diagnosis:
        next = ()

    with pytest.raises(InputError, match="no pose is proposed"):
        write_program(Diagnosis(), tmp_path / "next.src", None)
    assert not (tmp_path / "next.src").exists()
