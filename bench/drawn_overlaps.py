"""What overlaps show where points are not where they were: how far the views move for it, and what that leaves."""

from dataclasses import replace

import numpy as np

from data_synth.moment import Moment
from data_synth.nature import Nature
from data_synth.scanner import Cloud
from data_synth.scene import Scene
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import gram, robust_scale
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, visible_step
from stitch.session.measurement import Measurement

_PLACES = ("points", "surface")
# Weights follow the distances; after these steps both stand still.
_STEPS = 8


def with_moved_points(
    freed: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moments: list[Moment]
) -> UnconstrainedPoses:
    """Views that were freed with the points as they are, freed anew after the laws have moved the points.

    The pairs stay: laws of the sizes that are asked move points by less than the noise.
    """
    if not any(map(laws.touches, _PLACES)):
        return freed
    moved = [
        frames.rotate(T, _moved(v, freed, measurement, scene, laws, moments[v])) for v, T in enumerate(freed.poses)
    ]
    matches = [_with(m, moved[m.v][m.index_v] - moved[m.w][m.index_w]) for m in freed.overlaps.matches]
    g, twists = freed.overlaps.gram, freed.twists
    g = gram(matches, g.views, g.centre, robust_scale(matches))
    for _ in range(_STEPS):
        step = visible_step(g)
        twists = twists + step
        matches = [_with(m, _carried(m, step, g.centre)) for m in matches]
        g = gram(matches, g.views, g.centre, robust_scale(matches))
    return replace(freed, twists=twists, overlaps=replace(freed.overlaps, matches=matches, gram=g))


def _with(m: Match, further: Array) -> Match:
    """The correspondences with points of the first view further (M, 3) from those of the second."""
    return replace(m, residual=m.residual + np.einsum("ij,ij->i", further, m.normal))


def _carried(m: Match, twists: Array, centre: Array) -> Array:
    """(M, 3) how far twists (V, 6) about a centre carry the first view from the second."""
    turn, shift = np.split(twists[m.v] - twists[m.w], 2)
    return np.asarray(np.cross(turn, m.middle - centre) + shift)


def _moved(
    v: int, freed: UnconstrainedPoses, measurement: Measurement, scene: Scene, laws: Nature, moment: Moment
) -> Array:
    """(N, 3) how far the laws move the points of view v, scanner frame; 0 for points without a partner."""
    scan, seen = measurement.capture.scans[v], measurement.scan_views[v]
    at = _with_partner(v, freed)
    points, out = scan.points[at], np.zeros_like(scan.points)
    T = frames.inverse(scene.T_reference_part) @ freed.poses[v]
    on_part = laws.act("surface", moment, frames.transform(T, points))
    bright = np.full(len(at), 0.5) if seen.intensity is None else 0.5 + 0.18 * seen.intensity[at]
    cloud = Cloud(frames.transform(frames.inverse(T), on_part), bright, seen.cosine[at])
    out[at] = laws.act("points", moment, cloud).points - points
    return out


def _with_partner(v: int, freed: UnconstrainedPoses) -> Indices:
    """Points of view v that have a partner in any other view."""
    found = [m.index_v if m.v == v else m.index_w for m in freed.overlaps.matches if v in (m.v, m.w)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *found]))
