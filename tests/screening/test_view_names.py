"""Lists of views in messages stay readable, however many there are."""

from stitch.screening.problems import SessionProblem, list_views

NAMES = [f"v{v:03d}" for v in range(104)]


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
