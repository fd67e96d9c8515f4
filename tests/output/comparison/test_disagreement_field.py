"""The field of disagreement against the truth of simulated cells, and what its history says for everybody."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade, measured_blade
from data_synth.made_session import make
from data_synth.simulate import simulate
from data_synth.write import write_session
from stitch.api.pipeline import change, run
from stitch.numerics import frames
from stitch.observations.surfaces.matching import sample_points, signed_distances
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.output.comparison.disagreement_field import patches_of
from stitch.output.comparison.model_history import model_history
from stitch.output.comparison.run_verdict import plain_verdict
from stitch.output.result_document import result_document
from stitch.output.run_folder import write_with_page
from stitch.output.stored_run import load_run
from stitch.session.reading.session_folder import load_session

HIDDEN = {"joint_compliance": 2.0}


@pytest.fixture(scope="module")
def bent():
    """A blade cell in which two joints give way under load, with an arm that repeats well."""
    return measured_blade(3, views=10, pixels=65, hidden=HIDDEN, repeatability=(5e-6, 0.005))


@pytest.fixture(scope="module")
def changed(bent, tmp_path_factory):
    """Its run with the compliance added."""
    return with_compliance(bent, tmp_path_factory.mktemp("bent") / "s")


def with_compliance(measured, folder):
    write_session(folder, measured, "bent")
    return change(run(load_session(folder)), ["joint_compliance"])


def lacked_and_taken(changed, T_reference_scanner):
    """What the first model lacked by the true poses, on the same places, and what the second took away."""
    history, middles = model_history(changed), changed.registered.matches
    before, after = history.models
    away = before.poses @ frames.inverse(T_reference_scanner)
    off = [frames.transform(away[m.v], m.middle) - frames.transform(away[m.w], m.middle) for m in middles]
    lacked = np.concatenate([np.einsum("ij,ij->i", x, m.normal) for x, m in zip(off, middles, strict=True)])
    truth, taken = history.patches.field(lacked).values, before.field.values - after.field.values
    seen = np.isfinite(truth)
    return truth[seen], taken[seen]


def test_what_an_added_effect_takes_away_is_what_the_model_lacked(bent, changed):
    lacked, taken = lacked_and_taken(changed, bent.T_reference_scanner)
    assert np.corrcoef(lacked, taken)[0, 1] >= 0.9


@pytest.mark.slow
def test_the_same_in_the_cell_of_the_demo(tmp_path):
    """There the arm scatters as much again: the truth is where it stood but for that."""
    measured = make("blade", HIDDEN, 3)
    quiet = replace(measured.scene, repeatability=(0.0, 0.0))
    truth = simulate(quiet, HIDDEN, 3, planned=(measured.plan, measured.rail)).T_reference_scanner
    lacked, taken = lacked_and_taken(with_compliance(measured, tmp_path / "s"), truth)
    assert np.corrcoef(lacked, taken)[0, 1] >= 0.9


def test_steps_are_named_and_every_one_helps(changed):
    steps = model_history(changed).steps
    assert [step.name for step in steps] == ["coarse", "hand-eye alone", "+ joint_compliance", "register"]
    means = [step.field.mean_abs for step in steps]
    assert sorted(means, reverse=True) == means


def still_blade():
    """True poses of a blade's views by an arm that does not scatter, their points, and what overlaps there."""
    measured, capture = captured_blade(1, views=6, pixels=90, repeatability=(0.0, 0.0))
    T = measured.T_reference_scanner
    overlaps = collect_overlaps(capture, T, 1.5, [sample_points(scan, 3000) for scan in capture.scans])
    return T, [scan.points for scan in capture.scans], overlaps


def test_the_standard_error_of_a_patch_is_its_scatter_about_the_truth():
    """With true poses all that is left is noise: values in units of their standard errors are normal."""
    T, points, overlaps = still_blade()
    e = signed_distances(overlaps.matches, T, points)
    field = patches_of(overlaps.matches, len(T), overlaps.gram.scale, model_distances=e).field(e)
    z = (field.values / field.sigma)[np.isfinite(field.values)]
    # A standard error from a few cells is good to a factor; the median |z| of a normal variable is 0.6745.
    assert 1 / 1.5 < np.median(np.abs(z)) / 0.6745 < 1.5
    assert field.mean_abs == pytest.approx(field.noise, rel=0.25)


def test_a_view_that_is_moved_lies_off_by_its_motion():
    T, points, overlaps = still_blade()
    shift = np.array([0.11, -0.07, 0.05])
    moved = T.copy()
    moved[2, :3, 3] += shift
    e = [signed_distances(overlaps.matches, poses, points) for poses in (T, moved)]
    patches = patches_of(overlaps.matches, len(T), overlaps.gram.scale, model_distances=e[1])
    gained = patches.field(e[1]).values - patches.field(e[0]).values
    seen = np.isfinite(gained[2])
    # Where the part bends within a patch its normal is one of many.
    off = np.abs(gained[2][seen] - patches.normals[seen] @ shift) / np.linalg.norm(shift)
    assert np.quantile(off, 0.75) < 0.1


def test_the_history_is_the_same_when_it_is_read_again(changed, tmp_path):
    write_with_page(changed, tmp_path)
    again = model_history(load_run(tmp_path))
    stated = result_document(changed)["disagreement"]
    assert [s.name for s in again.steps] == [row["step"] for row in stated["steps"]]
    np.testing.assert_allclose(
        [s.field.mean_abs for s in again.steps], [row["mean"] for row in stated["steps"]], rtol=1e-6
    )


def history(*names):
    """Steps between coarse and register whose views disagree by 100, 90, 80 … µm, 5 µm after register."""
    models = [
        SimpleNamespace(name=name, field=SimpleNamespace(mean_abs=0.1 - 0.01 * i)) for i, name in enumerate(names)
    ]
    register = SimpleNamespace(name="register", field=SimpleNamespace(mean_abs=0.005))
    return SimpleNamespace(models=models, steps=(*models, register))


def test_an_effect_that_was_dropped_again_has_brought_nothing():
    told = plain_verdict(history("hand-eye alone", "+ backlash", "− backlash"), "mm")
    assert "backlash" not in told and "the views disagree by 80 µm" in told and "5 µm remain" in told


def test_what_was_added_and_stayed_is_named_with_all_that_it_brought():
    told = plain_verdict(history("hand-eye alone", "+ backlash", "+ settling, − backlash", "+ latency"), "mm")
    assert told.startswith("Adding settling and latency brought the views from 100 µm to 70 µm of each other")
