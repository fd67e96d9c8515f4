"""Smooth errors of a scanner that are new in every scan: how large the overlaps show them, and what they do.

Speckle, exposure and warm air bend each scan a little, by an amount that changes slowly over the field and is another
one in the next scan. No noise of single points shows it, and no error that all views share. It makes the distances
between overlapping surfaces alike where they lie close together: their covariance over the way from one to the other
(the variogram, Matheron 1963) has the errors' size and length in it. In each pair of views the distances are

    e = B δ + noise + c_v f_v(u_v) − c_w f_w(u_w),    cov f(u), f(u') = s² exp(−|u − u'|²/2ℓ²),

with any motion δ of the pair, directions u in the scanner's field and cosines c of incidence. What motions take up is
projected out; s and ℓ are weighed by their posterior, all pairs together (a composite likelihood: Varin, Reid
and Firth 2011, Statistica Sinica 21:5).
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag

from stitch.numerics import frames
from stitch.numerics.distributions import tukey
from stitch.numerics.frames import Array, Indices
from stitch.observations.surfaces.matching import Match
from stitch.observations.surfaces.normal_equations import RMS_GATE
from stitch.observations.surfaces.scanner_errors import SHARE_SPREAD, USUAL_SHARE, error_shapes
from stitch.observations.surfaces.view_poses import UnconstrainedPoses, solve_view_sums
from stitch.session.measurement import Measurement

# Lengths ℓ that are tried, as shares of half the field; shorter ones are noise that neighbours share, longer ones look
# like motions of the views.
_LENGTHS = (0.12, 0.2, 0.33, 0.55)
# Sizes s that are tried, in the scanner's noise, and noise of a pair, in its robust sigma.
_SIZES, _NOISES = np.geomspace(0.02, 10.0, 32), np.geomspace(0.2, 1.6, 24)
# Means of neighbours that are compared in a pair, the fewest distances that tell anything, and pairs of a session.
_MOST_SAMPLES, _FEWEST, _MOST_PAIRS = 256, 40, 24
# Places along one side of the field where errors are free, up to beyond its corners.
_NODES = np.linspace(-1.3, 1.3, 41)
# Of the errors' variance this share counts in modes; the others carry the rest. So many modes of all views at most.
_KEPT, _MOST_MODES, _FEWEST_MODES = 0.9, 2500, 12


@dataclass(frozen=True)
class ScanErrors:
    """Errors along the ray, M independent modes of unit variance in every scan; lengths in length_unit."""

    size: float  # s, one sigma
    degrees: float  # of freedom with which the size is known
    half: float  # half the field: |x/z| of its longer side
    basis: CubicSpline  # of one side of the field
    modes: tuple[Indices, Indices]  # (M,) the functions of either side whose products they are
    scale: float  # of the products: modes that are left out count in those that stay

    @property
    def count(self) -> int:
        """M."""
        return len(self.modes[0])

    def along(self, away: Array) -> Array:
        """Return (N, M) by which points at rays (N, 3) from the scanner's eye lie too far."""
        across, down = (self.basis(side) for side in _field_places(away, self.half).T)
        return self.scale * across[:, self.modes[0]] * down[:, self.modes[1]]


def fit_scan_errors(
    measurement: Measurement, unconstrained: UnconstrainedPoses, noise: float, shared: Array, half: Array
) -> ScanErrors | None:
    """Return the errors that the overlaps show; None where too few distances are at hand.

    Args:
        noise: of the scanner along the ray.
        shared: (K,) errors that all views have in common, as `sum_smooth_errors` counts them: they are taken off.
        half: (2,) of the scanner's field.
    """
    width = float(half.max())
    samples = _pair_samples(measurement, unconstrained, shared, half)
    if not samples or not np.isfinite(noise):
        return None
    likelihood = np.zeros((len(_LENGTHS), len(_SIZES)))
    for distances, rows, sides in samples:
        free = np.linalg.qr(rows, mode="complete")[0][:, rows.shape[1] :]
        scale = float(np.sqrt(np.mean((free.T @ distances) ** 2)))
        noises = (scale * _NOISES) ** 2
        for at, length in enumerate(_LENGTHS):
            kernel = sum(np.outer(c, c) * _correlation(_field_places(away, width), length) for away, c in sides)
            values, vectors = np.linalg.eigh(free.T @ kernel @ free)
            square = (vectors.T @ (free.T @ distances)) ** 2
            spread = (noise * _SIZES[:, None, None]) ** 2 * np.maximum(values, 0.0) + noises[:, None]
            each = -0.5 * (np.log(spread) + square / spread).sum(axis=-1)
            likelihood[at] += each.max(axis=1)
    views = len({view for pair in unconstrained.overlaps.pairs for view in pair})
    # Each scan has a part in several pairs, which are not independent.
    log_posterior = likelihood * min(1.0, views / len(samples))
    log_posterior -= 0.5 * (np.log(_SIZES / USUAL_SHARE) / SHARE_SPREAD) ** 2
    weights = np.exp(log_posterior - log_posterior.max())
    weights /= weights.sum()
    variances = (noise * _SIZES) ** 2
    mean = float(weights.sum(axis=0) @ variances)
    scatter = float(weights.sum(axis=0) @ variances**2) - mean**2
    # A variance of so many degrees of freedom has twice its square over them as variance.
    return _modes_of(weights @ variances, 2 * mean**2 / max(scatter, 1e-3 * mean**2), width, unconstrained)


def scan_error_twists(
    measurement: Measurement, unconstrained: UnconstrainedPoses, errors: ScanErrors, view: int
) -> Array:
    """Return twists (6V, M) of all views that the overlaps show for each mode of one scan."""
    capture = measurement.capture
    overlaps = unconstrained.overlaps
    g = overlaps.gram
    pulls = np.zeros((g.views, 6, errors.count))
    for pair, match in zip(overlaps.pairs, overlaps.matches, strict=True):
        if view not in pair:
            continue
        m = match if match.v == view else match.swapped()
        scan = capture.scans[view]
        away = scan.points[m.index_v] - scan.eye
        moved = _cosines(away, m.normal, unconstrained.poses[view])[:, None] * errors.along(away)
        rows = frames.plane_rows(m.middle - g.centre, m.normal) * (m.weight * tukey(m.residual, g.scale))[:, None]
        pull = rows.T @ moved
        # The views move against what their points do, to where the surfaces meet again.
        pulls[m.v] -= pull
        pulls[m.w] += pull
    return solve_view_sums(g, pulls.reshape(6 * g.views, -1), np.zeros((6 * g.views, errors.count)))


def _modes_of(variances: Array, degrees: float, half: float, unconstrained: UnconstrainedPoses) -> ScanErrors:
    """Return errors with variances (lengths,) of each length, in as few modes as hold them, the largest first."""
    roots = list[Array]()
    shares = list[Array]()
    for variance, length in zip(variances, _LENGTHS, strict=True):
        values, vectors = np.linalg.eigh(_correlation(_NODES[:, None], length))
        values = np.maximum(values, 0.0) * np.sqrt(variance)
        roots.append(vectors * np.sqrt(values))
        shares.append(np.outer(values, values) / len(_NODES) ** 2)
    # Functions of either side belong together if they are of one length.
    together = block_diag(*shares)
    order = np.argsort(-together, axis=None)
    held = np.cumsum(np.take(together, order))
    needed = int(np.searchsorted(held, _KEPT * held[-1])) + 1
    kept = min(needed, max(_MOST_MODES // len(unconstrained.poses), _FEWEST_MODES))
    first, second = np.unravel_index(order[:kept], together.shape)
    used = np.unique(np.concatenate([first, second]))
    return ScanErrors(
        size=float(np.sqrt(variances.sum())),
        degrees=degrees,
        half=half,
        basis=CubicSpline(_NODES, np.hstack(roots)[:, used]),
        modes=(np.searchsorted(used, first), np.searchsorted(used, second)),
        scale=float(np.sqrt(held[-1] / held[kept - 1])),
    )


def _pair_samples(
    measurement: Measurement, unconstrained: UnconstrainedPoses, shared: Array, half: Array
) -> list[tuple[Array, Array, list[tuple[Array, Array]]]]:
    """Per pair: distances (N,), rows (N, 6) of a motion, and of either view rays (N, 3) and cosines (N,).

    Each is the mean of neighbours in the field, so that all distances of a pair count; times the root of their share.
    Which pairs stand for all goes by their scans, not by the order of the views.
    """
    overlaps = unconstrained.overlaps
    g = overlaps.gram
    scans = measurement.capture.scans
    # A scan is told by its points alone.
    mark = [float(scan.points.sum()) for scan in scans]
    enough = [m if mark[m.v] < mark[m.w] else m.swapped() for m in overlaps.matches if len(m.residual) >= _FEWEST]
    enough.sort(key=lambda m: (mark[m.v], mark[m.w]))
    chosen = [enough[k] for k in np.unique(np.linspace(0, len(enough) - 1, _MOST_PAIRS).astype(int))] if enough else []
    samples = []
    for match in chosen:
        sound = np.flatnonzero(np.abs(match.residual) < RMS_GATE * g.scale)
        if len(sound) < _FEWEST:
            continue
        m = Match(match.v, match.w, *(column[sound] for column in match.columns))
        cell = _field_cells(scans[m.v].points[m.index_v] - scans[m.v].eye, m.index_w)
        count = np.bincount(cell)
        distances = np.array(m.residual)
        sides = []
        for view, index, sign in ((m.v, m.index_v, 1.0), (m.w, m.index_w, -1.0)):
            scan = scans[view]
            away = scan.points[index] - scan.eye
            cosine = measurement.scan_views[view].cosine[index]
            pose = unconstrained.poses[view]
            normal = frames.rotate(frames.inverse(pose), m.normal)
            distances -= sign * error_shapes(away, cosine, half).along_normals(normal) @ shared
            sides.append((_means(away, cell), _means(_cosines(away, m.normal, pose), cell)))
        share = np.sqrt(count / count.mean())
        rows = _means(frames.plane_rows(m.middle - g.centre, m.normal), cell)
        samples.append((share * _means(distances, cell), share[:, None] * rows, [(a, share * c) for a, c in sides]))
    return samples


def _field_cells(away: Array, partner: Indices) -> Indices:
    """(N,) cells, at most so many, in which rays (N, 3) lie close together: halved along the longer side, in turn.

    Args:
        partner: (N,) that tells apart what lies at one place, whatever its order.
    """
    places = away[:, :2] / away[:, 2:]
    cells = [np.arange(len(places))]
    while 2 * len(cells) <= min(_MOST_SAMPLES, len(places)):
        halves = []
        for members in cells:
            side = int(np.ptp(places[members], axis=0).argmax())
            order = np.lexsort((partner[members], places[members, 1 - side], places[members, side]))
            halves += np.array_split(members[order], 2)
        cells = halves
    cell = np.empty(len(places), np.int64)
    for number, members in enumerate(cells):
        cell[members] = number
    return cell


def _means(values: Array, cell: Indices) -> Array:
    """Return the means (n, ...) of values (N, ...) in each cell."""
    sums = np.zeros((int(cell.max()) + 1, *values.shape[1:]))
    np.add.at(sums, cell, values)
    return np.asarray((sums.T / np.bincount(cell)).T)


def _cosines(away: Array, normal: Array, pose: Array) -> Array:
    """(N,) of rays (N, 3), scanner frame, with normals (N, 3), reference frame."""
    rays = away / np.linalg.norm(away, axis=1)[:, None]
    return np.asarray(np.einsum("ni,ni->n", rays, frames.rotate(frames.inverse(pose), normal)))


def _field_places(away: Array, half: float) -> Array:
    """(N, 2) where rays (N, 3) pass through the field, in halves of its longer side."""
    return np.clip(away[:, :2] / away[:, 2:] / half, _NODES[0], _NODES[-1])


def _correlation(places: Array, length: float) -> Array:
    """(N, N) of places (N, d)."""
    square = (places**2).sum(axis=1)
    return np.exp(-np.maximum(square[:, None] + square - 2 * places @ places.T, 0.0) / (2 * length**2))
