"""Labelled points of views that nobody has taken yet."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.capture import place
from stitch.measurement.measurement import Measurement, Term, downwards
from stitch.measurement.sightings import Sightings
from stitch.observations.targets.landmarks import Landmarks
from stitch.observations.targets.rows import Rows, effect_rows, evidence_of_rows, rows_of


def candidate_rows(
    measurement: Measurement, seen: Rows, landmarks: Landmarks, variances: Array, terms: Sequence[Term]
) -> tuple[Rows, list[Array], Array]:
    """Rows of K views in which every target would be seen, how they answer to `terms`, and their covariance.

    Args:
        measurement: of the imagined views.
        seen: rows of the views that were taken.
        variances: (3,) of rotation scatter, translation scatter, factor on the sensor's noise.

    Returns:
        Rows, one (K, m, P) per term, and (K, m, m).
    """
    before = seen.capture.sightings
    assert before is not None
    mount = "eye_to_hand" if measurement.eye_to_hand else "eye_in_hand"
    K, known = len(measurement.T_base_flange), np.flatnonzero(np.isfinite(landmarks.positions).all(axis=1))
    bare = place("imagined", (), measurement.T_base_flange, mount)
    back = frames.inverse(bare.poses(seen.T_mount))
    points = frames.transform(back, landmarks.positions[known])
    sightings = Sightings(
        before.targets, np.tile(known, (K, 1)), points, np.full(points.shape[:2], np.median(before.sigma[before.used])),
        np.ones(points.shape[:2], bool),
    )  # fmt: skip
    if before.sigma_rotation is not None and landmarks.orientation is not None:
        sightings = replace(sightings, rotation=back[:, :3, :3] @ landmarks.orientation,
                            sigma_rotation=np.full(K, np.median(before.sigma_rotation)))  # fmt: skip
    down = downwards(measurement.robot, measurement.T_base_flange, measurement.eye_to_hand)
    first = measurement.target_views[0]
    usual = None if first.intensity is None else np.zeros(len(known))
    like = replace(first, views=measurement.views, cosine=np.ones(len(known)), intensity=usual)
    measurement = replace(
        measurement, capture=replace(bare, sightings=sightings),
        target_views=tuple(replace(like, index=v, gravity=down[v]) for v in range(K)),
    )  # fmt: skip
    rows = rows_of(measurement.capture, seen.T_mount, replace(landmarks, drawing=None, T_reference_part=None))
    unknown = np.zeros((*rows.residual.shape, landmarks.size - rows.landmarks.shape[2]))
    rows = replace(rows, landmarks=np.concatenate([rows.landmarks, unknown], axis=2))
    covariance = evidence_of_rows(rows, rows.hand_eye).covariance(variances)
    return rows, [effect_rows(rows, measurement, (), term) for term in terms], covariance
