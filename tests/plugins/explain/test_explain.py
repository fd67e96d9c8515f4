"""A formula is found where there is one, tested in views that took no part, and written as a file of effects.

What is told of a formula and its file: lengths in mm in any session, and what its code reads of the views.

Teeth of a belt and springs that stiffen: found as what they are, of as few numbers as they have.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from data_synth import kinematics
from data_synth.fixtures.labelled_arm import TARGETS, labelled_cell
from data_synth.fixtures.labelled_files import write_labelled
from stitch.api.pipeline import run
from stitch.diagnosis.diagnose import linear_model_of
from stitch.effects.contract import EFFECTS, missing_need
from stitch.effects.user_file import load
from stitch.numerics import frames
from stitch.plugins.explain.dictionary import Ingredient, build_dictionary, coefficient
from stitch.plugins.explain.explain import effect_source, explain, formula_text
from stitch.plugins.explain.quantities import Quantity, backlash_lag, nonlinear_torque, saw_of_joint, view_quantities
from stitch.plugins.explain.search import search_sums
from stitch.session.measurement import views_of
from stitch.session.torques import no_torques
from tests.command_line import ended
from tests.diagnosis.freed_blade import freed_blade

SIZE = 3e-4  # rad
SHIFT = 8e-5  # m, where the payload is largest
TOOTH, HEIGHT = 0.33, 8e-4  # rad


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
    scale, reduction = np.abs(own.quantity.values).max(), linear.observation.reduction
    column = reduction.expand(linear.in_blocks(terms.columns([own])))[..., 0].ravel() / reduction.per_sigma.ravel()
    rows = linear.observation.rows
    moved = evidence(4, coupling, views=20).observation.rows.residual.ravel()
    # The fit of each session takes what hand-eye and targets can of it; what remains must be the column's remainder.
    free = np.concatenate([rows.hand_eye, rows.landmarks], axis=2).reshape(len(column), -1)
    left = moved - rows.residual.ravel() - column * scale * -SIZE
    rest = left - free @ np.linalg.lstsq(free, left, rcond=None)[0]
    whole = moved - rows.residual.ravel()
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
    ended("explain", "r", "--effects-file", "mine.py", code=2)


@pytest.mark.parametrize(("output", "told"), [("mine.txt", "mine.py"), ("there.py", "exists already")])
def test_a_place_that_cannot_be_written_is_refused_in_one_line(tmp_path, monkeypatch, output, told):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.py").write_text("# mine\n")
    line = ended("explain", "r", "-o", output, code=2).err
    assert told in line and line.count("\n") == 1
    assert (tmp_path / "there.py").read_text() == "# mine\n"


VIEWS = 18


# Of the flange in its own frame, rad and mm.
DIRECTION = np.array([2.2e-4, -1.5e-4, 2.8e-4, 0.08, 0.05, -0.07])


@pytest.fixture(scope="module")
def cell():
    return freed_blade(6, VIEWS)


@pytest.mark.slow
def test_a_flange_that_swings_gets_the_formula_of_a_swing(cell, tmp_path):
    seconds = cell.measurement.views.time
    period = seconds[-1] / 3.5
    swing = np.cos(2 * np.pi * seconds / period - 0.6)
    found = explain(cell.seen(cell.measured.T_base_flange @ frames.exp(2 * swing[:, None] * DIRECTION)))
    assert found.found and found.place in ("mount", "part")
    assert float(re.search(r"t/([0-9.]+) h", found.formula)[1]) == pytest.approx(period / 3600, rel=0.1)
    # The part is carried: it moves against the flange.
    assert found.heldout_share < 0.6
    (tmp_path / "mine.py").write_text(found.source)
    assert load(tmp_path / "mine.py") == ["explained"]


@pytest.mark.slow
def test_a_joint_that_swings_in_time_gets_the_formula_of_a_swing(cell):
    joints, seconds = cell.measured.plan.joints, cell.measurement.views.time
    period = seconds[-1] / 1.3
    error = np.zeros_like(joints)
    error[:, 4] = 5e-4 * np.cos(2 * np.pi * seconds / period - 0.6)
    found = explain(cell.seen(kinematics.flange(cell.measured.plan.arm, joints + error)))
    assert found.found and found.formula.startswith("q*5 = q5")
    # Half a turn of phase is the other sign.
    amplitude = float(re.search(r"([-+0-9.]+) rad · cos\(2π t/", found.formula)[1])
    assert abs(amplitude) == pytest.approx(5e-4, rel=0.2)
    assert float(re.search(r"t/([0-9.]+) h", found.formula)[1]) == pytest.approx(period / 3600, rel=0.1)


@pytest.mark.slow
def test_a_gear_with_friction_gets_the_formula_of_what_stays_behind(cell):
    joints = cell.measured.plan.joints
    driven, play, stays = joints[:, 2], 0.25 * np.ptp(joints[:, 2]), [joints[0, 2]]
    for q in driven[1:]:
        stays.append(np.clip(stays[-1], q - play, q + play))
    behind = np.array(stays) - driven
    error = np.zeros_like(joints)
    error[:, 2] = 5e-4 * behind / behind.std()
    found = explain(cell.seen(kinematics.flange(cell.measured.plan.arm, joints + error)))
    assert found.found and "behind q3" in found.formula, found.why


@pytest.mark.slow
def test_scatter_gets_no_formula(cell):
    assert not explain(cell.seen(cell.measured.T_base_flange)).found


SAID = "Nothing can be said from {} views"


@pytest.mark.parametrize("views", [2, 3, 4])
def test_of_few_scans_nothing_is_said(views):
    cell = freed_blade(6, views)
    found = explain(cell.seen(cell.measured.T_base_flange))
    assert not found.found and found.why.startswith(SAID.format(views))


@pytest.mark.parametrize("views", [3, 5])
def test_of_few_sightings_nothing_is_said(views):
    assert explain(evidence(1, coupling, views=views)).why.startswith(SAID.format(views))


def test_three_views_of_either_half_may_say_something():
    assert explain(evidence(1, coupling, views=6)).why.startswith("No formula holds")


def measured_views(count=12):
    """With all that a session may know of its views."""
    session, *_ = labelled_cell(3, views=count, payload=np.linspace(1, 4, count))
    views = views_of(session)
    turning = np.gradient(views.joints, axis=0)
    return replace(views, time=np.arange(count) * 60.0, velocity=turning)


def loaded(source, tmp_path):
    (tmp_path / "mine.py").write_text(source, encoding="utf-8")
    load(tmp_path / "mine.py")
    return EFFECTS["explained"]


@pytest.mark.parametrize(("unit", "size"), [("m", SHIFT), ("mm", 1e3 * SHIFT)])
def test_a_displacement_is_told_in_mm_whatever_the_session_is_in(unit, size, tmp_path):
    payload = next(q for q in view_quantities(measured_views()) if q.text == "payload_kg")
    own = [Ingredient("part", axis, payload) for axis in (0, 3)]
    values = [coefficient(i, x, unit) for i, x in zip(own, (3e-4, size), strict=True)]
    text = formula_text(own, values)
    # The payload grows by 3 kg.
    assert text == "part rx, tx = (+0.0001) rad/(payload_kg), (+0.027) mm/(payload_kg) · payload_kg"
    parameters = loaded(effect_source("explained", own, values, text), tmp_path).parameters(6, (), unit)
    assert parameters[1].typical == pytest.approx(size / 3, rel=0.02)


def test_quantities_read_no_more_of_the_views_than_they_say():
    whole, seen = measured_views(), set()
    for quantity in view_quantities(whole):
        own, has = quantity.needs, set(quantity.needs)
        bare = replace(
            whole,
            **{} if "joints" in has else dict.fromkeys(("joints", "previous", "approach", "path")),
            time=whole.time if "time" in has else None,
            velocity=whole.velocity if "velocity" in has else None,
            torques=whole.torques if "torque" in has else no_torques(whole.count),
            covariates={name: course for name, course in whole.covariates.items() if name in has},
        )
        values = eval(quantity.code, {"np": np, "views": bare})
        np.testing.assert_allclose(values, quantity.values, rtol=1e-5, atol=1e-7, err_msg=f"{quantity.text} {own}")
        seen |= has
    assert seen == {"joints", "time", "velocity", "torque", "payload_kg"}


@pytest.mark.parametrize(("place", "written"), [("part", '("payload_kg",)'), ("robot", '("joints", "payload_kg")')])
def test_a_file_that_reads_a_column_is_not_asked_where_there_is_none(place, written, tmp_path):
    found = {q.text: q for q in view_quantities(measured_views())}
    followed = found["payload_kg"] if place == "part" else found["sin q2"].times(found["payload_kg"])
    source = effect_source("explained", [Ingredient(place, 1, followed)], [1e-4], "Found.")
    assert f"needs={written}," in source
    effect = loaded(source, tmp_path)
    assert missing_need(evidence(1, views=8).measurement, effect) == ("payload_kg",)
    assert not missing_need(evidence(1, views=8, payload=np.linspace(1, 4, 8)).measurement, effect)


def belt(q):
    """Joint 3 creeps by `HEIGHT` along each tooth and jumps back."""
    teeth = q[2] / TOOTH + 0.3
    return HEIGHT * np.array([0, 0, teeth - np.floor(teeth) - 0.5, 0, 0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("views", [40, 80])
def test_a_belt_that_jumps_is_found_with_its_tooth(views):
    session, *_ = labelled_cell(1, views=views, targets=TARGETS[:2], gears=belt)
    found = explain(linear_model_of(run(session)))
    assert found.found and found.formula.startswith("q*3 = q3")
    (saw,) = re.findall(r"([-+0-9.e]+) rad · saw of q\d, a tooth ([0-9.]+)°", found.formula)
    size, tooth = map(float, saw)
    assert size == pytest.approx(HEIGHT, rel=0.1) and np.radians(tooth) == pytest.approx(TOOTH, rel=0.02)


def test_a_saw_jumps_where_it_says_and_belongs_to_its_own_joint():
    views = views_of(labelled_cell(3, views=12)[0])
    saw = saw_of_joint(views, 1, 0.2, 0.05)
    at_jump = saw_of_joint(views, 1, 0.2, float(views.joints[4, 1]))
    assert abs(at_jump.values[4]) == pytest.approx(0.5)
    assert saw_of_joint(views, 1, 0.2, 0.05 + 3 * 0.2).text == saw.text
    slope = np.diff(saw.values) - np.diff(views.joints[:, 1]) / 0.2
    np.testing.assert_allclose(slope, np.round(slope), atol=1e-9)  # whole teeth are jumped over
    assert {q.joint for q in view_quantities(views) if q.kind == "teeth"} <= set(range(6))
    linear = linear_model_of(run(labelled_cell(3, views=12)[0]))
    of_teeth = [i for i in build_dictionary(linear, view_quantities(views)).ingredients if i.quantity.kind == "teeth"]
    assert of_teeth and all(i.index == i.quantity.joint for i in of_teeth)


@pytest.mark.parametrize("torque", [np.linspace(570, 612, 18), np.linspace(-5, 7, 18)], ids=["far from 0", "about 0"])
def test_what_no_line_does_is_left_of_a_power(torque):
    """Far from zero a cube is nearly a line: as it stands nothing of it would count as its own."""
    cube = cube_of(torque)
    beside = np.vander(torque - torque.mean(), 2)
    shares = beside.T @ cube.values / np.linalg.norm(beside, axis=0) / np.linalg.norm(cube.values)
    np.testing.assert_allclose(shares, 0, atol=1e-6)
    np.testing.assert_allclose(eval(cube.code, {"torque": torque}), cube.values, atol=1e-6 * np.abs(cube.values).max())
    step = (torque[1] - torque[0]) / float(f"{np.abs(torque).max():.3g}")
    np.testing.assert_allclose(np.diff(cube.values, 3), 6 * step**3, rtol=1e-3)


@pytest.mark.parametrize("torque", [np.repeat([570.0, 612.0], 6), 600 + np.linspace(0, 1e-6, 12)])
def test_of_few_torques_or_hardly_different_ones_nothing_is_left_but_rounding(torque):
    assert cube_of(torque) is None


def cube_of(torque):
    return nonlinear_torque(Quantity("τ", "torque", "N m", "torque", 2, torque), lambda x: x**3, "x³", "x**3")
