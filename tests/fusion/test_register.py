"""Register: views reach the noise whichever comes first, by published weights, and it says where it ended or moved unseen."""

from dataclasses import replace

import numpy as np
import pytest

from data_synth.fixtures.blade_cells import captured_blade
from stitch.fit.correct import correct
from stitch.fusion.register import DPWVM, GICP, METHODS, Registration, register, unseen_moves
from stitch.fusion.register import _Progress as Progress
from stitch.numerics import frames
from stitch.observations.surfaces.hand_eye_fit import Repeatability
from stitch.observations.surfaces.matching import sample_points
from stitch.observations.surfaces.normal_equations import collect_overlaps
from stitch.session.capture import build_capture
from stitch.session.scan import prepare_scan

SCATTER = Repeatability(2e-4, 0.1, 1.0)


RADIUS, CENTRE = 30.0, np.array([0.0, 0.0, 400.0])


# A radian about the middle of the scanned cap, which lies beside the ball's own, also shifts it.
TURN = np.array([0.02, -0.01, 0.0, 0.005])


def test_register_reaches_the_noise_and_finds_the_pose_errors():
    measured, capture = captured_blade(1, repeatability=(3e-4, 0.1))
    found = correct([capture], measured.T_mount, 5.0)
    registration = register(
        capture, capture.poses(found.hand_eye.T_mount), found.hand_eye.repeatability[0], found.overlaps[0].gate
    )
    noise = np.sqrt(2) * np.median([scan.noise for scan in capture.scans])
    assert registration.overlaps.gram.rms < 1.15 * noise
    # Poses may differ from the truth by one common motion: compare view to view.
    relative = frames.inverse(registration.poses[:1]) @ registration.poses[1:]
    truth = frames.inverse(measured.T_reference_scanner[:1]) @ measured.T_reference_scanner[1:]
    before = capture.poses(found.hand_eye.T_mount)
    model = frames.inverse(before[:1]) @ before[1:]
    middle = np.mean([scan.points.mean(axis=0) for scan in capture.scans], axis=0)

    def off(T):
        return np.sqrt(np.mean((frames.transform(T, middle[None]) - frames.transform(truth, middle[None])) ** 2))

    assert off(relative) < 0.25 * off(model)


def test_poses_of_dpwvm_do_not_change_with_the_order_of_views(cell):
    capture, poses, _ = cell
    turned = replace(
        capture,
        scans=capture.scans[::-1],
        T_reference_mount=capture.T_reference_mount[::-1],
        T_reference_flange=capture.T_reference_flange[::-1],
    )
    forth = register(capture, poses, SCATTER, 5.0, method=DPWVM)
    back = register(turned, poses[::-1], SCATTER, 5.0, method=DPWVM)
    assert np.abs(forth.poses - back.poses[::-1]).max() < 1e-9


def test_stock_of_one_view_is_found_and_moves_no_pose():
    """One view's points stand 0.3 mm out of the part along their normals: plane to plane moves it, variance does not."""
    measured, capture = captured_blade(3, views=12, pixels=100)
    poses = measured.T_reference_scanner
    scans = list(capture.scans)
    scans[2] = replace(scans[2], points=scans[2].points + 0.3 * scans[2].normals)
    raised = replace(capture, scans=tuple(scans))
    clean = register(capture, poses, SCATTER, 2.0, method=DPWVM)
    variance = register(raised, poses, SCATTER, 2.0, method=DPWVM)
    plane = register(raised, poses, SCATTER, 2.0, method=GICP)
    assert clean.offsets == {}
    assert variance.offsets == pytest.approx({2: 0.3}, abs=0.01)

    def apart(found):
        """Displacement of view 2 against the others from the clean fit, at the part."""
        to_centre = frames.make(np.eye(3), -clean.overlaps.gram.centre)
        xi = frames.log(to_centre @ found.poses @ frames.inverse(to_centre @ clean.poses))[:, 3:]
        return np.linalg.norm(xi[2] - np.delete(xi, 2, axis=0).mean(axis=0))

    assert apart(variance) < 0.3 * apart(plane)


def test_register_ends_where_neither_rms_nor_step_falls_and_says_so(cell):
    """Within a gate far below the points' spacing partners change for ever, and the views swing."""
    capture, poses, _ = cell
    assert capture.spacing > 2.0
    swinging = register(capture, poses, SCATTER, 0.7)
    assert len(swinging.history) < 25
    assert "fell any further" in swinging.note
    assert len(swinging.note.split()) <= 25
    assert register(capture, poses, SCATTER, 2.0).note == ""


def test_progress_counts_iterations_without_a_fall(cell):
    capture, poses, _ = cell
    g = collect_overlaps(capture, poses, 1.0, [sample_points(s, 300) for s in capture.scans]).gram
    progress, step = Progress(), np.ones((5, 6))
    assert progress.made(g, step, 1.0)
    assert not progress.made(g, step, 1.0)
    assert progress.stalled == 1
    assert progress.made(g, 0.9 * step, 1.0)
    assert progress.made(g, step, 0.5)  # a tighter gate begins anew
    assert progress.stalled == 0


def test_poses_of_gicp_do_not_change_with_the_order_of_views(cell):
    capture, poses, _ = cell
    forth = register(capture, poses, SCATTER, 5.0, method=GICP).poses
    turned = replace(
        capture,
        scans=capture.scans[::-1],
        T_reference_mount=capture.T_reference_mount[::-1],
        T_reference_flange=capture.T_reference_flange[::-1],
    )
    back = register(turned, poses[::-1], SCATTER, 5.0, method=GICP).poses[::-1]
    assert np.abs(forth - back).max() < 1e-6


def test_the_weights_are_gicps_inside_tukeys(cell):
    """Both formulas written out as in Segal et al. (2009) and Beaton & Tukey (1974), handed in, give the same poses."""
    capture, poses, _ = cell

    def formula(matches, capture, poses):
        middle = np.median(np.abs(np.concatenate([m.residual for m in matches])))
        return [plane_to_plane(m, capture, poses) * biweight(m.residual / (1.4826 * middle)) for m in matches]

    own = register(capture, poses, SCATTER, 5.0, method=GICP)
    handed = register(capture, poses, SCATTER, 5.0, method=replace(GICP, weigh=formula))
    assert np.abs(own.poses - handed.poses).max() < 1e-9


def biweight(u):
    return np.where(np.abs(u) < 4.685, (1 - (u / 4.685) ** 2) ** 2, 0.0)


def plane_to_plane(m, capture, poses):
    """2ε over nᵀ(C_v + C_w)n, C = R diag(ε, 1, 1) Rᵀ with the point's normal as first axis."""
    total = 0.0
    for view, index in ((m.v, m.index_v), (m.w, m.index_w)):
        own = capture.scans[view].normals[index] @ poses[view][:3, :3].T
        C = np.eye(3) - (1 - 1e-3) * own[:, :, None] * own[:, None, :]
        total = total + np.einsum("ni,nij,nj->n", m.normal, C, m.normal)
    return 2e-3 / total


def test_register_takes_other_weights(cell):
    """One pair alone counts: views outside it stay where the robot put them."""
    capture, poses, _ = cell

    def only_first(matches, capture, poses):
        return [m.weight * ((m.v, m.w) == (0, 1)) for m in matches]

    found = register(capture, poses, SCATTER, 5.0, method=replace(GICP, weigh=only_first))
    moved = frames.log(found.poses @ frames.inverse(poses))
    assert np.abs(moved[2:]).max() < 1e-12
    assert np.abs(moved[:2, 3:]).max() > 1e-2


def test_both_methods_stand_by_their_names():
    assert list(METHODS) == ["dpwvm", "gicp", "vmm"]
    assert all(name == method.name for name, method in METHODS.items())


def seen_from_one_place(surface):
    """Four scans of a surface, drawn anew for each (N, 3), their poses and overlaps."""
    rng = np.random.default_rng(2)
    scans = [prepare_scan(f"v{v}", p + 0.01 * rng.standard_normal(p.shape)) for v, p in enumerate(surface(rng))]
    poses = np.tile(np.eye(4), (4, 1, 1))
    capture = build_capture("s", scans, poses, "eye_in_hand")
    return poses, collect_overlaps(capture, poses, 2.0, [sample_points(scan, 2000) for scan in scans])


def ball(rng):
    for away in rng.standard_normal((4, 4000, 3)):
        away /= np.linalg.norm(away, axis=1)[:, None]
        yield CENTRE + RADIUS * away[away[:, 2] < -0.3]


def wave(rng):
    for x, y in rng.uniform(-30, 30, (4, 2, 4000)):
        yield CENTRE + np.column_stack([x, y, 6 * np.sin(x / 6) * np.cos(y / 8)])


def moved(surface, twists):
    poses, overlaps = seen_from_one_place(surface)
    middle = frames.make(np.eye(3), CENTRE)
    return unseen_moves(Registration(middle @ frames.exp(twists) @ frames.inverse(middle) @ poses, overlaps, ()), poses)


def test_turns_of_a_ball_about_its_middle_are_not_seen():
    turned = moved(ball, np.column_stack([TURN, np.zeros((4, 5))]))
    expected = np.abs(TURN - TURN.mean())
    np.testing.assert_allclose(turned / turned.max(), expected / expected.max(), rtol=0.02)
    assert turned.max() > 0.1


def test_moves_of_a_wave_are_seen():
    assert moved(wave, np.tile(TURN[:, None], (1, 6))).max() == 0
