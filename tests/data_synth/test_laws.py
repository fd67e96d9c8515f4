"""Laws of nature: amplitudes, joints, signs, what marks those by other hands, and that each is drawn anew for every arm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from data_synth import kinematics, nature
from data_synth.arms import ARMS
from data_synth.fixtures.arm_sources import plain_product
from data_synth.fixtures.part_distance import EXACT, off_part
from data_synth.fixtures.quiet_scenes import clean, simulated
from data_synth.laws import points as point_laws
from data_synth.laws.blind_first import FOREIGN, FOREIGN_IN_TIME, FOREIGN_OF_FLANGE
from data_synth.laws.blind_second import FURTHER, FURTHER_IN_TIME, FURTHER_OF_FLANGE
from data_synth.laws.blind_third import LATER, LATER_IN_TIME, LATER_OF_FLANGE
from data_synth.laws.brackets import GEOMETRY
from data_synth.laws.unnamed import UNNAMED
from data_synth.moment import Plan
from data_synth.scanner import Cloud
from stitch.numerics import frames
from tests.data_synth.law_plans import SEEDS, SHIFT, SIZE, VIEWS, plan_of, relative


@cache
def plan_of_the_blade() -> Plan:
    return simulated(clean("blade", rays=40, noise=0.0), {}, 11, 3).plan


@pytest.mark.parametrize("name", nature.LAWS)
def test_the_amplitude_scales_what_is_drawn(name):
    plan = plan_of_the_blade()
    once, twice = (nature.LAWS[name].draw(a, plan, np.random.default_rng(4)) for a in (1.0, 2.0))
    assert set(once) == set(twice) and once
    for parameter, value in once.items():
        # Times and views say when, places where, not how much.
        factor = 1.0 if parameter in ("T_c", "tau", "T", "v", *GEOMETRY) else 2.0
        assert twice[parameter] == pytest.approx(factor * value, rel=1e-12)


def test_joints_are_those_that_the_cell_can_show():
    plan = plan_of_the_blade()
    plan = Plan(plan.joints, plan.torque, plan.velocity, plan.arm, (3,))
    for name in ("joint_offset", "backlash", "gear_eccentricity", "gear_harmonic", "third_harmonic", "link_geometry"):
        drawn = nature.LAWS[name].draw(1.0, plan, np.random.default_rng(0))
        assert {p[-1] for p in drawn} == {"4"}


def test_laws_have_the_names_and_places_of_the_contract():
    places = {"points": 8, "base": 1, "joints": 10, "arm": 3, "mount": 6, "part": 4, "surface": 2}
    assert {place: sum(law.place == place for law in nature.LAWS.values()) for place in places} == places
    assert set(nature.SMALL) <= set(nature.LAWS)


def test_signs_at_the_sensor_by_hand():
    """A point straight ahead beyond the standoff, one at the side: where a person would expect them."""
    moment = type("M", (), {
        "standoff": 400.0, "covariates": {"scanner_temperature_c": 26.0, "humidity_percent": 50.0},
        "start": {"scanner_temperature_c": 24.0, "humidity_percent": 45.0},
    })()  # fmt: skip
    at = np.array([[0.0, 0.0, 500.0], [150.0, 200.0, 500.0]])
    cloud = Cloud(at, np.array([0.68, 0.32]), np.array([0.5, 1.0]))
    away = lambda law, p: np.linalg.norm(law(p, moment, cloud).points, axis=1) - np.linalg.norm(at, axis=1)  # noqa: E731
    r = np.linalg.norm(at[1])
    assert away(point_laws.range_scale, {"s": 1e-3}) == pytest.approx([0.5, 1e-3 * r])
    assert away(point_laws.scanner_thermal_scale, {"k": 1e-3}) == pytest.approx([1.0, 2e-3 * r])
    assert away(point_laws.range_nonlinearity, {"k": 2.0}) == pytest.approx([2 / 16, 2 * (r / 400 - 1) ** 2])
    assert away(point_laws.incidence_bias, {"b": 0.1}) == pytest.approx([0.1, 0.0], abs=1e-9)
    assert away(point_laws.intensity_bias, {"k": 0.1}) == pytest.approx([0.1, -0.1])
    assert away(point_laws.field_curvature, {"k": 2.0}) == pytest.approx([0.0, 2 * 0.25], abs=1e-9)
    assert away(point_laws.covariate_bias, {"k": 0.02}) == pytest.approx([0.1, 0.1])
    bent = point_laws.lens_distortion({"k1": 0.04}, moment, cloud).points
    assert bent == pytest.approx(np.array([[0, 0, 500], [150 * 1.01, 200 * 1.01, 500]]))


def test_latency_of_a_line_scanner():
    """Profiles assembled by the reported motion; the true arm is Δt further along."""
    for amplitude in (0.0, 1.0):
        cell = clean("line-sweep", rays=30, noise=0.0)
        measured = simulated(cell, {"latency": amplitude}, 2, 3)
        dt = measured.hidden["latency"]["dt"]
        assert dt == 2e-3 * amplitude
        for v, cloud in enumerate(measured.clouds):
            q, rate = measured.plan.joints[v], measured.plan.velocity[v]
            assert np.abs(rate).max() > 0
            y, naive = np.empty_like(cloud.points), np.empty_like(cloud.points)
            for time in np.unique(cloud.time):
                these = cloud.time == time
                reported = plain_product(cell.arm, q + rate * time) @ measured.T_mount
                at_view = plain_product(cell.arm, q) @ measured.T_mount
                true = plain_product(cell.arm, q + rate * (time + dt)) @ measured.T_mount
                profile = frames.transform(np.linalg.inv(reported) @ at_view, cloud.points[these])
                # In its own frame a profile is flat.
                assert np.abs(profile[:, 1]).max() < EXACT
                y[these] = frames.transform(np.linalg.inv(cell.T_reference_part) @ true, profile)
                naive[these] = frames.transform(np.linalg.inv(cell.T_reference_part) @ reported, profile)
            assert np.abs(off_part("line-sweep", y)[0]).max() < EXACT
            # 2 ms at 80 mm/s are 0.16 mm, along the sweep and whatever the direction.
            assert np.linalg.norm(y - naive, axis=1).mean() == pytest.approx(amplitude * 0.16, rel=0.1, abs=1e-9)


@pytest.mark.parametrize(
    "scene",
    ["blade", "blade-table", "panel", "spheres", pytest.param("car-door", marks=pytest.mark.slow), "drill-plate"],
)
def test_nothing_hidden_leaves_noise_alone(scene):
    """Clouds placed by the true poses: distances to the part over their sigma are a normal distribution."""
    cell = clean(scene, rays=40)
    measured = simulated(cell, {}, 3, 2)
    score = []
    for cloud, T in zip(measured.clouds, measured.T_reference_scanner, strict=True):
        y = frames.transform(frames.inverse(cell.T_reference_part) @ T, cloud.points)
        off, _ = off_part(scene, y)
        r = np.linalg.norm(cloud.points, axis=1)
        score.append(off / (cell.scanner.noise * (r / cell.scanner.standoff) ** 2 * cloud.incidence))
    z = np.concatenate(score)
    # Near an edge or in a fillet the nearest facet may be another one; the middle half of a distribution is safe.
    quartiles = np.quantile(z, [0.25, 0.5, 0.75])
    error = 1.36 / np.sqrt(len(z))  # standard error of a normal sample's quartile
    assert np.abs(quartiles - [-0.6745, 0.0, 0.6745]).max() < 5 * error
    assert np.abs(z).max() < 6


LAWS, OF_FLANGE = FOREIGN | FURTHER | LATER, (*FOREIGN_OF_FLANGE, *FURTHER_OF_FLANGE, *LATER_OF_FLANGE)
IN_TIME = (*FOREIGN_IN_TIME, *FURTHER_IN_TIME, *LATER_IN_TIME)
# They follow a joint, and time as well.
IN_TIME_TOO = ("softening_belt", "slipping_bush", "creeping_belt")
# Their load says which joint errs, where no useful one bears any.
ELSEWHERE_TOO = ("flank_change", "softening_belt", "ring_bolts", "creeping_belt")


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return LAWS[law](plan, np.random.default_rng(seed), **time)


def test_they_are_eight_each_and_none_has_the_name_of_another():
    assert len(FOREIGN) == len(FURTHER) == len(LATER) == 8
    assert len({*UNNAMED, *LAWS}) == len(UNNAMED) + 24
    assert set(FURTHER_IN_TIME) <= set(FURTHER_OF_FLANGE) <= set(FURTHER)
    assert set(LATER_IN_TIME) <= set(LATER_OF_FLANGE) <= set(LATER)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("law", LAWS)
def test_errors_are_of_a_good_arms_size_and_differ_from_view_to_view(law, arm):
    plan = plan_of(arm)
    for seed in SEEDS:
        error = drawn(law, plan, seed)
        assert error.shape == (VIEWS, 6 if law in OF_FLANGE else plan.arm.joints) and np.isfinite(error).all()
        assert 0.5 < relative(error, law in OF_FLANGE) < 2
        assert error.std(axis=0).max() > 0


@pytest.mark.parametrize("law", LAWS)
def test_a_seed_says_which_arm_it_is(law):
    plan = plan_of("KUKA KR30-3")
    arms = [drawn(law, plan, seed) for seed in SEEDS]
    assert np.array_equal(arms[0], drawn(law, plan, 0))
    assert all(np.abs(arms[0] - other).max() > 0 for other in arms[1:])


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("useful", [(0,), (3,), (5,)])
def test_neither_masses_nor_many_useful_joints_are_needed(law, useful):
    plan = plan_of("UR10", masses=False, useful=useful)
    error = drawn(law, plan, 1)
    assert np.isfinite(error).all() and error.std(axis=0).max() > 0
    if law not in (*OF_FLANGE, *ELSEWHERE_TOO):
        assert set(np.flatnonzero(np.ptp(error, axis=0))) == set(useful)


@pytest.mark.parametrize("law", LAWS)
def test_arms_that_hardly_move_err_by_no_more(law):
    """One pose for all views, one joint that moves, and a single view."""
    plan = plan_of("KUKA LBR iiwa 14")
    still = replace(plan, joints=np.tile(plan.joints[:1], (VIEWS, 1)), torque=np.tile(plan.torque[:1], (VIEWS, 1)))
    turning = replace(still, joints=still.joints + np.outer(np.linspace(-1, 1, VIEWS), np.eye(7)[0]))
    for few in (still, turning, plan_of("KUKA LBR iiwa 14", views=1)):
        for seed in SEEDS:
            error = drawn(law, few, seed)
            assert np.isfinite(error).all() and relative(error, law in OF_FLANGE) < 2
            if few is still and law not in (*IN_TIME, *IN_TIME_TOO[:2]):
                assert np.ptp(error, axis=0).max() < 1e-9 * SIZE


@pytest.mark.parametrize("law", IN_TIME)
def test_what_follows_time_follows_it_and_not_the_joints(law):
    assert np.array_equal(drawn(law, plan_of("UR10"), 2), drawn(law, plan_of("KUKA KR30-3"), 2))


@pytest.mark.parametrize("law", [*IN_TIME, *IN_TIME_TOO])
def test_time_counts_from_the_first_view_and_pauses_matter(law):
    plan = plan_of("UR10")
    uneven = [np.linspace(0.2, 4.0, VIEWS), np.random.default_rng(0).uniform(0.5, 3.0, VIEWS)]
    # An instant may fall between the same two views whatever the pauses are, as with the second.
    for steps in uneven[: 1 if law == "slipping_bush" else 2]:
        late = drawn(law, plan, 2, time=np.cumsum(steps))
        assert np.isfinite(late).all() and not np.array_equal(late, drawn(law, plan, 2))
        assert np.allclose(late, drawn(law, plan, 2, time=np.cumsum(steps) + 100.0))


def test_a_loose_anchor_leaves_the_base_where_the_arm_leans_away():
    """Views among the first fifth are never tipped, and all tip about one axis of the base."""
    plan = plan_of("KUKA KR30-3")
    turns = drawn("loose_anchor", plan, 3)[:, :3]
    assert VIEWS / 5 <= (np.abs(turns).max(axis=1) == 0).sum() <= VIEWS / 2
    axes = np.einsum("vij,vj->vi", kinematics.flange(plan.arm, plan.joints)[:, :3, :3], turns)
    values = np.linalg.svd(axes, compute_uv=False)
    assert values[1] < 1e-9 * values[0] and np.abs(axes[:, 2]).max() < 1e-12


def test_an_eccentric_wheel_errs_two_neighbours_alike():
    error = drawn("differential_wheel", plan_of("KUKA KR30-3"), 3)
    i, k = np.flatnonzero(np.ptp(error, axis=0))
    assert k == i + 1 and np.array_equal(np.abs(error[:, i]), np.abs(error[:, k]))


def test_a_bush_turns_its_wave_once():
    """Before and after it slips one sine of the joint is left, over the whole session none."""
    plan = plan_of("KUKA KR30-3")
    error = drawn("slipping_bush", plan, 4)
    (i,) = np.flatnonzero(np.ptp(error, axis=0))
    basis = np.column_stack([np.ones(VIEWS), np.sin(plan.joints[:, i]), np.cos(plan.joints[:, i])])

    def left(views: slice) -> float:
        fit = np.linalg.lstsq(basis[views], error[views, i], rcond=None)[0]
        return float(np.abs(error[views, i] - basis[views] @ fit).max())

    at = [max(left(slice(v)), left(slice(v, None))) for v in range(5, VIEWS - 5)]
    assert min(at) < 1e-12 and left(slice(None)) > 0.2 * SIZE


def test_tubes_sag_towards_the_floor_and_tip_about_a_level_axis():
    plan = plan_of("KUKA KR30-3")
    error = drawn("bending_tubes", plan, 3)
    frames = kinematics.links(plan.arm, plan.joints)
    turn, shift = (np.einsum("vij,vj->vi", frames[:, -1, :3, :3], x) for x in (error[:, :3], error[:, 3:]))
    assert np.abs(turn[:, 2]).max() < 1e-12 and np.abs(shift[:, :2]).max() < 1e-12
    reach = np.linalg.norm(frames[:, -1, :2, 3] - frames[:, 1, :2, 3], axis=1)
    assert (np.diff(shift[np.argsort(reach), 2]) < 1e-12).all() and np.ptp(shift[:, 2]) > 0


def test_every_knock_has_a_way_of_its_own_and_is_not_made_good():
    for seed in SEEDS:
        error = drawn("knocks_on_rubber", plan_of("UR10"), seed) / np.repeat([SIZE, SHIFT], 3)
        moved = np.linalg.norm(error - error[0], axis=1)
        before = int(np.argmax(moved > 1e-9))
        assert 2 <= before < VIEWS / 2 and moved[before] > 0.3 and moved[-1] > 0.1
        assert 2 <= np.linalg.matrix_rank(error - error[0], tol=1e-9) <= 4


def left(basis: np.ndarray, course: np.ndarray) -> float:
    """The most that a fit of these columns and a constant leaves."""
    basis = np.column_stack([np.ones(len(course)), basis])
    return float(np.abs(course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]).max())


def in_base_frame(plan: Plan, error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames of all links, and how the flange turns and shifts."""
    frames = kinematics.links(plan.arm, plan.joints)
    turn, shift = (np.einsum("vij,vj->vi", frames[:, -1, :3, :3], x) for x in (error[:, :3], error[:, 3:]))
    return frames, turn, shift


def test_a_flank_has_one_wave_and_the_other_another():
    plan = plan_of("KUKA KR30-3")
    for seed in SEEDS:
        error = drawn("two_flanks", plan, seed)
        (i,) = np.flatnonzero(np.ptp(error, axis=0))
        q, down = plan.joints[:, i], np.diff(plan.joints[:, i], prepend=plan.joints[0, i]) < 0
        waves = [np.column_stack([np.sin(m * q), np.cos(m * q)]) for m in range(2, 6)]
        assert min(max(left(w[f], error[f, i]) for f in (down, ~down)) for w in waves) < 1e-12
        assert left(np.hstack([*waves, down[:, None]]), error[:, i]) > 0.2 * SIZE


def test_a_joint_that_stands_stays_on_its_flank():
    plan = plan_of("KUKA KR30-3")
    waiting = replace(plan, joints=np.repeat(plan.joints, 2, axis=0), torque=np.repeat(plan.torque, 2, axis=0))
    for seed in SEEDS:
        assert np.allclose(drawn("two_flanks", waiting, seed)[::2], drawn("two_flanks", waiting, seed)[1::2])


def test_a_straight_shaft_errs_by_nothing_and_a_bent_one_twice_a_turn():
    """One neighbour stands at three places: sines twice a turn of one phase at each, as high as the bend says."""
    plan = plan_of("UR10", useful=(0,))  # the only neighbour is joint 1
    places, q = np.array([-0.5, 0.0, 0.3]), np.linspace(-np.pi, np.pi, 24, endpoint=False)
    joints = np.tile(plan.joints[:1], (72, 1))
    joints[:, 0], joints[:, 1] = np.tile(q, 3), np.repeat(places, 24)
    for seed in SEEDS:
        error = drawn("cardan_shaft", replace(plan, joints=joints), seed)[:, 0].reshape(3, 24)
        assert left(np.column_stack([np.sin(2 * q), np.cos(2 * q)]), error.T) < 1e-12
        heights = np.linalg.norm(error, axis=1)
        assert np.linalg.matrix_rank(error, tol=1e-9 * heights.max()) == 1 and np.ptp(heights) > 0.1 * heights.max()


def test_a_lobed_bearing_tips_an_axis_and_does_not_turn_about_it():
    """The flange turns about the joint's middle and never about its axis, which goes round several times a turn."""
    plan = plan_of("KUKA KR30-3")
    for seed in SEEDS:
        frames, turn, shift = in_base_frame(plan, drawn("lobed_bearing", plan, seed))
        about = np.einsum("vj,vij->iv", turn, frames[:, :6, :3, 2])
        x = frames[:, -1, None, :3, 3] - frames[:, :6, :3, 3]
        astray = np.abs(shift[:, None] - np.cross(turn[:, None], x)).max(axis=(0, 2)) / SHIFT
        off = np.maximum(np.abs(about).max(axis=1) / SIZE, astray)  # from turning about the middle of each joint
        i = int(np.argmin(off))
        assert off[i] < 1e-9
        tilt, q = np.einsum("vji,vj->vi", frames[:, i, :3, :3], turn), plan.joints[:, i]
        waves = [np.column_stack([np.sin(m * q), np.cos(m * q)]) for m in (1, 3, 4, 5)]
        assert min(left(wave, tilt) for wave in waves[1:]) < 1e-12 and left(waves[0], tilt) > 0.1 * np.abs(tilt).max()


def test_a_hose_pulls_towards_one_point_and_not_when_slack():
    plan = plan_of("KUKA KR30-3")
    for seed in SEEDS:
        frames, turn, shift = in_base_frame(plan, drawn("tethered_tool", plan, seed))
        x, one = frames[:, -1, :3, 3], np.abs(shift[:, None] - shift[None]).max(axis=2) < 1e-12
        slack = one[np.argmax(one.sum(axis=1))]  # the many that are shifted alike
        assert 3 <= slack.sum() <= 0.5 * VIEWS
        pull = shift[~slack] - shift[slack][0]
        size = np.linalg.norm(pull, axis=1)
        across = np.eye(3) - np.einsum("vi,vj->vij", pull, pull) / size[:, None, None] ** 2
        hook = np.linalg.solve(across.sum(axis=0), np.einsum("vij,vj->i", across, x[~slack]))
        assert np.abs(np.einsum("vij,vj->vi", across, hook - x[~slack])).max() < 1e-3  # mm past the hook
        far = np.linalg.norm(hook - x, axis=1)
        assert hook[2] > x[:, 2].max() and far[slack].max() < far[~slack].min()
        assert ((hook - x[~slack]) * pull).sum(axis=1).min() > 0 and left(far[~slack, None], size) < 1e-9
        assert np.abs((turn * shift).sum(axis=1)).max() < 1e-9 * SIZE * SHIFT  # a turn is across what causes it


def test_gravity_alone_says_in_which_of_three_seats_a_tool_is():
    """To turn about the plumb line changes nothing; the seats share gravity out by straight lines from one point."""
    plan = plan_of("KUKA KR30-3")
    about = np.outer(np.random.default_rng(1).uniform(-2, 2, VIEWS), np.eye(6)[0])
    for seed in SEEDS:
        error = drawn("three_seats", plan, seed)
        assert np.allclose(error, drawn("three_seats", replace(plan, joints=plan.joints + about), seed), atol=1e-12)
        seats, which = np.unique(np.round(error, 12), axis=0, return_inverse=True)
        assert len(seats) in (2, 3) and np.linalg.matrix_rank(error, tol=1e-9) == len(seats) - 1
        lean = -kinematics.flange(plan.arm, plan.joints)[:, 2, :2]
        directions = np.linspace(0, 2 * np.pi, 720)
        for a, b in zip(*np.triu_indices(len(seats), 1), strict=True):
            along = np.outer(np.cos(directions), lean[:, 0]) + np.outer(np.sin(directions), lean[:, 1])
            gap = along[:, which.ravel() == a].min(axis=1) - along[:, which.ravel() == b].max(axis=1)
            assert gap.max() > 0


def test_a_belt_remembers_loads_and_forgets_them_in_long_pauses():
    plan = plan_of("KUKA KR30-3")
    for seed in SEEDS:
        error = drawn("creeping_belt", plan, seed)
        (i,) = np.flatnonzero(np.ptp(error, axis=0))
        load, e = plan.torque[:, i], error[:, i]
        assert left(np.column_stack([e[:-1], load[1:]]), e[1:]) < 1e-12 and left(load[:, None], e) > 0.2 * SIZE
        rested = drawn("creeping_belt", plan, seed, time=1e4 * np.arange(VIEWS))[:, i]
        assert left(load[:, None], rested) < 1e-12 and np.corrcoef(load, rested)[0, 1] > 0


def test_a_lens_has_two_rests_and_comes_back_to_both():
    for seed in SEEDS:
        error = drawn("snapping_lens", plan_of("UR10"), seed)
        assert len(np.unique(error, axis=0)) == 2
        assert 3 <= (np.diff(error[:, 0]) != 0).sum() <= 6


def test_a_screw_loosens_and_leaves_no_course():
    """Thirds of the session err ever more, in all directions, and from one view to the next nothing stays."""
    error = np.array([drawn("loosening_screw", plan_of("UR10"), seed) for seed in range(40)])
    error = error / np.repeat([SIZE, SHIFT], 3)
    assert all(np.linalg.matrix_rank(e) == 6 for e in error)
    first, second, third = ((x**2).mean() for x in np.array_split(error, 3, axis=1))
    assert 2 * first < second and 2 * second < third
    assert abs((error[:, 1:] * error[:, :-1]).sum() / (error**2).sum()) < 0.1
