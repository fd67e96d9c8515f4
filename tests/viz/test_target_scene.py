"""What the marks of labelled points stand for, and where they stand."""

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import PROBE_TURN, TABLE, TARGETS, flange, labelled_cell
from stitch.api.pipeline import run
from viz.target_scene import ANY, NOTHING, bodies, mark_values, marks_of


def test_a_mark_counts_what_it_stands_for():
    view, target, distance = np.array([0, 0, 1, 3]), np.array([0, 2, 2, 0]), np.array([3.0, 4.0, 12.0, 5.0])
    marks = np.array([(0, 2), (0, ANY), (ANY, 2), (ANY, 0), (3, 0), (2, ANY), (1, 0), (ANY, 1), (NOTHING, NOTHING)])
    square = [16, (9 + 16) / 2, (16 + 144) / 2, (9 + 25) / 2, 25]
    expected = np.append(np.sqrt(square), [np.nan] * 4)
    np.testing.assert_allclose(mark_values(marks, view, target, distance), expected)


@pytest.mark.parametrize("kind", ["carried targets", "carried scanner", "probe"])
def test_marks_stand_where_the_cell_has_them(kind):
    """By the true cell, whose chain is written down a second time; poses scatter by 20 µm."""
    mount = "eye_in_hand" if kind == "carried scanner" else "eye_to_hand"
    session, T_mount, _ = labelled_cell(1, views=12, mount=mount, probe=kind == "probe")
    marks = marks_of(run(session))
    joints = np.array([view.joints for view in session.views])
    T_base_flange = np.array([flange(q) for q in joints])
    own = marks.view >= 0
    if mount == "eye_in_hand":
        expected = (T_base_flange @ T_mount)[marks.view[own], :3, 3]
        balls = marks.T[marks.target >= 0, :3, 3]
        np.testing.assert_allclose(balls, TARGETS + TABLE, atol=0.2)
    else:
        expected = np.array(
            [
                (T_base_flange[v] @ [*TARGETS[k], 1.0])[:3]
                for v, k in zip(marks.view[own], marks.target[own], strict=True)
            ]
        )
        assert len(expected) == 12 * (1 if kind == "probe" else len(TARGETS))
    np.testing.assert_allclose(marks.T[own, :3, 3], expected, atol=0.2)
    if kind == "probe":
        turned = T_base_flange[marks.view[own], :3, :3] @ PROBE_TURN
        np.testing.assert_allclose(marks.T[own, :3, :3], turned, atol=1e-3)
    # All bodies together: every vertex belongs to its mark, and lies near it.
    surface = bodies(marks)
    away = np.linalg.norm(surface.vertices - marks.T[surface.patch[:, 0], :3, 3], axis=1)
    assert away.max() < 0.2 * np.ptp(marks.valued, axis=0).max()
    assert set(surface.patch[:, 0]) == set(range(len(marks.shape)))
