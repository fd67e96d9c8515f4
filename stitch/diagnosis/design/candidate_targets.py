"""Labelled points of views that nobody has taken yet."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch import frames
from stitch.frames import Array, Indices
from stitch.measurement.capture import build_capture
from stitch.measurement.measurement import Measurement, downwards
from stitch.measurement.sightings import Sightings
from stitch.model.model import Model
from stitch.model.term import Term
from stitch.observations.targets.effect_rows import effect_rows
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import TargetRows, mixed_model_of_rows, target_rows


def candidate_rows(
    measurement: Measurement, seen: TargetRows, landmarks: Landmarks, variances: Array, terms: Sequence[Term]
) -> tuple[TargetRows, list[Array], Array]:
    """Rows of K views in which every target would be seen, how they answer to `terms`, and their covariance.

    Args:
        measurement: of the candidate views.
        seen: rows of the views that were taken.
        variances: (3,) of rotation scatter, translation scatter, factor on the sensor's noise.

    Returns:
        Rows, one (K, m, P) per term, and (K, m, m).
    """
    known = np.flatnonzero(np.isfinite(landmarks.positions).all(axis=1))
    measurement = _all_seen(measurement, seen, landmarks, known)
    undrawn = replace(landmarks, drawing=None, T_reference_part=None)
    rows = target_rows(measurement.capture, seen.T_mount, undrawn)
    unknown = np.zeros((*rows.residual.shape, landmarks.size - rows.landmarks.shape[2]))
    rows = replace(rows, landmarks=np.concatenate([rows.landmarks, unknown], axis=2))
    covariance = mixed_model_of_rows(rows, rows.hand_eye).covariance(variances)
    return rows, effect_rows(rows, measurement, Model(seen.T_mount), terms), covariance


def _all_seen(measurement: Measurement, seen: TargetRows, landmarks: Landmarks, known: Indices) -> Measurement:
    """The measurement with sightings of all known targets, as good as those that were seen."""
    before, K = seen.sightings, len(measurement.T_base_flange)
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
    down = downwards(measurement.robot, measurement.T_base_flange, measurement.eye_to_hand)
    first = measurement.target_views[0]
    usual = None if first.intensity is None else np.zeros(len(known))
    like = replace(first, views=measurement.views, cosine=np.ones(len(known)), intensity=usual)
    views = tuple(replace(like, index=v, gravity=down[v]) for v in range(K))
    return replace(measurement, capture=replace(bare, sightings=sightings), target_views=views)
