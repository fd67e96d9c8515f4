"""Diagnoses of cells whose truth is known: scans of a blade, labelled points, scanners that err by no law of the library."""

import json
from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured, measured_blade
from data_synth.fixtures.in_memory import session_of
from data_synth.fixtures.labelled_arm import TABLE, TARGETS, labelled_cell
from stitch.api.pipeline import change, diagnose, run
from stitch.api.stepwise import suggest
from stitch.diagnosis.diagnose import diagnose_state, linear_model_of
from stitch.diagnosis.score import ScatterLimit, beyond_expected, expected_scatter, scatter_limit
from stitch.diagnosis.stepwise_selection import find_effect_to_drop
from stitch.diagnosis.systematic_laws import drivers_of
from stitch.effects.empirical import FIELD, empirical_effects
from stitch.numerics import frames
from stitch.output.diagnosis_document import diagnosis_document
from stitch.output.json_file import to_json
from stitch.session.measurement import measurement_of
from stitch.session.session import StatedRepeatability


def blade_run(seed, hidden, mount="eye_to_hand", views=12, plan_seed=None, pixels=90):
    measured = measured_blade(seed, views=views, mount=mount, hidden=hidden, pixels=pixels, plan_seed=plan_seed)
    return measured, run(session_of(measured))


@pytest.fixture(scope="module")
def nothing_hidden():
    """A run of a cell in which nothing is hidden, and its diagnosis."""
    _, result = blade_run(11, {}, "eye_in_hand", views=9, plan_seed=1, pixels=60)
    return result, diagnose(result)


# Sizes that are two to four times what these cells can show at the least.
VISIBLE = [
    ("joint_offset", "eye_in_hand", 4.0),
    ("joint_compliance", "eye_to_hand", 3.0),
    ("lens_distortion", "eye_to_hand", 3.0),
]


# In `make test` by the commands and in the browser: test_diagnosis_commands.py, test_review_in_browser.py.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "mount", "size"), VISIBLE)
def test_a_hidden_effect_is_named_added_and_the_error_falls(name, mount, size):
    measured, before = blade_run(1, {name: size}, mount)
    found = diagnose(before)
    assert found.verdict in ("missing_effect", "cannot_tell"), found.sentence
    assert name in found.effects, found.sentence
    after = change(before, [name])
    assert after.residual_rms < before.residual_rms
    assert after.heldout_rms < before.heldout_rms
    assert [s.effects for s in after.ledger] == [(), (name,)]
    # What the linear prediction promised comes true when everything is fitted and matched anew.
    left = next(s.cross_validation for s in found.candidates if s.name == name)
    assert after.residual_rms == pytest.approx(before.residual_rms * np.sqrt(left.inside), rel=0.15)
    # The truth, which no overlap knows, comes nearer too: a fit that borrows from the hand-eye would not show above.
    errors = [frames.log(frames.inverse(measured.T_mount) @ r.T_mount)[3:] for r in (before, after)]
    assert np.linalg.norm(errors[1]) < max(
        np.linalg.norm(errors[0]), 3 * np.sqrt(np.trace(after.mount_covariance[3:, 3:]))
    )
    told = measured.hidden[name]
    z = [(p.value - told.get(p.name, 0.0)) / p.sigma for p in after.terms[0].parameters if p.fitted and not p.grid]
    assert np.max(np.abs(z)) < 4.0


def test_nothing_hidden_is_adequate(nothing_hidden):
    _, found = nothing_hidden
    assert found.verdict == "adequate", found.sentence
    assert 5e-6 < found.rotation < 6e-5
    assert 5e-3 < found.translation < 6e-2


@pytest.mark.slow
@pytest.mark.parametrize(("name", "follows"), [("covariate_bias", "humidity_percent")])
def test_an_effect_that_the_library_does_not_know_gets_no_name(name, follows):
    _, result = blade_run(2, {name: 4.0}, "eye_in_hand", 14)
    found = diagnose(result)
    assert found.verdict == "unknown_effect", found.sentence
    assert not found.effects
    assert follows in [d.covariate for d in found.depends_on[:3]]


@pytest.mark.slow
def test_offset_of_the_first_joint_is_never_named_where_the_hand_eye_hides_it():
    """eye_to_hand: joint 1 turns everything about one axis of the base; that is a hand-eye."""
    measured = measured_blade(3, views=16, pixels=90)
    session = session_of(measured)
    result = change(run(session), ["joint_offset"])
    offsets, sigmas = result.terms[0].values, result.terms[0].sigmas
    assert offsets[0] == 0.0
    assert np.isnan(sigmas[0])
    assert offsets[5] == 0.0  # the last joint moves the whole part
    assert np.isnan(sigmas[5])


@pytest.mark.slow
def test_turning_the_last_joint_alone_names_nothing():
    measured = measured_blade(
        4, views=10, pixels=90, tilt=0.0, roll=0.0, aim=0.0, distance=0.0, hidden={"joint_offset": 3.0}
    )
    found = diagnose(run(session_of(measured)))
    assert found.verdict in ("adequate", "cannot_tell")


@pytest.mark.slow
def test_prediction_of_the_null_is_the_present_residual():
    _, result = blade_run(6, {})
    linear = linear_model_of(result)
    g, present = linear.observation.unconstrained.overlaps.gram, linear.baseline_trial
    assert np.sqrt(present.squares(present.solve()).sum() / g.weight.sum()) == pytest.approx(
        result.residual_rms, rel=0.15
    )


def test_document_has_no_infinite_number(nothing_hidden):
    text = to_json(diagnosis_document(nothing_hidden[1]))
    assert json.loads(text)["verdict"] == "adequate"


def test_what_stands_against_a_candidate_is_as_likely_as_the_posteriors_say(nothing_hidden):
    document = json.loads(to_json(diagnosis_document(nothing_hidden[1])))
    seen = {row["effect"]: row["posterior"] for row in document["candidates"] if row["observable"]}
    for row in document["candidates"]:
        rivals = {rival["what"]: rival["log_odds"] for rival in row["against"]}
        assert row["effect"] not in rivals and list(rivals.values()) == sorted(rivals.values())
        assert len(rivals) == (5 if row["observable"] else 0)
        for what in rivals.keys() & {name for name, posterior in seen.items() if posterior > 1e-12}:
            assert rivals[what] == pytest.approx(np.log(row["posterior"] / seen[what]), abs=1e-6)
    # Nothing is the likeliest here, and no name holds perhaps only.
    assert document["certain"] is True and document["candidates"][0]["against"][0]["what"] == "nothing"


def test_a_hidden_joint_offset_is_named_and_found():
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(2, views=40, offset=offset)
    before = run(session)
    found = diagnose(before)
    assert "joint_offset" in found.effects, found.sentence
    after = change(before, ["joint_offset"])
    assert after.heldout_rms < 0.2 * before.heldout_rms
    values = {p.name: p.value for p in after.terms[0].parameters}
    for name, true in zip(("d2", "d3", "d5"), offset[[1, 2, 4]], strict=True):
        assert values[name] == pytest.approx(true, abs=2e-4)


@pytest.mark.slow
def test_offsets_and_gravity_together_are_found_by_their_names(few_effects):
    # Gravity on the flange's mass turns joint 2 by what the flange reaches out: 2 µrad a millimetre.
    offset = np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0])
    session, *_ = labelled_cell(9, views=100, offset=offset, sag=2e-6, targets=TARGETS[:2])
    found, lines, _ = suggest(run(session), 3)
    assert set(found.effects) == {"joint_offset", "joint_compliance"}, lines
    assert found.heldout_rms < 0.1


def test_an_effect_that_another_made_idle_is_dropped():
    session, *_ = labelled_cell(12, views=100, offset=np.array([0, 1e-3, -1.5e-3, 0, 2e-3, 0]), targets=TARGETS[:2])
    state = run(session, effects=["gear_eccentricity", "joint_offset"])
    name, reason = find_effect_to_drop(state, {"gear_eccentricity", "joint_offset"})
    assert name == "gear_eccentricity", reason
    assert find_effect_to_drop(run(session, effects=["joint_offset"]), {"joint_offset"}) is None


def test_an_honest_cell_is_adequate():
    session, *_ = labelled_cell(5, views=40)
    found = diagnose(run(session))
    assert found.verdict == "adequate", found.sentence


@pytest.mark.parametrize("mount", ["eye_to_hand", pytest.param("eye_in_hand", marks=pytest.mark.slow)])
def test_growth_is_found_wherever_the_part_is_held(mount):
    """No session says which point of a part stands still; the flange and the robot's base need not be near it."""
    still = TARGETS[0] + [80.0, -40.0, -90.0] + (0 if mount == "eye_to_hand" else TABLE)
    session, *_ = labelled_cell(4, mount=mount, grown=(2e-4, still))
    found = run(session)
    assert diagnose(found).effects == ("part_growth",)
    found = run(session, effects=["part_growth"])
    values, sigmas = found.terms[0].values, found.terms[0].sigmas
    true = 2e-4 * np.append(1.0, found.measurement.target_views[0].origin - still)
    assert (sigmas < [1e-5, 2e-3, 2e-3, 2e-3]).all()  # mm: a quarter of the motion of the middle
    assert (np.abs(values - true) < 4 * sigmas).all()


@pytest.mark.usefixtures("few_effects")
def test_hand_eye_is_pushed_by_what_is_too_small_to_be_seen():
    """Offsets of the smallest detectable size, put into the same measurements joint by joint."""
    session, *_ = labelled_cell(5)
    found = run(session)
    suspect = next(s for s in diagnose(found).candidates if s.name == "joint_offset")
    sizes = [min(suspect.detectable.get(f"d{i + 1}", np.inf), 1e-3) for i in range(6)]
    middle = np.mean([v.sighting.points.mean(axis=0) for v in session.views], axis=0)
    pushed = []
    for size, own in zip(sizes, np.eye(6), strict=True):
        T = np.linalg.inv(found.T_mount) @ run(labelled_cell(5, offset=size * own)[0]).T_mount
        pushed.append(np.linalg.norm(T[:3, :3] @ middle + T[:3, 3] - middle))
    seen = [np.isfinite(suspect.detectable.get(f"d{i + 1}", np.inf)) for i in range(6)]
    assert suspect.hand_eye == pytest.approx(np.max(np.array(pushed)[seen]), rel=0.2)


def diagnosed(measured, seen=lambda points: points):
    """The diagnosis of a run in which the scanner reports true points (N, 3) so."""
    clouds = [replace(c, points=seen(c.points)) for c in measured.clouds]
    return diagnose_state(run(session_of(replace(measured, clouds=clouds))))


@pytest.fixture(scope="module")
def measured():
    return measured_blade(4, views=9, pixels=50)


def tilted(points):
    """A focus that is bent to two corners: 0.3 mm along the ray at them."""
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    field = points[:, :2] / points[:, 2:]
    return points + 0.3 * np.prod(field / np.abs(field).max(axis=0), axis=1, keepdims=True) * ray


@pytest.mark.parametrize(
    "seen",
    [
        pytest.param(lambda points: points + 0.01 * points[:, [1]] * [1, 0, 0], id="askew", marks=pytest.mark.slow),
        pytest.param(tilted, id="tilted"),
    ],
)
def test_a_scanner_of_bad_axes_or_focus_gets_no_name(measured, seen):
    found = diagnosed(measured, seen)
    assert found.verdict == "unknown_effect" and not found.effects
    assert "where in the scanner's field a point is seen" in found.sentence
    assert "pose errors dominate" not in found.sentence


@pytest.mark.slow
def test_a_range_axis_that_is_too_long_is_named_with_its_share(measured):
    """z too long by 1 %: about the standoff that is a range that errs by 1 % of the way from there, and a shift."""
    found = diagnosed(measured, lambda points: points * [1, 1, 1.01])
    assert found.effects == ("range_nonlinearity",) and not any("stock" in doubt for doubt in found.doubts)
    scored = found.named[0].score
    slope = dict(zip([p.name for p in scored.form.free], scored.values, strict=True))["s"]
    assert slope == pytest.approx(0.01 * found.linear.measurement.views.standoff, rel=0.1)


def test_a_good_scanner_is_not_accused(measured, library_of):
    with library_of():
        found = diagnosed(measured)
    assert not found.follows_field and not found.overlap_misfit


@pytest.mark.slow
def test_a_seam_in_the_field_is_not_adequate(measured):
    """One half of the field is off by ±0.3 mm along the ray, which no effect of the library and no pose can do."""

    def seen(points):
        ray = points / np.linalg.norm(points, axis=1, keepdims=True)
        return points + 0.3 * np.sign(points[:, :1]) * ray

    found = diagnosed(measured, seen)
    assert found.verdict == "unknown_effect" and 0.06 < found.overlap_misfit < 0.6
    assert "However each view is moved" in found.sentence


def test_points_move_by_the_polynomial_that_is_stated(measured):
    """z off by c·(x/z)·(y/z) and x by c·(r/r₀ − 1)², worked out for single points."""
    view = measurement_of(session_of(measured), captured(measured)).scan_views[0]
    field = next(e for e in empirical_effects(view.views) if e.name == FIELD)
    points, r0 = np.array([[30.0, -40.0, 400.0], [0.0, 0.0, 500.0]]), view.views.standoff
    zero = dict.fromkeys(field.specs, 0.0)
    moved = field.function(points, view, **zero | {"c2_ab": 2.0, "c0_dd": 3.0}) - points
    r = np.linalg.norm(points, axis=1)
    assert moved[:, 2] == pytest.approx(2.0 * points[:, 0] * points[:, 1] / points[:, 2] ** 2)
    assert moved[:, 0] == pytest.approx(3.0 * (r / r0 - 1) ** 2)
    assert np.all(moved[:, 1] == 0)


def test_repeatability_of_iso_9283_from_drawn_poses():
    """RP = mean + 3 standard deviations of the distances from the barycentre, for 0.02 mm of scatter a coordinate."""
    distances = np.linalg.norm(np.random.default_rng(1).normal(0, 0.02, (400_000, 3)), axis=1)
    stated = StatedRepeatability(position=float(distances.mean() + 3 * distances.std()))
    assert stated.sigma_translation == pytest.approx(0.02, rel=5e-3)
    assert StatedRepeatability(rotation=3e-4).sigma_rotation == pytest.approx(1e-4)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_stated_repeatability_takes_the_place_of_the_usual_one(unit):
    session, *_ = labelled_cell(5, views=10)
    usual = scatter_limit(replace(session, length_unit=unit))
    assert usual.translation == pytest.approx(0.12 if unit == "mm" else 0.12e-3) and not usual.stated
    stated = scatter_limit(replace(session, length_unit=unit, repeatability=StatedRepeatability(position=0.1)))
    assert stated.translation < 0.1 and stated.stated and stated.rotation == usual.rotation


@pytest.mark.parametrize(("scatter", "more"), [((2e-5, 0.02), False), ((8e-5, 0.08), True)])
def test_four_times_the_scatter_of_an_ordinary_arm_is_more_than_expected(scatter, more):
    """Nothing else is wrong with it: whoever knows that the arm is so states it."""
    session, *_ = labelled_cell(5, views=24, scatter=scatter)
    linear = linear_model_of(run(session))
    assert beyond_expected(linear, expected_scatter(linear, scatter_limit(session))) == more
    known = ScatterLimit(*scatter, rotation_stated=True, translation_stated=True)
    assert not beyond_expected(linear, expected_scatter(linear, known))


@pytest.mark.usefixtures("few_effects")
def test_scatter_beyond_what_is_stated_is_not_adequate():
    """The cell's arm scatters by 20 µm a coordinate, RP 72 µm: stated as 80 µm it is adequate, as 20 µm it is not."""
    session, *_ = labelled_cell(5, views=24, scatter=(1e-5, 0.02))
    found = run(session)
    told = {
        stated: diagnose(replace(found, session=replace(session, repeatability=StatedRepeatability(position=stated))))
        for stated in (None, 0.08, 0.02)
    }
    assert told[None].verdict == "adequate" and "No repeatability is stated" in told[None].sentence
    assert told[0.08].verdict == "adequate" and "The stated repeatability allows" in told[0.08].sentence
    assert told[0.02].verdict == "unknown_effect" and "(stated: up to" in told[0.02].sentence


def test_a_covariate_is_no_joint_by_its_name(blade_capture):
    measured, capture = blade_capture
    tilt = np.arange(5.0)
    views = replace(
        measurement_of(session_of(measured), capture).views, covariates={"jig_deg": tilt, "j_deg": 2 * tilt}
    )
    values = {driver.name: driver.values for driver in drivers_of(views)}
    assert np.array_equal(values["jig_deg"], tilt) and np.array_equal(values["j_deg"], 2 * tilt)
    assert np.allclose(values["j2_deg"], np.degrees(measured.plan.joints[:, 1]))


def test_of_columns_that_are_one_the_named_effects_own_is_told():
    """Joints 1 to 3 come from where joint 5 comes, which has play."""
    side = np.where(np.arange(24) % 2, 1.0, -1.0)
    session, *_ = labelled_cell(3, views=24, errors=(np.outer(-3e-4 * side, np.eye(6)[4]), np.zeros((24, 6))))
    approach = np.outer(side, [1.0, 1.0, 1.0, 0.0, 1.0, 0.0])
    views = tuple(replace(view, approach=row) for view, row in zip(session.views, approach, strict=True))
    found = diagnose_state(run(replace(session, views=views)))
    assert found.effects == ("backlash",) and found.depends_on[0].covariate == "j5_approach"
    assert not [x for x in found.depends_on[1:] if x.covariate.endswith("_approach")]
