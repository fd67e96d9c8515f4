"""What a model hands on to another session."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.labelled_arm import TABLE, TARGETS, labelled_cell
from stitch.api.pipeline import run
from stitch.model.model_toml import arm_model, without_events
from stitch.output.result_document import model_of

SLIP = np.array([0.02, -0.01, 0.03]), np.array([1.0, -2.0, 0.5])  # rad, mm, reference frame
SLIPPED_AT, OTHER_SESSION = 30, 50


@pytest.fixture(scope="module")
def sessions():
    """A session in which the part slips before a view, and a later one of the same cell."""
    turn = Rotation.from_rotvec(SLIP[0]).as_matrix()
    slipped = (TARGETS + TABLE) @ turn.T + SLIP[1] - TABLE
    before, after = (labelled_cell(7, 80, "eye_in_hand", targets=places)[0] for places in (TARGETS, slipped))
    views = before.views[:SLIPPED_AT] + after.views[SLIPPED_AT:]
    return replace(before, views=views[:OTHER_SESSION]), replace(before, views=views[OTHER_SESSION:])


def test_a_slip_stays_in_its_session_and_the_targets_stand_where_they_ended(sessions):
    first, later = sessions
    file = model_of(run(first, effects=["part_slip"]))
    assert "part_slip" in file.effects
    handed_on = without_events(file)
    assert handed_on.effects == {} and handed_on.T_mount is file.T_mount
    again = run(later, file)
    assert again.model.terms == ()
    noise = run(later).fit.stages[-1].rms
    assert again.fit.stages[0].rms < 3 * noise + 0.05


def test_after_a_step_of_the_mount_another_session_finds_the_scanner_where_it_ended():
    xi = np.array([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1])
    still = labelled_cell(8, 30)[0]
    moved = [
        replace(v, sighting=replace(v.sighting, points=_in_moved_scanner(v.sighting.points, xi))) for v in still.views
    ]
    stepped = replace(still, views=(*still.views[:15], *moved[15:]))
    handed_on = without_events(model_of(run(stepped, effects=["mount_step"])))
    assert handed_on.effects == {}
    ended = run(replace(still, views=tuple(moved))).T_mount
    off = np.linalg.inv(ended) @ handed_on.T_mount
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 1e-4


def _in_moved_scanner(points, xi):
    turn = Rotation.from_rotvec(xi[:3]).as_matrix()
    return (points - xi[3:]) @ turn


def test_of_the_arm_nothing_is_handed_on_that_began_at_a_view(sessions):
    assert arm_model(model_of(run(sessions[0], effects=["part_slip"]))) is None
