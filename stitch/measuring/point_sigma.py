"""The standard uncertainty of every point of the stitched cloud along its normal."""

from pathlib import Path

import numpy as np
from numpy.lib import recfunctions
from plyfile import PlyData, PlyElement

from stitch import frames
from stitch.frames import Array, Indices, Mask
from stitch.measuring.place_errors import PlaceErrors
from stitch.runs.run import FusedCloud
from stitch.system.files import whole_file

# A view has a part in a fused point where it has one of its own within so many cells.
_WITHIN = 1.5
_BLOCK = 200_000


def point_sigmas(places: PlaceErrors, cloud: FusedCloud) -> Array:
    """Return (N,) by which each fused point may lie off along its normal, one sigma, length_unit."""
    scans = places.capture.scans
    cell = _WITHIN * float(np.median([scan.scanned_spacing for scan in scans]))
    out = np.empty(len(cloud.points))
    for start in range(0, len(out), _BLOCK):
        block = slice(start, start + _BLOCK)
        out[block] = _sigmas(places, cloud.points[block], cloud.normals[block], cell)
    return out


def _sigmas(places: PlaceErrors, points: Array, normals: Array, cell: float) -> Array:
    seen, nearest = _views_of(places, points, cell)
    lever = np.concatenate([np.cross(points - places.centre, normals), normals], axis=1)
    sets, member = np.unique(seen, axis=0, return_inverse=True)
    square = np.zeros(len(points))
    twists = [source.views.reshape(len(places.poses), 6, -1) for source in places.sources]
    for k, views in enumerate(sets):
        own = np.flatnonzero(member.ravel() == k)
        shares = views / max(views.sum(), 1)
        mean = np.concatenate([np.tensordot(shares, t, axes=1) for t in twists], axis=1)
        moved = lever[own] @ mean + _of_points(places, views, shares, nearest[own], normals[own])
        square[own] = np.einsum("nm,nm->n", moved, moved)
        square[own] += sum(share**2 * scan.noise**2 for share, scan in zip(shares, places.capture.scans, strict=True))
    return np.sqrt(square)


def _views_of(places: PlaceErrors, points: Array, cell: float) -> tuple[Mask, Indices]:
    """(N, V) which views see each point, at least the nearest one, and the nearest point of every view."""
    distance, index = np.empty((len(points), len(places.poses))), np.empty((len(points), len(places.poses)), np.int64)
    for v, (scan, T) in enumerate(zip(places.capture.scans, places.poses, strict=True)):
        d, i = scan.tree.query(np.ascontiguousarray(frames.transform(frames.inverse(T), points)), k=1)
        distance[:, v], index[:, v] = d.ravel(), i.ravel()
    return (distance < cell) | (distance == distance.min(axis=1, keepdims=True)), index


def _of_points(places: PlaceErrors, views: Mask, shares: Array, nearest: Indices, normals: Array) -> Array:
    """(n, modes) by which errors of the points themselves move fused points along their normals."""
    out = np.zeros((len(normals), sum(source.views.shape[1] for source in places.sources)))
    field = np.concatenate([source.field for source in places.sources], axis=1)
    parameters = np.concatenate([source.parameters for source in places.sources], axis=1)
    for v in np.flatnonzero(views):
        seen = frames.rotate(frames.inverse(places.poses[v]), normals)
        out += shares[v] * np.einsum("ni,kni->nk", seen, places.field_modes(int(v), nearest[:, v])) @ field
        if places.slopes is not None:
            slopes = places.slopes.at(int(v), places.poses[v], nearest[:, v])
            out += shares[v] * np.einsum("ni,kni->nk", seen, slopes) @ parameters
    return out


def write_sigmas(path: Path, sigma: Array) -> None:
    """Write the points' sigma as a column of stitched.ply, whole or not at all."""
    vertex = PlyData.read(str(path))["vertex"].data
    kept = [name for name in vertex.dtype.names if name != "sigma"]
    rows = recfunctions.append_fields(vertex[kept], "sigma", sigma.astype("<f4"), usemask=False)
    with whole_file(path) as file:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(file))
