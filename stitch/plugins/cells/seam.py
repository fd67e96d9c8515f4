"""Flush and gap of a seam at its stations, from both scanned edges; and the bond gap of a pane that is to be placed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.distributions import mad_sigma, tukey
from stitch.numerics.frames import Array, Indices
from stitch.plugins.cells.cad import tukey_slope
from stitch.plugins.cells.placed_scans import SOURCES, JoinedScans, PlacingErrors

# Fewer points of a surface or flank fix no edge to a twentieth of a millimetre.
_FEWEST = 25
# Edge of the squares whose points share what the model leaves, mm.
_SQUARE = 3.0
# Points further from the edge than this say nothing about it that the surface's bend does not blur, mm.
_REACH = 22.0
# Width of the strip along the seam that is fitted, and how far across and down it reaches, mm.
_ALONG, _ACROSS, _DEPTH = 12.0, 40.0, 20.0
VERDICTS = ("good", "bad", "open", "not measured")


def find_edge(points: Array, normals: Array, facing: float, moves: Array | None = None) -> tuple[Array, Array, Array]:
    """Return where outer surface (bent both ways) and flank (straight down, bent along) meet at the station.

    Args:
        points: (N, 3) across, along and height in the station's frame, of one side of the seam only; length in mm.
        normals: (N, 3) in the same frame.
        facing: +1 if the flank looks towards positive `across`, else −1.
        moves: (P, N, 3) small motions of the points to which the edge's answer is wanted.

    Returns:
        The edge (2,) across the seam and in height over the surface, its covariance (2, 2), its answers (2, P).

    Raises:
        NoResultError: the surface or the flank was not seen; names which.
    """
    up = normals[:, 2]
    out = facing * normals[:, 0]
    flank = np.flatnonzero((out > 0.75) & (up < 0.6))
    if len(flank) < _FEWEST:
        raise NoResultError(f"{len(flank)} points on the flank; to fix: scan it leaned by 30 to 45° towards it")
    rim = np.median(points[flank, 0])
    # Past the edge lies what is seen through the gap.
    behind = facing * (rim - points[:, 0])
    top = np.flatnonzero((up > 0.85) & (behind > 0) & (behind < _REACH))
    if len(top) < _FEWEST:
        raise NoResultError(f"{len(top)} points on the outer surface; to fix: scan the seam wider")
    # The flank of a bent sheet may bend too further down: only its upper part makes the edge.
    flank = flank[points[flank, 2] > np.median(points[top, 2]) - _REACH / 2]
    if len(flank) < _FEWEST:
        raise NoResultError(
            f"{len(flank)} points on the flank's upper part; to fix: scan it leaned by 30 to 45° towards it"
        )
    a, s, h = points[top].T
    design = np.column_stack([a**0, a - rim, s, (a - rim) ** 2, s**2, (a - rim) * s])
    surface, surface_spread, surface_gain = _robust(design, h, points[top, :2])
    a, s, h = points[flank].T
    wall, wall_spread, wall_gain = _robust(np.column_stack([a**0, h, s, s**2]), a, points[flank, 1:])
    place = _meet(surface, wall, rim)
    step = 1e-5
    columns = [(_meet(surface + step * d, wall, rim) - place) / step for d in np.eye(6)]
    columns += [(_meet(surface, wall + step * d, rim) - place) / step for d in np.eye(4)]
    J = np.column_stack(columns)
    spread = np.zeros((10, 10))
    spread[:6, :6], spread[6:, 6:] = surface_spread, wall_spread
    moves = np.zeros((0, *points.shape)) if moves is None else moves
    # A moved surface is seen higher, a moved flank further across, each by its motion along the normal.
    along = np.einsum("pni,ni->pn", moves, normals)
    change = np.vstack(
        [surface_gain @ (along[:, top] / up[top]).T, wall_gain @ (along[:, flank] / normals[flank, 0]).T]
    )
    return place, J @ spread @ J.T, J @ change


def bond_gap(
    points: Array, normals: Array, pane: NDArray[np.bool_], edge: float, thickness: float, moves: Array
) -> tuple[float, float, Array]:
    """Return how far a pane's inner face stands over the flange behind it, its variance, and its answers (P,) to moves.

    The inner face lies a glass's thickness behind the outer one. Both faces are parabolas, of the flange across its own
    short width a line; they are compared in the middle of what was seen of the flange behind the pane.

    Args:
        points, normals: (N, 3) across, along and height in the station's frame, mm.
        pane: (N,) whose points are the pane's; the others are the body's.
        edge: of the pane, across.
        moves: (P, N, 3) small motions of the points.

    Raises:
        NoResultError: flange or pane was not seen; names which.
    """
    flat = (normals[:, 2] > 0.85) & (points[:, 0] < edge) & (points[:, 0] > edge - _REACH)
    flange = np.flatnonzero(flat & ~pane)
    face = np.flatnonzero(flat & pane)
    for name, index in (("flange", flange), ("pane", face)):
        if len(index) < _FEWEST:
            raise NoResultError(f"{len(index)} points on the {name}; to fix: scan it within {_REACH:g} mm of the edge")
    middle = np.median(points[flange, 0])
    height, variance, change = -thickness, 0.0, np.zeros(len(moves))
    for index, sign in ((face, 1.0), (flange, -1.0)):
        a, s, h = points[index].T
        design = np.column_stack([a**0, a - middle, s, s**2, (a - middle) ** 2])
        surface, spread, gain = _robust(design if sign > 0 else design[:, :4], h, points[index, :2])
        height += sign * surface[0]
        variance += spread[0, 0]
        along = np.einsum("pni,ni->pn", moves[:, index], normals[index]) / normals[index, 2]
        change += sign * along @ gain[0]
    return float(height), float(variance), change


def _meet(surface: Array, wall: Array, rim: float) -> Array:
    """Return (across, height) where both hold at the station itself (along = 0)."""
    a = rim
    for _ in range(50):
        h = surface[0] + surface[1] * (a - rim) + surface[3] * (a - rim) ** 2
        a = wall[0] + wall[1] * h
    return np.array([a, h])


def _robust(design: Array, values: Array, places: Array) -> tuple[Array, Array, Array]:
    """Return coefficients, their covariance and their change per value, of a linear fit with Tukey weights, 20 rounds.

    What a facet or a bend leaves is shared by neighbours, so the covariance counts squares of places (N, 2) on the
    surface and not points as independent (cluster-robust sandwich, Liang & Zeger 1986). The height is no part of a
    place: a border between high and low points would put the noise of one sign together, and call that shared.
    """
    weight = np.ones(len(values))
    for _ in range(20):
        root = np.sqrt(weight)
        coefficients = np.asarray(np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0], float)
        residual = values - design @ coefficients
        scale = max(mad_sigma(residual), 1e-9)
        weight = tukey(residual, scale)
    slope = tukey_slope(residual, scale)
    inverse = np.linalg.inv(np.einsum("ni,n,nj->ij", design, slope, design))
    _, square = np.unique(np.floor(places / _SQUARE).astype(int), axis=0, return_inverse=True)
    scores = np.zeros((square.max() + 1, design.shape[1]))
    np.add.at(scores, square.ravel(), design * (weight * residual)[:, None])
    squares, unknowns = scores.shape
    few = squares / max(squares - unknowns, 1)
    return coefficients, few * inverse @ scores.T @ scores @ inverse, inverse @ (design * slope[:, None]).T


@dataclass(frozen=True)
class Limits:
    """Nominal values and tolerances, mm; the source's are the defaults."""

    flush: float = 0.0
    flush_tolerance: float = 1.5
    gap: float = 16.0
    gap_tolerance: float = 2.0


@dataclass(frozen=True)
class Station:
    """A place of the seam; part frame."""

    name: str
    middle: Array  # (3,) in the nominal gap's middle, on the outer surface
    across: Array  # (3,) from the inner part (pane) to the outer one (body)
    outwards: Array  # (3,)

    @property
    def T_part_station(self) -> Array:
        """(4, 4) with axes across, along, outwards."""
        z = self.outwards / np.linalg.norm(self.outwards)
        x = self.across - (self.across @ z) * z
        x /= np.linalg.norm(x)
        return frames.make(np.column_stack([x, np.cross(z, x), z]), self.middle)


@dataclass(frozen=True)
class Seam:
    """One station measured, mm; NaN and a reason where it could not be."""

    station: str
    flush: float = np.nan  # inner part above (+) or below (−) the outer one
    gap: float = np.nan  # between the edges, along `across`
    sigma_flush: float = np.nan
    sigma_gap: float = np.nan
    verdict: str = "not measured"  # of VERDICTS
    reason: str = ""
    inner: tuple[float, float] | None = None  # its edge: across and outwards in the station's frame
    outer: tuple[float, float] | None = None
    bond: float = np.nan  # from the pane's inner face to the flange behind it, before the pane is placed
    sigma_bond: float = np.nan


@dataclass(frozen=True)
class Pane:
    """A pane that is yet to be placed; its scans lie where it will stand."""

    first: int  # its first scan: those before it show the body
    thickness: float  # of the glass, mm


def measure_seam(
    scan: JoinedScans,
    T_base_part: Array,
    stations: Sequence[Station],
    limits: Limits,
    errors: PlacingErrors | None = None,
    pane: Pane | None = None,
) -> list[Seam]:
    """Return flush and gap at each station; and the bond gap where the inner part is a pane to be placed.

    Both edges are measured in the same cloud, so the fit of the part only says where to look and which way is across:
    an error of 1° in it changes a gap of 16 mm by 2.4 µm.

    Args:
        T_base_part: (4, 4) of the part in whose frame the stations are given.
        errors: how the scans' places may err. What moves both edges alike does not count.
    """
    return [_measure_station(scan, T_base_part, station, limits, errors, pane) for station in stations]


def _measure_station(
    scan: JoinedScans,
    T_base_part: Array,
    station: Station,
    limits: Limits,
    errors: PlacingErrors | None,
    pane: Pane | None,
) -> Seam:
    T_station_base = frames.inverse(T_base_part @ station.T_part_station)
    points = frames.transform(T_station_base, scan.points)
    near = scan.usable & (np.abs(points) < np.array([_ACROSS, _ALONG, _DEPTH])).all(axis=1)
    points = points[near]
    normals = frames.rotate(T_station_base, scan.normals[near])
    modes: list[tuple[Indices, Array]] = []
    if errors is not None:
        modes = [mode for source in SOURCES for mode in errors.modes(scan.take(near), source)]
    moves = np.zeros((len(modes), *points.shape))
    for k, (index, moved) in enumerate(modes):
        moves[k, index] = frames.rotate(T_station_base, moved)
    # Of a pane that is placed, what belongs to it shows by the side of the gap alone.
    of_pane = points[:, 0] < 0 if pane is None else scan.view[near] >= pane.first
    bond, bond_variance, bond_moved = np.nan, np.nan, np.zeros(len(modes))
    try:
        inner, inner_spread, inner_moved = _side(points, normals, -1.0, "inner part", moves, of_pane)
        outer, outer_spread, outer_moved = _side(points, normals, 1.0, "outer part", moves, ~of_pane)
        if pane is not None:
            bond, bond_variance, bond_moved = bond_gap(points, normals, of_pane, inner[0], pane.thickness, moves)
    except NoResultError as error:
        return Seam(station.name, reason=str(error))
    gap = float(outer[0] - inner[0])
    flush = float(inner[1] - outer[1])
    apart = ((outer_moved - inner_moved) ** 2).sum(axis=1)
    sigma_gap, sigma_flush = np.sqrt(np.diag(inner_spread) + np.diag(outer_spread) + apart)
    verdict = _verdict(
        (abs(flush - limits.flush) - limits.flush_tolerance, sigma_flush),
        (abs(gap - limits.gap) - limits.gap_tolerance, sigma_gap),
    )
    return Seam(
        station.name,
        flush,
        gap,
        sigma_flush=float(sigma_flush),
        sigma_gap=float(sigma_gap),
        verdict=verdict,
        inner=(float(inner[0]), float(inner[1])),
        outer=(float(outer[0]), float(outer[1])),
        bond=bond,
        sigma_bond=float(np.sqrt(bond_variance + bond_moved @ bond_moved)),
    )


def _side(
    points: Array, normals: Array, side: float, name: str, moves: Array, own: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Return the edge on one side of the gap's middle: the inner part lies on the negative, its flank looks to +."""
    here = own & (side * points[:, 0] > 0)
    try:
        return find_edge(points[here], normals[here], -side, moves[:, here])
    except NoResultError as error:
        raise NoResultError(f"{name}: {error}") from None


def _verdict(*checks: tuple[float, float]) -> str:
    """Good if every excess over a tolerance is below zero by two sigmas, bad if any is above by two; else open."""
    if any(excess > 2 * sigma for excess, sigma in checks):
        return "bad"
    return "good" if all(excess < -2 * sigma for excess, sigma in checks) else "open"
