"""A law that no library has, found as a formula; nothing found where there is nothing; a file that can be added."""

import json

import numpy as np
import pytest

from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.cli.main import main
from stitch.diagnosis.diagnose import linear_model_of
from stitch.plugins.explain.dictionary import backlash_lag, build_dictionary, view_quantities
from stitch.plugins.explain.explain import explain
from stitch.plugins.explain.search import search_sums
from stitch.session.measurement import views_of

SIZE = 3e-4  # rad


def coupling(q):
    """Joints 2 and 3 drag each other."""
    return SIZE * np.array([0, 0, np.sin(q[2]) * np.sin(2 * q[1]), 0, 0, 0])


def evidence(seed, gears=None, views=60, **options):
    session, *_ = labelled_cell(seed, views=views, targets=TARGETS[:2], gears=gears, **options)
    return linear_model_of(run(session))


def test_a_coupling_of_two_joints_is_found_with_its_size():
    found = explain(evidence(1, coupling))
    assert found.found and found.place == "robot" and "sin q3·sin 2q2" in found.formula
    size = float(found.formula.split("q3 ")[1].split(" rad")[0])
    assert size == pytest.approx(SIZE, rel=0.1)
    assert found.p_value < 1e-6 and found.heldout_share < 0.6


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_all_views_say_which_formula_it_is(seed):
    """Fourteen views: some of them may suggest a relative of the law, which then stood the test, and that is said."""
    linear = evidence(seed, coupling, views=14)
    told = search_sums(linear, build_dictionary(linear, view_quantities(linear.measurement.views)))[0]
    assert told.holds and told.instead_of
    found = explain(linear)
    assert "sin q3·sin 2q2" in found.formula
    suggested = {(i.what, i.quantity.text) for i in told.instead_of}
    assert ("likeliest in all views" in found.why) == (suggested != {("q*3", "sin q3·sin 2q2")})
    # Of another formula than the one that is told p says how that one stood the test.
    assert (found.tested != found.formula) == ("likeliest in all views" in found.why)
    assert ("of this one alone" in found.why.split(found.tested)[-1]) == (found.tested != found.formula)


def test_a_play_that_moved_a_little_is_the_same_and_another_wave_or_joint_is_not():
    session, *_ = labelled_cell(3, views=12)
    views = views_of(session)
    play = backlash_lag(views, 4, 0.30)
    assert play.nearly(backlash_lag(views, 4, 0.31)) and not play.nearly(backlash_lag(views, 4, 0.9))
    assert not play.nearly(backlash_lag(views, 3, 0.30))
    waves = {q.text: q for q in view_quantities(views)}
    assert waves["sin 7q2"].nearly(waves["sin 7q2"]) and not waves["sin 7q2"].nearly(waves["sin 8q2"])


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2, 3, 4))])
def test_scatter_alone_gets_no_formula(seed):
    assert not explain(evidence(50 + seed)).found


def test_codes_of_quantities_give_their_values():
    session, *_ = labelled_cell(3, views=12, payload=np.linspace(1, 4, 12))
    views = views_of(session)
    for quantity in view_quantities(views):
        np.testing.assert_allclose(
            eval(quantity.code, {"np": np, "views": views}),
            quantity.values,
            rtol=1e-5,
            atol=1e-7,
            err_msg=quantity.text,
        )


def test_columns_are_what_the_displacement_does():
    """One ingredient put into the joints of the simulated arm moves the targets as its column says."""
    linear = evidence(4, views=20)
    terms = build_dictionary(linear, view_quantities(linear.measurement.views))
    own = next(i for i in terms.ingredients if i.what == "q*3" and i.quantity.text == "sin q3·sin 2q2")
    column, scale = terms.columns([own])[:, 0], np.abs(own.quantity.values).max()
    rows = linear.observation.rows.residual.ravel()
    moved = evidence(4, coupling, views=20).observation.rows.residual.ravel()
    # The fit of each session takes what hand-eye and targets can of it; what remains must be the column's remainder.
    free = linear.design
    left = moved - rows - column * scale * -SIZE
    rest = left - free @ np.linalg.lstsq(free, left, rcond=None)[0]
    whole = moved - rows
    whole = whole - free @ np.linalg.lstsq(free, whole, rcond=None)[0]
    assert np.linalg.norm(rest) < 0.05 * np.linalg.norm(whole)


def test_the_file_that_is_written_can_be_added(tmp_path, stitch_command, monkeypatch, no_drawing):
    monkeypatch.chdir(tmp_path)
    session, *_ = labelled_cell(1, views=60, targets=TARGETS[:2], gears=coupling)
    stitch_command("run", write_labelled(tmp_path / "s", session), "-o", "r", "--no-recording")
    told = json.loads(stitch_command("explain", "r", "-o", "mine.py", "--json"))
    assert told["found"] and told["place"] == "robot"
    before = json.loads((tmp_path / "r" / "result.json").read_text())["heldout_rms"]
    stitch_command("add", "r", "explained", "--effects-file", "mine.py", "--no-recording")
    after = json.loads((tmp_path / "r" / "result.json").read_text())
    assert after["heldout_rms"] < 0.8 * before
    assert after["heldout_rms"] == pytest.approx(told["heldout_rms"], rel=0.15)
    assert told["tested_formula"] == told["formula"]
    assert after["effects"]["explained"]["a"]["value"] == pytest.approx(SIZE, rel=0.1)
    # A second one by that name would take the first one's place unseen.
    with pytest.raises(SystemExit) as stop:
        main(["explain", "r", "--effects-file", "mine.py"])
    assert stop.value.code == 2


@pytest.mark.parametrize(("output", "told"), [("mine.txt", "mine.py"), ("there.py", "exists already")])
def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path, monkeypatch, capsys, output, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.py").write_text("# mine\n")
    with pytest.raises(SystemExit) as stop:
        main(["explain", "r", "-o", output])
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert told in line and line.count("\n") == 1
    assert (tmp_path / "there.py").read_text() == "# mine\n"
