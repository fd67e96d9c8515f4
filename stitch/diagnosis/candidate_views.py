"""Views that nobody has taken yet: joint angles within reach, as rows of a session and as a measurement."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.observations.targets.rows import Landmarks, TargetRows, target_rows
from stitch.session.capture import Sightings, build_capture
from stitch.session.measurement import Measurement, Views
from stitch.session.robot import Robot, forward
from stitch.session.torques import PAYLOAD, Torques, torques_of

_SAMPLES = 6000
_SPREAD = np.radians(40.0)  # about joint angles that were driven before
_CLOSER = np.radians(20.0)  # about views that were chosen among those
_LIMIT = np.radians(170.0)  # of joints whose limits nobody stated, unless they were beyond already
# Times at the most that random angles are drawn, until there are enough to try.
_SEARCHES = 6
# A view may see the part by this share of its distance farther off than any before, and turned by so much.
_MARGIN, _TURNED = 0.15, np.cos(np.radians(50.0))


def nearby(driven: Array, chosen: Array | None = None, seed: int = 0) -> Array:
    """Return random joint angles (K, n), rad, near given ones: up to `_SAMPLES`, less those beyond the limits.

    Args:
        driven: (V, n) rad, joint angles of the views; the largest of each joint widens its assumed limit.
        chosen: (C, n) rad, angles to stay closer to; None: the driven ones.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    about, spread = (driven, _SPREAD) if chosen is None else (chosen, _CLOSER)
    joints = about[rng.integers(0, len(about), _SAMPLES)] + rng.uniform(-spread, spread, (_SAMPLES, driven.shape[1]))
    limit = np.maximum(_LIMIT, np.abs(driven).max(axis=0))
    return joints[(np.abs(joints) < limit).all(axis=1)]


def reachable(
    driven: Array,
    poses_of: Callable[[Array], Array],
    seen_from: Array,
    centre: Array,
    chosen: Array | None = None,
    seed: int = 0,
) -> Array:
    """Return random joint angles (K, n), rad, at which the scanner sees the part about as in the views taken.

    The part's centre has to lie where it lay in the scanner frame before, up to a margin. The viewing direction has to
    be within 50° of one of the views'.

    Args:
        driven: (V, n) rad, joint angles of the views.
        poses_of: function from joint angles (K, n) to T_reference_scanner (K, 4, 4).
        seen_from: (V, 4, 4) T_reference_scanner of the views.
        centre: (3,) of what they see, reference frame.
        chosen: (C, n) rad, joint angles to stay close to; None: those of the views.
        seed: of the draws.
    """
    joints = nearby(driven, chosen, seed)
    poses = poses_of(joints)
    centre_seen = frames.transform(frames.inverse(poses), centre[None])[:, 0]
    before = frames.transform(frames.inverse(seen_from), centre[None])[:, 0]
    margin = _MARGIN * np.linalg.norm(before, axis=1).mean()
    inside = ((centre_seen > before.min(axis=0) - margin) & (centre_seen < before.max(axis=0) + margin)).all(axis=1)
    # A view direction far from all others would share no surface with them.
    inside &= (poses[:, :3, 2] @ seen_from[:, :3, 2].T).max(axis=1) > _TURNED
    return joints[inside]


def drawn_until(draw: Callable[[int], Array], enough: float) -> Array:
    """Return joint angles (K, n), rad, of as many draws as are needed for so many of them, `_SEARCHES` at the most.

    Args:
        draw: called with a seed; returns the possible ones among its random joint angles (k, n).
    """
    drawn = list[Array]()
    for seed in range(_SEARCHES):
        drawn.append(draw(seed))
        if sum(map(len, drawn)) >= enough:
            break
    return np.concatenate(drawn)


def candidate_measurement(measurement: Measurement, joints: Array, wait: Array | float = 0.0) -> Measurement:
    """Return a measurement of K views not taken yet, each as if it alone followed the last view; it has no scans.

    Covariates, payload and external axes stay as in the last view, the joints' moves begin there, and the arm rests.

    Args:
        joints: (K, n) rad.
        wait: (K,) or one number, s, beside the usual pause between views.
    """
    assert measurement.robot is not None
    views = measurement.views
    count = len(joints)
    last = np.repeat(views.joints[-1:], count, axis=0)
    torques = _torques_at(measurement.robot, views, joints)
    pause = float(np.median(np.diff(views.time))) if views.has("time") and views.count > 1 else 0.0
    # They would be taken at rest.
    velocity = None if views.velocity is None else np.zeros_like(joints)
    # External axes stay where they were last.
    axes = views.axes.standing(count) if views.axes else views.axes
    T_base_flange = forward(measurement.robot, joints)
    T_base_flange = axes.carried() @ T_base_flange if axes else T_base_flange
    candidate = replace(
        views,
        count=count,
        joints=joints,
        previous=last,
        approach=np.sign(joints - last),
        time=np.full(count, views.time[-1] + pause) + wait,
        velocity=velocity,
        torques=torques,
        covariates={name: np.full(count, values[-1]) for name, values in views.covariates.items()},
        number=np.full(count, views.number[-1] + 1),
        T_base_flange=T_base_flange,
        axes=axes,
        gravity=views.gravity if views.gravity.ndim == 1 else np.repeat(views.gravity[-1:], count, axis=0),
    )
    return replace(measurement, views=candidate, T_base_flange=T_base_flange, scan_views=())


def with_candidates(measurement: Measurement, further: Measurement) -> Measurement:
    """Return one measurement of the views of both, `further` behind; its capture has poses, but no points."""
    views, more = measurement.views, further.views

    def joined(name: str) -> Array:
        return np.concatenate([getattr(views, name), getattr(more, name)])

    names = ("joints", "previous", "approach", "time", "number", "T_base_flange")
    of_both: dict[str, Any] = {name: joined(name) for name in names}
    every = replace(
        views,
        **of_both,
        count=views.count + more.count,
        velocity=None if views.velocity is None else joined("velocity"),
        torques=views.torques.followed_by(more.torques),
        covariates={name: np.append(values, more.covariates[name]) for name, values in views.covariates.items()},
        axes=views.axes.with_more(more.axes) if views.axes else views.axes,
        gravity=views.gravity if views.gravity.ndim == 1 else joined("gravity"),
    )
    T_base_flange = every.T_base_flange
    capture = build_capture("candidates", (), T_base_flange, measurement.mount)
    return replace(measurement, capture=capture, views=every, T_base_flange=T_base_flange, scan_views=())


def _torques_at(robot: Robot, views: Views, joints: Array) -> Torques:
    """Return the torques at joint angles (K, n), rad, computed by the robot with the last view's payload.

    Where torques were measured none are computed: those of the view with the nearest joint angles stand in.
    """
    if views.torques.measured:
        near = np.linalg.norm(joints[:, None] - views.joints[None], axis=2).argmin(axis=1)
        return views.torques.only(near)
    carried = views.covariates.get(PAYLOAD)
    return torques_of(robot, joints, None if carried is None else np.full(len(joints), carried[-1]))


def candidate_rows(
    measurement: Measurement, seen: TargetRows, landmarks: Landmarks, terms: Sequence[Term]
) -> tuple[TargetRows, list[Array]]:
    """Return the linearised rows of K views that would see every known target, and their derivatives by effects.

    Args:
        measurement: of the K candidate views.
        seen: rows of the views that were taken.
        landmarks: positions of the targets and their parameters, in the columns of `seen`.
        terms: effects, each with P parameters.

    Returns:
        Rows, m residuals a view, and for each term (K, m, P): change of the residuals per unit of each parameter.
    """
    known = np.flatnonzero(np.isfinite(landmarks.positions).all(axis=1))
    measurement = _all_seen(measurement, seen, landmarks, known)
    # Without a drawing; its parameters still need columns, of zeros, so that both kinds of rows have the same.
    undrawn = replace(landmarks, drawing=None, T_reference_part=None)
    rows = target_rows(measurement.capture, seen.T_mount, undrawn)
    unknown = np.zeros((*rows.residual.shape, landmarks.size - rows.landmarks.shape[2]))
    rows = replace(rows, landmarks=np.concatenate([rows.landmarks, unknown], axis=2))
    return rows, rows.effect_columns(measurement, Model(seen.T_mount), terms)


def _all_seen(measurement: Measurement, seen: TargetRows, landmarks: Landmarks, known: Indices) -> Measurement:
    """Return the measurement of candidate views with sightings of all known targets, as precise as those seen so far.

    Args:
        seen: rows of the views that were taken: hand-eye, and sigmas of which the median is taken.
        landmarks: the targets, reference frame.
        known: indices of the targets whose position is known.
    """
    before = seen.sightings
    K = len(measurement.T_base_flange)
    bare = build_capture("candidates", (), measurement.T_base_flange, measurement.mount)
    back = frames.inverse(bare.poses(seen.T_mount))
    points = frames.transform(back, landmarks.positions[known])
    sightings = Sightings(
        targets=before.targets,
        target=np.tile(known, (K, 1)),
        points=points,
        sigma=np.full(points.shape[:2], np.median(before.sigma[before.used])),
        used=np.ones(points.shape[:2], bool),
    )
    if before.sigma_rotation is not None and landmarks.orientation is not None:
        sigma_rotation = np.full(K, np.median(before.sigma_rotation))
        rotation = back[:, :3, :3] @ landmarks.orientation
        sightings = replace(sightings, rotation=rotation, sigma_rotation=sigma_rotation)
    first = measurement.target_views[0]
    usual = None if first.intensity is None else np.zeros(len(known))
    like = replace(first, views=measurement.views, cosine=np.ones(len(known)), intensity=usual)
    views = tuple(replace(like, index=v) for v in range(K))
    return replace(measurement, capture=replace(bare, sightings=sightings), target_views=views)
