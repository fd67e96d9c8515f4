"""Scales that are off by 1000 are refused; sensors whose origin lies in what they measure are not."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.edits import edit
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.errors import InputError
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.scale_checks import check_scale
from stitch.session.reading.session_folder import load_session


def moved(session, change):
    """The session with its cloud's or target's points changed."""

    def view_of(view):
        if view.cloud is not None:
            return replace(view, cloud=replace(view.cloud, points=change(view.cloud.points)))
        return replace(view, sighting=replace(view.sighting, points=change(view.sighting.points)))

    return replace(session, views=tuple(view_of(view) for view in session.views))


@pytest.fixture(params=["clouds", "points"])
def right(request):
    if request.param == "clouds":
        return load_session(request.getfixturevalue("session"))
    return labelled_cell(3, views=12)[0]


def test_a_right_session_passes(right):
    check_scale(right, "mm")


def test_the_origin_may_lie_in_the_measuring_volume(right):
    """Points about the sensor's origin: the median distance is a few millimetres, the size is what it was."""
    middle = np.mean([
        np.mean(v.cloud.points if v.cloud is not None else v.sighting.points, axis=0) for v in right.views
    ], axis=0)  # fmt: skip
    check_scale(moved(right, lambda points: points - middle), "mm")
    check_scale(moved(right, lambda points: points - points.mean(axis=0)), "mm")


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_another_unit_is_refused(right, factor):
    with pytest.raises(InputError, match="the scale looks off by 1000"):
        check_scale(moved(right, lambda points: points * factor), "mm")


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_one_cloud_in_another_unit_is_told_from_a_session_in_another_unit(session, factor):
    """Whichever unit the session states, its advice leads to the one odd cloud and not back."""
    right = load_session(session)
    first, *others = right.views
    odd = replace(first, cloud=replace(first.cloud, points=first.cloud.points * factor))
    mixed = replace(right, views=(*others, odd))
    with pytest.raises(InputError, match=f"view {first.name} .* that cloud alone is in another unit .* in mm$"):
        check_scale(mixed, "mm")
    with pytest.raises(InputError, match='set cloud_unit = "mm"'):
        check_scale(moved(mixed, lambda points: points * 1000), "m")


def test_one_stray_point_is_named(session):
    file = sorted((session / "clouds").iterdir())[1]
    points = read_cloud(file).points
    points[7, 2] = 1e30
    np.savetxt(file.with_suffix(".xyz"), points)
    edit(session / "views.csv", file.name, file.with_suffix(".xyz").name)
    with pytest.raises(InputError, match=r"view v001 .* 1 of \d+ points lie more than 1000 m .* point 8; to fix"):
        load_session(session)
