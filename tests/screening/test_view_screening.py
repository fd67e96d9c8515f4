"""Runs of sessions with blunders: named and left out, or refused; never fused in silence."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import change, run
from stitch.errors import InputError, NoResultError
from stitch.fit.fit import FittedRig, FittedSession
from stitch.model.model_toml import ModelFile
from stitch.numerics import frames
from stitch.output.result_document import result_document
from stitch.screening import view_screening
from stitch.screening.view_screening import ViewScreening, fit_screened_views
from stitch.session.capture import prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.session import Cloud
from tests.screening.targets import with_corners


@pytest.fixture(scope="module")
def good():
    return session_of(measured_blade(21, views=10, pixels=80))


def with_view(session, number, **changes):
    views = list(session.views)
    views[number] = replace(views[number], **changes)
    return replace(session, views=tuple(views))


def torn(session, number, by):
    """The session with half of one scan so many mm off."""
    points = session.views[number].cloud.points
    half = points[:, 0] > np.median(points[:, 0])
    return with_view(session, number, cloud=Cloud(points + half[:, None] * np.array([0.0, 0.0, by])))


def test_a_good_session_leaves_nothing_out(good):
    found = run(good)
    assert found.left_out == () and found.links.components == (tuple(v.name for v in good.views),)
    assert np.isfinite(found.view_rms).all()


def test_a_scan_that_is_torn_in_itself_is_named_and_left_out(good):
    """Half of it 1 mm off: that half has no partners, and the other fits; it used to be fused beside the others."""
    found = run(torn(good, 4, 1.0))
    assert [item.view for item in found.left_out] == ["v004"]
    assert "contradicts the other scans wherever it is put" in found.left_out[0].why


def test_a_torn_scan_is_named_though_common_targets_hold_it():
    """They say where it was taken from, and one half lies there: nothing of it is displaced as a whole."""
    session = with_corners(measured_blade(21, views=6, pixels=80))
    assert run(session).left_out == ()
    (gone,) = run(torn(session, 4, 2.0)).left_out
    assert gone.view == "v004" and "contradicts the other scans" in gone.why


def test_two_views_that_no_hand_eye_brings_together_accuse_nobody(good):
    """One motion leaves two directions of the hand-eye open, and a good session of two views was told that it is wrong."""
    with pytest.raises(NoResultError, match="two views show one motion"):
        run(replace(good, views=(good.views[0], good.views[5])))


# In `make test` on the scans alone: test_snooping.py.
@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_scan_that_stands_beside_the_others_is_no_second_surface(good, axis):
    """However few partners are left within the gate, and however well these fit."""
    found = run(with_view(good, 4, cloud=Cloud(good.views[4].cloud.points + np.eye(3)[axis])))
    assert [item.view for item in found.left_out] == ["v004"] and "off by" in found.left_out[0].why


def test_exchanged_scans_are_named_and_left_out_and_stay_out(good):
    swapped = with_view(with_view(good, 2, cloud=good.views[6].cloud), 6, cloud=good.views[2].cloud)
    found = run(swapped)
    assert [item.view for item in found.left_out] == ["v002", "v006"]
    assert [view["view"] for view in result_document(found)["views"]] == good.names
    assert all("exchange the clouds of v002 and v006" in item.why for item in found.left_out)
    assert found.notes[0].startswith("View v002 does not fit its robot pose") and len(found.poses) == 8
    again = change(found, ["range_scale"])
    assert again.left_out == found.left_out and len(again.poses) == 8
    kept = run(swapped, keep=True)
    assert kept.left_out == () and len(kept.poses) == 10 and "kept as asked" in kept.notes[0]


@pytest.mark.slow
def test_a_view_that_was_displaced_is_left_out_with_its_amount(good):
    T = good.views[4].T_base_flange.copy()
    T[:3, 3] += [3.0, 0.0, 4.0]
    found = run(with_view(good, 4, T_base_flange=T, joints=None, approach=None))
    assert [item.view for item in found.left_out] == ["v004"]
    # Few points a view: what is said is a bound, which the truth keeps and which is beyond what any arm does.
    amount = float(found.left_out[0].why.split("off by at least ")[1].split(" mm")[0])
    assert 2.5 < amount <= 5.0


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0254, 0.97])
def test_scans_of_another_scale_are_refused_though_they_fit_each_other(good, factor):
    views = [replace(v, cloud=Cloud(v.cloud.points * factor)) for v in good.views]
    with pytest.raises(InputError, match="times as large") as refused:
        run(replace(good, views=tuple(views)))
    assert float(str(refused.value).split("clouds are ")[1].split()[0]) == pytest.approx(factor, abs=2e-3)


@pytest.mark.slow
def test_many_wrong_rows_that_no_test_tells_apart_are_refused_or_said(good):
    """Half of the views off by 1° and 5 mm, each its own way: surfaces heal the cloud, but nothing else is true."""
    rng = np.random.default_rng(6)
    views = list(good.views)
    for v in range(1, len(views), 2):
        turn, shift = rng.standard_normal((2, 3))
        twist = np.r_[np.radians(1) * turn / np.linalg.norm(turn), 5 * shift / np.linalg.norm(shift)]
        views[v] = replace(views[v], T_base_flange=views[v].T_base_flange @ frames.exp(twist), joints=None)
    try:
        found = run(replace(good, views=tuple(views)))
    except NoResultError as error:
        assert "contradict" in str(error) or "do not belong" in str(error)
    else:
        wrong = {view.name for view in views[1::2]}
        assert wrong <= {item.view for item in found.left_out} or found.doubts[0].startswith("No arm scatters by")


def test_poses_that_contradict_all_scans_are_refused(good):
    """Inverted poses: no run, and the mistake is named."""
    views = [replace(v, T_base_flange=frames.inverse(v.T_base_flange), joints=None, approach=None) for v in good.views]
    with pytest.raises((InputError, NoResultError), match="inverse|inverted|mount"):
        run(replace(good, views=tuple(views), robot=None))


@pytest.mark.slow
def test_a_model_of_another_mount_is_refused(good):
    found = run(good)
    T = found.T_mount @ frames.exp(np.array([0, 0, 0, 50.0, 0, 0]))
    stranger = ModelFile("mm", good.mount, T, T, found.mount_covariance)
    with pytest.raises(NoResultError, match="another mount"):
        run(good, stranger)
    own = ModelFile("mm", good.mount, found.T_mount, found.T_mount, found.mount_covariance)
    assert run(good, own).left_out == ()


def test_labelled_points_with_exchanged_coordinates_are_refused():
    session, *_ = labelled_cell(3, views=20)
    views = tuple(
        replace(v, sighting=replace(v.sighting, points=v.sighting.points[:, [0, 2, 1]])) for v in session.views
    )
    with pytest.raises((InputError, NoResultError)):
        run(replace(session, views=views))


def test_a_fit_that_says_nothing_about_the_poses_leaves_no_view_out():
    session, T_mount, _ = labelled_cell(0, views=12)
    measurement = measurement_of(session, prepare_capture(session))
    fitted = FittedRig([FittedSession(measurement, None, ())])
    found = fit_screened_views([session], [measurement], lambda sessions, measurements: fitted)
    assert found.screenings == [ViewScreening()] and found.sessions == [session]


@dataclass
class FoundSteps:
    """What tests of the views say: from a step on, the last view would not belong."""

    steps: tuple

    @property
    def left_out(self):
        return (2,) if self.steps else ()


@pytest.mark.parametrize("steps", [(), (SimpleNamespace(at_least=(0.0, 0.0)),)])
def test_copied_scans_are_warned_of_after_a_change_of_the_model_too(monkeypatch, steps):
    """Beside a step that effects can describe, too: the views beyond it are fused."""
    monkeypatch.setattr(view_screening, "_snoop_session", lambda *_: FoundSteps(steps))
    monkeypatch.setattr(view_screening, "beyond_any_arm", lambda *_: False)
    monkeypatch.setattr(view_screening, "snooping_warnings", lambda *_: ())
    monkeypatch.setattr(view_screening, "stock_problems", lambda *_: [])
    scans = [SimpleNamespace(points=np.full((3, 3), value)) for value in (1.0, 2.0, 1.0)]
    correction = SimpleNamespace(captures=[SimpleNamespace(scans=scans, sightings=None)])
    session = SimpleNamespace(names=["v001", "v002", "v003"])
    (warning,) = view_screening.session_warnings(session, SimpleNamespace(), correction, 0)
    assert warning.startswith("The scans of v001 and v003 are the same points")
