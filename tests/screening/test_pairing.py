"""What happened to views that do not belong, and how that is said: steps, exchanged scans, sizes, lists of names."""

import numpy as np
import pytest

from stitch.numerics import frames
from stitch.screening.pairing import exchange_cycles, exchanged_pairs, find_common_displacement
from stitch.screening.problems import SessionProblem, displacement_text, list_views
from stitch.screening.snooping import MisplacedView

SLIP = np.array([0.05, -0.03, 0.02, 3.0, -5.0, 2.0])
NAMES = [f"v{v:03d}" for v in range(104)]


def standing(view, T):
    return MisplacedView(view, "displaced", 0.1, 5.0, T)


@pytest.mark.parametrize("views", [range(2, 5), range(3)])
@pytest.mark.parametrize("what", ["part", "scanner"])
def test_a_common_displacement_is_one_step(blade_capture, what, views):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    moved = {v: frames.exp(SLIP) @ poses[v] if what == "part" else poses[v] @ frames.exp(SLIP) for v in views}
    assert find_common_displacement(capture, poses, [standing(v, T) for v, T in moved.items()]) == (views, what)


def test_views_that_go_each_its_own_way_are_no_step(blade_capture):
    measured, capture = blade_capture
    poses, rng = capture.poses(measured.T_mount), np.random.default_rng(1)
    own = [standing(v, frames.exp(rng.normal(0, [0.05] * 3 + [5.0] * 3)) @ poses[v]) for v in (2, 3, 4)]
    assert find_common_displacement(capture, poses, own) is None


def test_two_views_or_views_in_the_middle_are_no_step(blade_capture):
    measured, capture = blade_capture
    poses = capture.poses(measured.T_mount)
    for views in ((3, 4), (1, 2, 3)):
        assert (
            find_common_displacement(capture, poses, [standing(v, frames.exp(SLIP) @ poses[v]) for v in views]) is None
        )


def misplaced(*views):
    return [MisplacedView(v, "displaced", 0.1, 5.0, np.eye(4)) for v in views]


def test_scans_in_each_others_rows_are_closed_rounds():
    assert exchange_cycles({2: 6, 6: 2, 4: None}) == [(2, 6)]
    assert exchange_cycles({1: 5, 5: 8, 8: 1}) == [(1, 5, 8)]


def test_one_of_two_may_show_too_little():
    assert exchanged_pairs({8: 1, 1: None}, misplaced(1, 8)) == [(8, 1)]


def test_a_row_that_two_scans_claim_is_nobodys():
    assert exchanged_pairs({8: 1, 7: 1, 1: None}, misplaced(1, 7, 8)) == []


def test_a_row_whose_own_scan_belongs_is_not_changed():
    assert exchanged_pairs({8: 1}, misplaced(8)) == []


@pytest.mark.parametrize(
    ("best", "least", "said"),
    [
        ((1e-6, 5.002), (0.0, 4.981), "5 mm"),
        ((0.03, 3.25), (0.002, 1.2), "at least 1.2 mm and 2 mrad"),
        ((np.radians(109), 50.0), (np.radians(108.6), 17.0), "at least 17 mm and 109°"),
        ((np.radians(2), 5.0), (np.radians(2), 5.0), "5 mm and 2.0°"),
        ((1e-5, 0.02), (1e-6, 0.0006), ""),
    ],
)
def test_a_size_is_told_as_far_as_it_is_held(best, least, said):
    assert displacement_text(best, least, "mm") == said


def test_views_in_a_row_are_a_range_and_two_are_not():
    assert list_views(NAMES[:103], NAMES) == "v000–v102"
    assert list_views([*NAMES[2:5], *NAMES[7:9], NAMES[20]], NAMES) == "v002–v004, v007, v008, v020"


def test_a_row_is_one_of_the_session_and_not_of_the_names():
    assert list_views(["v1", "v2", "v3"], ["v1", "x", "v2", "v3"]) == "v1, v2, v3"


def test_the_rest_of_many_is_counted():
    assert list_views(NAMES[::2], NAMES) == "v000, v002, v004, v006, v008, v010 … and 46 more"
    assert list_views([*NAMES[:20:2], *NAMES[50:]], NAMES).endswith("v010 … and 58 more")


def test_a_problem_lists_its_views_so():
    assert (
        SessionProblem("disconnected", tuple(NAMES[1:]), "add views").line(NAMES)
        == "disconnected (v001–v103): add views"
    )
