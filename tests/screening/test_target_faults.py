"""`check --deep` of labelled points says what a run says, in sessions of points alone."""

from dataclasses import replace

import numpy as np

from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.screening.deep_check import deep_check
from stitch.screening.target_checks import target_warnings
from stitch.session.capture import sightings_of

VIEWS, START = 16, 9


def changed(session, change):
    """The session with what each view shows of targets changed."""
    views = [replace(view, sighting=change(v, view.sighting)) for v, view in enumerate(session.views)]
    return replace(session, views=tuple(views))


def test_a_good_session_has_none():
    assert deep_check(labelled_cell(0, views=VIEWS)[0]) == []


def test_a_target_that_moved_is_said_with_the_views_from_there_on():
    """Towards another one by 3 mm, whatever the pose."""
    session, *_ = labelled_cell(0, views=VIEWS)

    def change(v, shown):
        points = np.array(shown.points)
        if v >= START:
            points[0] += 3.0 * (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        return replace(shown, points=points)

    moved = changed(session, change)
    found = deep_check(moved)
    assert [(p.kind, p.views) for p in found] == [("displaced", tuple(session.names[START:]))]
    assert target_warnings(moved, sightings_of(moved)) == (found[0].fix,)


def test_names_that_are_mixed_up_are_said_with_their_view():
    session, *_ = labelled_cell(0, views=VIEWS)

    def change(v, shown):
        return replace(shown, targets=tuple(np.roll(shown.targets, 1))) if v == START else shown

    found = deep_check(changed(session, change))
    assert [(p.kind, p.views) for p in found] == [("exchanged", (session.names[START],))]
