"""Residuals by covariate: views are the samples, the clearest of many means is judged as such, whole views follow what displaced them.

Open3D's own poses of a simulated blade: near the truth, near the run, the same twice, and what stitch says of them.
"""

import json
import sys

import numpy as np
import pytest
from scipy import stats

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import labelled_cell
from stitch.api.pipeline import run
from stitch.diagnosis.dependence import FOLLOWS, also_clear, dependences, equally_clear
from stitch.diagnosis.systematic_laws import STEP
from stitch.numerics import frames
from stitch.output.comparison.open3d_witness import open3d_witness
from stitch.output.comparison.residual_tables import (
    compare_surfaces,
    compare_targets,
    comparison_document,
    equal_count_bins,
    property_varies,
    view_statistics,
)
from tests.command_line import ended
from tests.diagnosis.freed_blade import freed_blade
from tests.needs import needs_open3d
from tests.output.comparison.compared_views import compared


def clean(seed, views):
    rng = np.random.default_rng(seed)
    properties = {f"j{i}": rng.normal(size=views) for i in range(20)}
    properties |= {f"approach of j{i}": rng.choice([-1.0, 1.0], size=views) for i in range(6)}
    errors = rng.normal(scale=0.012, size=views)
    return errors - errors.mean(), properties


@pytest.mark.slow
@pytest.mark.parametrize("views", [7, 12, 18])
def test_chance_makes_something_clear_in_one_of_twenty_cells_at_most(views):
    cells = [compared(*clean(seed, views)) for seed in range(100)]
    # Ten of a hundred is what a rate of five in a hundred exceeds once in a hundred.
    assert sum(cell.is_clear(cell.places[0]) for cell in cells) <= 10


def test_what_is_off_with_the_approach_is_clear_and_stands_first():
    for seed in range(10):
        errors, properties = clean(seed, 18)
        approach = np.resize([-1.0, 1.0], 18)
        errors = errors + 0.03 * approach
        cell = compared(errors - errors.mean(), properties | {"approach of j3": approach})
        assert cell.places[0].name == "approach of j3" and cell.is_clear(cell.places[0])


def test_properties_with_the_same_bins_are_one_group_and_count_once():
    errors, _ = clean(1, 12)
    j2, j3 = np.random.default_rng(2).normal(size=(2, 12))
    alone = compared(errors, {"j2": j2, "j3": j3})
    cell = compared(errors, {"j2": j2, "torque 2_2": -3 * j2, "j3": j3, "torque 2_3": 2 * j2})
    names = {tuple(t.name for t in group) for group in cell.groups}
    assert names == {("j2", "torque 2_2", "torque 2_3"), ("j3",)}
    assert cell.means == alone.means == 12
    tables = {t["name"]: t for t in comparison_document(cell)["tables"]}
    assert tables["torque 2_2"]["same_bins"] == ["j2", "torque 2_3"] and tables["j3"]["same_bins"] == []


def test_a_bin_and_all_outside_of_it_are_one_mean():
    errors, _ = clean(1, 12)
    assert compared(errors, {"approach of j1": np.resize([-1.0, 1.0], 12)}).means == 1


def test_the_two_ways_to_come_are_two_bins():
    _, bins = equal_count_bins(np.array([0.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0]))
    assert bins.tolist() == [1, 0, 2, 2, 0, 2, 2]
    edges, bins = equal_count_bins(np.array([1.0, -1.0, 1.0]))
    assert edges.tolist() == [-1.0, 0.0, 1.0] and bins.tolist() == [1, 0, 1]


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("approach of j1", [0.0, 0.0, 0.0], False),
        ("approach of j1", [0.0, 1.0, 1.0], False),
        ("approach of j1", [0.0, 1.0, -1.0], True),
        ("humidity_percent", [40.0, 40.0, 40.0], False),
        ("humidity_percent", [0.0, 40.0, 40.0], True),
    ],
)
def test_what_does_not_change_is_left_out(name, values, expected):
    assert property_varies(name, np.array(values)) is expected


def blade_run(seed, hidden, mount="eye_to_hand", views=9):
    measured = measured_blade(seed, views=views, mount=mount, hidden=hidden, pixels=60)
    return measured, run(session_of(measured))


def test_compare_counts_everything_and_shows_the_view_that_is_off():
    measured, result = blade_run(5, {})
    found = compare_surfaces(result)
    assert found.rms == pytest.approx(result.residual_rms, rel=0.05)
    table = found.table("view")
    assert table.views.sum() == len(measured.clouds)
    assert {"range", "incidence", "j5", "time", "humidity_percent"} <= {t.name for t in found.tables}
    total = found.table("range").count.sum()
    assert all(t.count.sum() == total for t in found.tables if t.name != "pair")
    # Each correspondence is seen from both sides with opposite signs.
    assert np.average(table.mean, weights=table.count) == pytest.approx(0, abs=1e-12)


ROWS = 1000.0  # of a view


def sums_by_view(errors, bins, size):
    """(B, V) counts, sums and sums of squares of views that lie in one bin each, without noise of their rows."""
    within = (bins == np.arange(size)[:, None]) * ROWS
    return within, within * errors, within * errors**2


def test_the_p_value_is_that_of_students_t_of_the_views_in_a_bin_against_the_others():
    errors = np.random.default_rng(1).normal(size=12)
    errors -= errors.mean()
    bins = np.arange(12) % 5
    found = view_statistics(*sums_by_view(errors, bins, 5))
    for b in range(5):
        expected = stats.ttest_ind(errors[bins == b], errors[bins != b])
        assert found.p_value[b] == pytest.approx(expected.pvalue)
        assert found.mean[b] / found.mean_sigma[b] == pytest.approx(expected.statistic)


def test_seven_views_in_six_bins_are_no_clearer_than_chance_says():
    rng, bins = np.random.default_rng(2), np.array([0, 1, 2, 3, 4, 5, 5])
    p, sigmas = [], []
    for _ in range(600):
        errors = rng.normal(scale=12.0, size=7)
        found = view_statistics(*sums_by_view(errors - errors.mean(), bins, 6))
        p.append(found.p_value)
        sigmas.append(found.mean_sigma[0])
    # Of 3600 means, five in a hundred.
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.012)
    # One view of seven, off by its scatter of 12 less what all have in common.
    assert np.sqrt(np.mean(np.square(sigmas))) == pytest.approx(12 * np.sqrt(6 / 7), rel=0.1)


def test_points_of_a_view_are_no_samples_where_all_views_lie_in_all_bins():
    rng, small = np.random.default_rng(3), []
    for _ in range(400):
        means = rng.normal(scale=12.0, size=(6, 8)) + rng.normal(scale=3.0, size=8)
        means -= means.mean()
        n = np.full(means.shape, ROWS)
        small.append(view_statistics(n, n * means, n * (means**2 + 900)).p_value < 0.05)
    assert np.mean(small) == pytest.approx(0.05, abs=0.015)


def test_a_bin_without_samples_says_nothing_and_two_views_cannot_be_told_apart():
    n = np.array([[5.0, 0.0], [100.0, 200.0]])
    found = view_statistics(n, n * 2, n * 4, enough=30)
    assert np.isnan(found.p_value[0]) and found.views.tolist() == [0, 2]
    alone = view_statistics(*sums_by_view(np.array([1.0, -1.0]), np.array([0, 1]), 2))
    assert np.isnan(alone.mean_sigma).all() and np.isnan(alone.p_value).all()


def test_a_direction_chosen_for_being_clear_is_less_clear():
    rng, bins, small = np.random.default_rng(4), np.repeat([0, 1], 5), []
    for _ in range(400):
        offsets = rng.normal(size=(10, 3))
        offsets -= offsets.mean(axis=0)
        apart = offsets[bins == 0].mean(axis=0)
        sums = sums_by_view(offsets @ apart / np.linalg.norm(apart), bins, 2)
        small.append([view_statistics(*sums, directions=k).p_value[0] < 0.05 for k in (1, 3)])
    as_if_given, chosen = np.mean(small, axis=0)
    assert chosen <= 0.06 < 0.15 < as_if_given


VIEWS, START = 30, 12


def followed(joints=None, flange=None, seed=4):
    """Of targets on a flange that errs so: joints (V, 6) rad, and the flange in its own frame (V, 6) rad and mm."""
    nothing = np.zeros((VIEWS, 6))
    errors = (nothing if joints is None else joints, nothing if flange is None else flange)
    return compare_targets(run(labelled_cell(seed, views=VIEWS, errors=errors)[0])).followed


@pytest.fixture(scope="module")
def blade():
    return freed_blade(3, 14)


def test_scans_that_only_scatter_follow_nothing(blade):
    found = dependences(blade.seen(blade.measurement.T_base_flange))
    assert found[0].p_value > FOLLOWS and not equally_clear(found) and not also_clear(found)


def test_targets_that_only_scatter_follow_nothing():
    """Two sessions at a hundredth each."""
    assert not any(equally_clear(followed(seed=seed)) for seed in range(2))


def test_a_step_is_told_with_its_view_its_size_and_its_sign():
    """0.3 mm against y of the flange: the views move along it, against the targets that the flange carries."""
    flange = np.zeros((VIEWS, 6))
    flange[START:, 4] = -0.3
    first = followed(flange=flange)[0]
    assert first.covariate == STEP and first.shape == f"a step at view v{START}" and first.p_value < 1e-12
    assert first.direction[1] > 0.98
    assert first.mean[1] - first.mean[0] == pytest.approx(0.3, abs=0.03)
    assert first.bins == pytest.approx([(START - 1) / 2, (START + VIEWS - 1) / 2])


def test_a_joint_is_told_from_time_and_from_the_others():
    session, *_ = labelled_cell(4, views=VIEWS)
    joints = np.zeros((VIEWS, 6))
    joints[:, 4] = 5e-4 * np.sin(session.joints[:, 4])
    found = followed(joints=joints)
    assert found[0].covariate == "j5_deg" and found[0].shape == "a wave, once a turn"
    assert not also_clear(found)


def test_two_things_are_both_told():
    """A step of the flange and a joint's eccentricity: the second stands beside the first."""
    session, *_ = labelled_cell(4, views=VIEWS)
    joints, flange = np.zeros((VIEWS, 6)), np.zeros((VIEWS, 6))
    joints[:, 2] = 1e-3 * np.sin(session.joints[:, 2])
    flange[START:, 4] = 0.3
    found = followed(joints=joints, flange=flange)
    assert found[0].p_beside == 1
    assert {STEP, "j3_deg"} <= {found[0].covariate} | {own.covariate for own in also_clear(found)}


def test_the_document_holds_it_as_lists():
    found = compare_targets(run(labelled_cell(4, views=VIEWS)[0]))
    rows = comparison_document(found)["follows"]
    assert [row["covariate"] for row in rows] == [own.covariate for own in found.followed]
    assert len(rows[0]["direction"]) == 3 and len(rows[0]["at"]) == len(rows[0]["mean"]) == len(rows[0]["sigma"])


@pytest.fixture(scope="module")
def cell():
    """What six views of a blade measured."""
    needs_open3d()
    return measured_blade(0, views=6, mount="eye_in_hand", pixels=60)


@pytest.fixture(scope="module")
def witnessed_run(cell):
    return stitch.run(session_of(cell))


@pytest.fixture(scope="module")
def witness(witnessed_run):
    return open3d_witness(witnessed_run)


def test_the_witness_lies_near_the_truth_and_near_the_run(cell, witnessed_run, witness):
    """Against the simulator, between views: no frame that both would have to share."""
    true = frames.inverse(cell.T_reference_scanner[:-1]) @ cell.T_reference_scanner[1:]
    found = frames.inverse(witness.poses[:-1]) @ witness.poses[1:]
    turn = np.linalg.norm(frames.log(frames.inverse(true) @ found)[:, :3], axis=1)
    assert np.median(turn) < 5e-3
    assert witness.views == tuple(witnessed_run.session.names) and witness.pairs >= len(witness.views) - 1
    spacing = 2.0
    assert np.median(witness.shift) < spacing and np.median(np.abs(witness.to_run)) < spacing / 4


def test_a_view_that_the_run_has_elsewhere_is_the_one_that_differs(witnessed_run, witness):
    """The run's own pose of one view is turned about the part by hand; Open3D starts where the model puts it."""
    poses = witnessed_run.poses.copy()
    poses[2, :3, 3] += [3.0, 0.0, 0.0]
    moved = open3d_witness(witnessed_run.with_fit(poses=poses))
    assert int(np.argmax(moved.shift - witness.shift)) == 2
    assert any(line.startswith(f"{witness.views[2]} differs most") for line in moved.sentences("mm"))


def test_the_side_that_is_nearer_to_the_truth_is_named(cell, witnessed_run, witness):
    """Against the simulator's poses: whoever has the smaller errors between views has the smaller overlaps too."""

    def off(poses):
        true = frames.inverse(cell.T_reference_scanner[:-1]) @ cell.T_reference_scanner[1:]
        apart = frames.log(frames.inverse(true) @ frames.inverse(poses[:-1]) @ poses[1:])
        return np.median(np.linalg.norm(apart[:, 3:], axis=1))

    assert off(witnessed_run.poses) < off(witness.poses)
    ours, theirs = np.median(witness.overlaps, axis=0)
    assert ours < theirs
    rng = np.random.default_rng(4)
    spoilt = witnessed_run.poses @ frames.exp(np.column_stack([np.zeros((6, 3)), rng.normal(0, 0.5, (6, 3))]))
    worse = open3d_witness(witnessed_run.with_fit(poses=spoilt))
    assert off(spoilt) > off(worse.poses)
    ours, theirs = np.median(worse.overlaps, axis=0)
    assert theirs < ours
    assert any(line.startswith("Open3D is nearer in") for line in worse.sentences("mm"))


def test_compare_with_open3d_writes_the_witness_and_says_what_differs(witnessed_run, witness, tmp_path):
    folder = witnessed_run.save(tmp_path / "run", recording=False)
    printed = ended("compare", folder, "--with", "open3d")
    told = " ".join(printed.out.split())
    assert "registered the same scans by" in told and "From its cloud to this one: half within" in told
    document = json.loads((folder / "witness.json").read_text())
    assert [row["view"] for row in document["views"]] == list(witness.views)
    # On one thread Open3D repeats to the last bit.
    again = open3d_witness(stitch.load_run(folder))
    assert [row["shift"] for row in document["views"]] == again.shift.tolist()
    assert (folder / "witness.png").stat().st_size > 10_000


def test_where_open3d_is_missing_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    for program, said in (("open3d", "Open3D is not installed"), ("pcl", "--with pcl: to fix: open3d")):
        told = ended("compare", tmp_path, "--with", program, code=2)
        assert said in told.err
