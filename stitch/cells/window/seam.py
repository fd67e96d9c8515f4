"""Flush and gap of a seam at its stations, from the scanned edges of both parts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.cells.window.edge import SeamEdge, find_edge
from stitch.cells.window.joined_scans import JoinedScans
from stitch.errors import NoResultError
from stitch.frames import Array

# Width of the strip along the seam that is fitted, and how far across and down it reaches, mm.
_ALONG, _ACROSS, _DEPTH = 12.0, 40.0, 20.0
VERDICTS = ("good", "bad", "open", "not measured")


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


def measure_seam(
    scan: JoinedScans, T_base_part: Array, stations: Sequence[Station], limits: Limits, pose_sigma: float = 0.0
) -> list[Seam]:
    """Flush and gap at each station.

    Both edges are measured in the same cloud, so the fit of the part only says where to look and which way is across:
    an error of 1° in it changes a gap of 16 mm by 2.4 µm.

    Args:
        T_base_part: (4, 4) of the part in whose frame the stations are given.
        pose_sigma: what one scan may stand off another, mm (the robot's pose error); it enters every sigma.
    """
    return [_measure(scan, T_base_part, station, limits, pose_sigma) for station in stations]


def _measure(scan: JoinedScans, T_base_part: Array, station: Station, limits: Limits, pose_sigma: float) -> Seam:
    T_station_base = frames.inverse(T_base_part @ station.T_part_station)
    points = frames.transform(T_station_base, scan.points)
    near = scan.usable & (np.abs(points) < np.array([_ACROSS, _ALONG, _DEPTH])).all(axis=1)
    points, normals = points[near], frames.rotate(T_station_base, scan.normals[near])
    try:
        inner = _side(points, normals, -1.0, "inner part")
        outer = _side(points, normals, 1.0, "outer part")
    except NoResultError as error:
        return Seam(station.name, reason=str(error))
    gap, flush = outer.across - inner.across, inner.height - outer.height
    variance = np.diag(inner.covariance) + np.diag(outer.covariance) + pose_sigma**2
    sigma_gap, sigma_flush = np.sqrt(variance)
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
        inner=(inner.across, inner.height),
        outer=(outer.across, outer.height),
    )


def _side(points: Array, normals: Array, side: float, name: str) -> SeamEdge:
    """The edge on one side of the gap's middle: the inner part lies on its negative side, its flank looks to +."""
    here = side * points[:, 0] > 0
    try:
        return find_edge(points[here], normals[here], -side)
    except NoResultError as error:
        raise NoResultError(f"{name}: {error}") from None


def _verdict(*checks: tuple[float, float]) -> str:
    """Good if every excess over a tolerance is below zero by two sigmas, bad if any is above by two; else open."""
    if any(excess > 2 * sigma for excess, sigma in checks):
        return "bad"
    return "good" if all(excess < -2 * sigma for excess, sigma in checks) else "open"
