"""Poses that are no matrices are read as a table of them is, or refused in the same words."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.plugins.intake.stated_poses import matrices_of_table
from stitch.session.reading.session_folder import load_session


@pytest.fixture
def views(session):
    """Poses (V, 4, 4) mm and scans of a simulated cell, and its mount."""
    loaded = load_session(session)
    scale = {"mm": 1.0, "m": 1e3}[loaded.length_unit]
    T = np.array([view.T_base_flange for view in loaded.views])
    T[:, :3, 3] *= scale
    return T, [view.cloud.points * scale for view in loaded.views], loaded.mount


def test_quaternions_are_read_as_a_table_of_them(views):
    T, scans, mount = views
    rows = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()])
    read = matrices_of_table(rows, scans, "mm", "mm", mount)
    assert np.abs(read - T).max() < 1e-9


@pytest.mark.parametrize("height", [3, 4])
def test_matrices_in_one_row_are_read(views, height):
    T, scans, mount = views
    assert np.abs(matrices_of_table(T[:, :height].reshape(len(T), -1), scans, "mm", "mm", mount) - T).max() < 1e-9
    assert np.abs(matrices_of_table(T[:, :3], scans, "mm", "mm", mount) - T).max() < 1e-9


def test_what_is_no_table_stays_as_it_is(views):
    T, scans, mount = views
    for poses in (T, None, (Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3]), list(T)):
        assert matrices_of_table(poses, scans, "mm", "mm", mount) is poses


def test_angles_without_scans_that_tell_their_order_are_refused(views):
    T, _, mount = views
    rows = np.hstack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)])
    with pytest.raises(InputError, match=r"can be read in \d+ ways; to fix: pass matrices"):
        matrices_of_table(rows, [None] * len(T), "mm", "mm", mount)
    with pytest.raises(InputError, match="hold no pose that is known"):
        matrices_of_table(np.hstack([rows, rows[:, :2]]), [None] * len(T), "mm", "mm", mount)
