"""Every mistake with poses is named from the motions of the scanner alone, made here from known poses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.numerics import frames
from stitch.screening.conventions import likeliest_hypotheses, proven_hypotheses, rank_hypotheses
from stitch.screening.hypotheses import hypotheses
from stitch.screening.motions import RelativeScans
from stitch.screening.target_checks import check_targets
from tests.screening.mistakes import MISTAKES, with_poses


def motions(session, T_mount, seed=0):
    """What registration of neighbouring scans would give: exact motions with 0.3 mrad and 0.1 mm."""
    rng = np.random.default_rng(seed)
    T = np.array([v.T_base_flange for v in session.views])
    poses = (frames.inverse(T) if session.mount == "eye_to_hand" else T) @ T_mount
    pairs = [(v, v + step) for step in (1, 2) for v in range(len(T) - step)]
    noise = rng.normal(size=(len(pairs), 6)) * 3e-4
    B = np.array([frames.inverse(poses[v]) @ poses[w] for v, w in pairs]) @ frames.exp(noise * [1, 1, 1, 300, 300, 300])
    return RelativeScans(tuple(pairs), B)


def cell_of(mount):
    session, T_mount, _ = labelled_cell(seed=4, views=10, mount=mount)
    return with_poses(session, np.array([v.T_base_flange for v in session.views])), T_mount


@pytest.fixture(scope="module")
def cell():
    return cell_of("eye_to_hand")


def test_right_poses_need_no_other_convention(cell):
    session, T_mount = cell
    assert proven_hypotheses(rank_hypotheses(session, motions(session, T_mount))) == ()


@pytest.mark.parametrize("mistake", MISTAKES)
def test_scans_name_the_mistake(cell, mistake):
    session, T_mount = cell
    spoil, kinds = MISTAKES[mistake]
    found = proven_hypotheses(rank_hypotheses(spoil(session), motions(session, T_mount)))
    assert found and found[0].hypothesis.kind in kinds


@pytest.mark.parametrize("mistake", ["inverse", "mount", "inches", "shifted by one"])
def test_labelled_points_name_the_mistake(cell, mistake):
    session, _ = cell
    spoil, kinds = MISTAKES[mistake]
    (problem,) = check_targets(spoil(session))
    assert problem.kind in kinds and problem.fix


def test_right_labelled_points_pass(cell):
    assert check_targets(cell[0]) == []


def test_y_and_z_exchanged_in_labelled_points(cell):
    views = [replace(v, sighting=replace(v.sighting, points=v.sighting.points[:, [0, 2, 1]])) for v in cell[0].views]
    (problem,) = check_targets(replace(cell[0], views=tuple(views)))
    assert problem.kind == "mirrored"


def test_a_carried_sensor_is_judged_alike():
    session, T_mount = cell_of("eye_in_hand")
    assert proven_hypotheses(rank_hypotheses(session, motions(session, T_mount))) == ()
    assert check_targets(session) == []
    spoil, kinds = MISTAKES["mount"]
    assert proven_hypotheses(rank_hypotheses(spoil(session), motions(session, T_mount)))[0].hypothesis.kind in kinds


def slid(some, share, seed=5):
    """Of so many motions scans that slid on each other tell something else."""
    rng = np.random.default_rng(seed)
    T = some.T.copy()
    wrong = rng.permutation(len(T))[: round(share * len(T))]
    T[wrong] = T[wrong] @ frames.exp(rng.normal(size=(len(wrong), 6)) * [0.3, 0.3, 0.3, 30, 30, 30])
    return RelativeScans(some.pairs, T)


@pytest.mark.parametrize("mistake", ["KUKA angles as xyz", "w first", "shifted by one", "reversed"])
def test_half_of_the_motions_are_no_proof_and_tell_the_likeliest(cell, mistake):
    session, T_mount = cell
    spoil, kinds = MISTAKES[mistake]
    found = rank_hypotheses(spoil(session), slid(motions(session, T_mount), 0.5))
    assert proven_hypotheses(found) == () and likeliest_hypotheses(found)[0].hypothesis.kind in kinds


@pytest.mark.parametrize(
    "share", [0.0, pytest.param(0.5, marks=pytest.mark.slow), pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_right_poses_have_no_likelier_ones(cell, share):
    """Whether half of the motions agree with them, or none."""
    session, T_mount = cell
    for seed in range(5):
        assert likeliest_hypotheses(rank_hypotheses(session, slid(motions(session, T_mount, seed), share, seed))) == ()


def test_few_motions_say_nothing(cell):
    session, T_mount = cell
    some = motions(session, T_mount)
    assert rank_hypotheses(session, RelativeScans(some.pairs[:3], some.T[:3])) == []


def test_undoing_every_order_of_euler_angles_is_among_the_hypotheses():
    """The angles of any order, composed in any other, are found again: scipy's own composition is the judge."""
    session, _, _ = labelled_cell(seed=1, views=5)
    T = np.array([v.T_base_flange for v in session.views])
    R = Rotation.from_matrix(T[:, :3, :3])
    rng = np.random.default_rng(0)
    # Angles of two axes read as those of three lose their branch where the middle one exceeds 90°: not tried here.
    three, two = ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "xyz", "zyx"], ["ZYZ", "ZXZ", "XYX", "YZY", "zyz"]
    for orders in (three, three, three, two, two):
        right, wrong = rng.choice(orders, 2, replace=False)
        bad = frames.make(Rotation.from_euler(wrong, R.as_euler(right)).as_matrix(), T[:, :3, 3])
        tried = hypotheses(with_poses(session, bad))
        off = min(np.abs(h.T_base_flange - T).max() for h in tried if h.kind == "euler")
        assert off < 1e-6, (right, wrong)
