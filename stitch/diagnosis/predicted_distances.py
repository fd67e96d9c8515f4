"""What a candidate effect would leave between the surfaces, correspondence by correspondence."""

from collections.abc import Sequence

import numpy as np

from stitch.diagnosis.score import Score, score
from stitch.frames import Array
from stitch.model.forward import moves_points, scan_correction
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.match import Match, signed_distances
from stitch.observations.surfaces.surface_model import SurfaceObservation


def predicted_distances(linear: LinearModel, scored: Score | None = None) -> Array | None:
    """(M,) signed distances of all correspondences under the model, and the best form of a candidate with it.

    In the linear approximation, hand-eye and effects in use fitted anew beside the candidate, as `add` fits them: poses
    scatter independently. Beside all that an arm may do the hand-eye may lie far off, and what the arm then does is in
    no prediction. The candidate is scored anew for that: another of its forms may explain most where poses scatter
    independently than beside all that an arm may do, and that one `add` reaches.

    In the order of the matches to which the views were freed. None without clouds.
    """
    surfaces = linear.observation
    if not isinstance(surfaces, SurfaceObservation):
        return None
    fitted = linear.scatter_only
    if scored is not None and fitted is not linear:
        scored = score(fitted, scored.candidate)
    linear = fitted
    freed = surfaces.unconstrained
    poses = surfaces.capture.poses(linear.model.T_mount)
    points = [scan.points for scan in surfaces.capture.scans]
    twists = linear.design @ linear.baseline_trial.solve()
    if scored is not None:
        X, sums = np.hstack([linear.design, scored.form.response]), scored.candidate.points
        found = linear.trial(X, None if sums is None else sums.select(scored.form.keep)).solve()
        k = scored.form.response.shape[1]
        term = scored.form.at(found[-k:])
        if moves_points([term]):
            # Such an effect changes the points, and the views only as hand-eye and the others follow.
            twists = X[:, :-k] @ found[:-k]
            measurement, every = linear.measurement, slice(None)
            points = [p + scan_correction(measurement, [term], v, poses[v], every) for v, p in enumerate(points)]
        else:
            twists = X @ found
    matches, centre = freed.overlaps.matches, freed.overlaps.gram.centre
    return signed_distances(matches, poses, points) + _along_normals(matches, centre, twists.reshape(-1, 6))


def _along_normals(matches: Sequence[Match], centre: Array, twists: Array) -> Array:
    """(M,) B(δ_v − δ_w) of `gram.py`: what twists (V, 6) about `centre` do to the distances.

    Not by moving the views: where hand-eye and links can stand in for one another, both move far and their common
    motion alone counts.
    """
    out = []
    for m in matches:
        turned, moved = np.split(twists[m.v] - twists[m.w], 2)
        out.append(np.cross(m.middle - centre, m.normal) @ turned + m.normal @ moved)
    return np.concatenate(out)
