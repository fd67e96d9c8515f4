"""What marks the kinds of the third laws by another hand."""

from dataclasses import replace

import numpy as np

from data_synth import kinematics
from data_synth.laws.blind_third import LATER
from data_synth.moment import Plan
from tests.data_synth.law_plans import SEEDS, SHIFT, SIZE, VIEWS, plan_of


def drawn(law: str, plan: Plan, seed: int, **time: np.ndarray) -> np.ndarray:
    """Errors of one arm."""
    return LATER[law](plan, np.random.default_rng(seed), **time)


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
