"""A cell that is driven, simulated by a program of its own: poses that bring most, and commands that go wrong."""

import sys
from pathlib import Path

import numpy as np
import pytest

import stitch
from data_synth.cells.driven_cell import new_cell, take
from stitch.errors import NoResultError
from stitch.plugins.metrology.planning import drive as driving
from stitch.plugins.metrology.planning.drive import DrivenCell, drive
from stitch.plugins.metrology.planning.verb import plan
from tests.command_line import ended

SEED = 2
UNTIL = 0.6  # mm: reached with few views


@pytest.fixture
def cell(tmp_path):
    folder = tmp_path / "cell"
    return DrivenCell(folder, size=250.0, start=np.radians(new_cell(folder, SEED)))


def rows(folder: Path) -> int:
    table = folder / "views.csv"
    return len(table.read_text().splitlines()) - 1 if table.is_file() else 0


def taken_here(_, command, pose, seconds):
    """What the command of this cell does, in this process."""
    take(Path(pose["session"]), pose["view"], np.radians(pose["joints_deg"]), SEED)


def test_poses_are_proposed_until_u_is_reached_and_a_view_that_does_not_come_is_out_of_reach(cell):
    poses = []
    for pose in plan(cell.folder, until_U=UNTIL, size=cell.size, start=cell.start):
        poses.append(pose)
        if len(poses) != 3:
            take(cell.folder, pose["view"], np.radians(pose["joints_deg"]), SEED)
    refused, another = (np.radians(pose["joints_deg"]) for pose in poses[2:4])
    assert poses[2]["view"] == poses[3]["view"]
    assert np.abs(refused - another).max() > 0.1
    assert rows(cell.folder) == len(poses) - 1
    run = stitch.run(stitch.load_session(cell.folder))
    assert driving._U_at_part(run) <= UNTIL


def test_a_command_that_fails_loses_no_view_and_the_next_call_goes_on(cell, monkeypatch):
    command = f"{sys.executable} -m data_synth.cells.driven_cell {SEED} fail"
    told = []
    with pytest.raises(NoResultError, match="exit code 1"):
        drive(cell, UNTIL, command, 60.0, lambda views, U, _: told.append((views, U)))
    assert rows(cell.folder) == 2
    # A process a view would show nothing further.
    monkeypatch.setattr(driving, "call_program", taken_here)
    drive(cell, UNTIL, command, 60.0, lambda views, U, _: told.append((views, U)))
    assert told[-1][0] == rows(cell.folder) > 2
    assert told[-1][1] <= UNTIL


def test_a_command_that_writes_no_view_or_takes_too_long_is_named(cell):
    with pytest.raises(NoResultError, match="has no further view"):
        drive(cell, UNTIL, "true", 60.0, lambda *_: None)
    with pytest.raises(NoResultError, match=r"no answer after 0\.2 s"):
        drive(cell, UNTIL, "sleep 5", 0.2, lambda *_: None)


def test_an_unreachable_first_pose_ends_without_a_view(cell):
    drive(cell, UNTIL, f"{sys.executable} -c 'raise SystemExit(3)'", 60.0, lambda *_: None)
    assert rows(cell.folder) == 0


@pytest.mark.parametrize("first", [True, False])
def test_a_scan_that_shows_nothing_is_said_and_another_pose_is_sought(cell, first):
    told = []
    for number, pose in enumerate(cell.poses(UNTIL, lambda *said: told.append(said))):
        take(cell.folder, pose["view"], np.radians(pose["joints_deg"]), SEED, empty=number == (0 if first else 2))
    without = [why for _, _, why in told if why]
    assert len(without) == 1 and without[0].startswith(f"{'d000' if first else 'd002'}: its scan shows nothing")
    assert rows(cell.folder) == number * (not first)
    if not first:
        assert len(stitch.load_session(cell.folder).views) == number


def test_ctrl_c_leaves_what_was_scanned(cell, monkeypatch):
    take(cell.folder, "d000", cell.start, SEED)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(driving, "call_program", interrupted)
    with pytest.raises(KeyboardInterrupt):
        drive(cell, UNTIL, "cell", 60.0, lambda *_: None)
    assert rows(cell.folder) == 1


def test_drive_and_until_u_go_together(cell):
    told = ended("plan", cell.folder, "--drive", "true", code=2)
    assert "--until-U" in told.err
