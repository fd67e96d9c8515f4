"""What one scan shows and others look through: squares of known place among simulated scans of a part."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from stitch.api.pipeline import run
from stitch.numerics import frames
from stitch.screening.background import find_occluder
from stitch.screening.deep_check import deep_check
from stitch.session.capture import part_size, prepare_capture
from stitch.session.scan import prepare_scan
from stitch.session.session import Cloud

VIEWS, SIDE, COUNT = 10, 8.0, 300


@pytest.fixture(scope="module")
def measured():
    return measured_blade(21, views=VIEWS, pixels=80)


def with_squares(measured, shown_by):
    """Some scans with a square before the part, on the way to another scanner; in each before another one."""
    session, T = session_of(measured), measured.T_reference_scanner
    rng, views = np.random.default_rng(3), list(session.views)
    for v in shown_by:
        other = (v + VIEWS // 2) % VIEWS
        flat = np.column_stack([rng.uniform(-SIDE / 2, SIDE / 2, (COUNT, 2)), np.zeros(COUNT)])
        square = 0.8 * session.views[other].cloud.points.mean(axis=0) + flat
        here = frames.transform(frames.inverse(T[v]) @ T[other], square)
        views[v] = replace(views[v], cloud=Cloud(np.concatenate([views[v].cloud.points, here])))
    return replace(session, views=tuple(views))


def found_in(measured, session):
    own = prepare_capture(session)
    return find_occluder(own.scans, measured.T_reference_scanner, part_size([own]))


def test_nothing_is_in_the_way_of_a_good_session(measured):
    assert found_in(measured, session_of(measured)) is None


@pytest.mark.parametrize("shown_by", [(4,), (1, 6), range(VIEWS)])
def test_what_others_look_through_is_said_with_the_views_and_its_share(measured, shown_by):
    session = with_squares(measured, shown_by)
    views, share = found_in(measured, session)
    # A square that its scan sees from the edge has no normals, and does not count.
    assert set(views) <= set(shown_by) and len(views) >= 0.5 * len(shown_by)
    shares = [COUNT / len(session.views[v].cloud.points) for v in shown_by]
    # Only what has the part behind it is looked through.
    assert 0.3 * np.mean(shares) < share < 1.3 * np.mean(shares)


@pytest.mark.parametrize(("edge", "in_the_way_of_it"), [(30.0, True), (0.0, False)])
def test_what_stands_beside_all_looks_is_looked_through_by_none(edge, in_the_way_of_it):
    """A strip before a wall, and one beside its end, where a face too steep to be seen may lead to it."""
    x, y = np.meshgrid(np.arange(-60.0, edge + 0.5), np.arange(-40.0, 40.5))
    wall = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 500.0)])
    # Its rays pass the wall's end by less than the wall's points lie apart.
    x, y = np.meshgrid(np.linspace(0.2, 1.0, 5), np.linspace(-20.0, 20.0, 60))
    strip = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 500.0)]) * 0.9
    scans = [prepare_scan("wall", wall), prepare_scan("strip", np.concatenate([strip, wall[:3000]]))]
    found = find_occluder(scans, np.tile(np.eye(4), (2, 1, 1)), 100.0)
    assert (found is not None and found[0] == (1,)) == in_the_way_of_it


def test_a_run_and_a_deep_check_say_it_alike(measured):
    session = with_squares(measured, (4,))
    (said,) = run(session).doubts
    assert "of what v004 shows stands where other scans see through" in said
    assert [(p.kind, p.views) for p in deep_check(session)] == [("foreign", ("v004",))]
