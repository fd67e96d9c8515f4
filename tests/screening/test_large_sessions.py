"""Sessions of thousands of views of labelled points, and joints that count otherwise than the description says."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.numerics import frames
from stitch.screening.conventions import proven_hypotheses, rank_hypotheses
from stitch.screening.target_checks import check_targets
from stitch.session.robot import forward
from tests.screening.mistakes import with_poses
from tests.screening.test_conventions import cell_of, motions


def with_joints(session, change):
    """The session whose table states other joint angles (V, 6), and poses that follow from them."""
    q = change(np.array([view.joints for view in session.views]))
    every = zip(session.views, q, forward(session.robot, q), strict=True)
    return replace(session, views=tuple(replace(v, joints=own, T_base_flange=T) for v, own, T in every))


JOINTS = {
    "j2 counts the other way": lambda q: q * [1, -1, 1, 1, 1, 1],
    "j2 and j3 count the other way": lambda q: q * [1, -1, -1, 1, 1, 1],
    "write j3 + j2 in place of j3": lambda q: q - np.outer(q[:, 1], [0, 0, 1, 0, 0, 0]),
    "j4 alone is in radians": lambda q: q * [1, 1, 1, np.pi / 180, 1, 1],
}


@pytest.mark.parametrize("said", JOINTS)
def test_joints_that_count_otherwise_are_named(said):
    (problem,) = check_targets(with_joints(labelled_cell(seed=4, views=12)[0], JOINTS[said]))
    assert said in problem.fix


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_what_moved_as_a_whole_is_named_with_the_row(mount):
    session, D = (
        labelled_cell(seed=2, views=400, mount=mount)[0],
        frames.exp(np.array([0.02, -0.03, 0.05, 40, -25, 10])),
    )
    for start in (97, 311):
        views = list(session.views)
        for v in range(start, 400):
            shown = views[v].sighting
            T = views[v].T_base_flange
            moved = (
                replace(views[v], sighting=replace(shown, points=frames.transform(D, shown.points)))
                if mount == "eye_to_hand"
                else replace(views[v], T_base_flange=D @ T, joints=None)
            )
            views[v] = moved
        (problem,) = check_targets(replace(session, views=tuple(views)))
        assert problem.kind == "reclamped" and problem.views[0] == session.names[start]


def test_a_rail_beside_the_poses_is_named_with_its_axis():
    """The robot rides along y; the table has its poses within the carriage, and the carriage's place in metres."""
    session, T_mount = cell_of("eye_in_hand")
    rail = np.linspace(0, 700, len(session.views)) + np.random.default_rng(0).normal(size=len(session.views)) * 80
    T = np.array([view.T_base_flange for view in session.views])
    seen = motions(session, T_mount)
    inner = with_poses(session, frames.make(T[:, :3, :3], T[:, :3, 3] - np.outer(rail, [0, 1, 0])))
    beside = [replace(v, covariates={"e1": e / 1000, "force": 3.0}) for v, e in zip(inner.views, rail, strict=True)]
    found = proven_hypotheses(rank_hypotheses(replace(inner, views=tuple(beside)), seen))
    assert found[0].hypothesis.kind == "linear_axis"
    assert "write y + 1000 * e1 in place of y" in found[0].hypothesis.fix
