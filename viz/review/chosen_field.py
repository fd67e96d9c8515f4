"""What a picture of the part shows of a choice in a plot: some views, targets, bins of a property, a place."""

import base64
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.errors import InputError
from stitch.numerics.frames import Array, Indices, Mask
from viz.part_data import packed_values
from viz.review.residual_rows import ResidualRows
from viz.target_scene import ANY, NOTHING, mark_values

# Patches about a correspondence that it counts for, and within how many of their radii.
_PATCHES = 8
_REACH = 1.5
_SAME_SIDE = 0.5
# Sides of a view on a patch below which it says nothing.
_ENOUGH = 8.0


@dataclass(frozen=True)
class Choice:
    """Hold the choice of views and covariates; everything where nothing is stated."""

    views: frozenset[str] = frozenset()
    targets: frozenset[str] = frozenset()
    bins: dict[str, tuple[int, int]] = field(default_factory=dict)  # property -> first and last bin of its table
    place: tuple[float, float, float] | None = None  # reference frame
    within: float = 0.0  # length_unit


@dataclass(frozen=True)
class PatchWeights:
    """Weigh every side on the patches of the part; K patches, weights (N, k), 0 where none is near."""

    patch: Indices  # (N, k)
    weight: Array  # (N, k)
    count: int
    radius: float


def patch_weights(rows: ResidualRows, part: str) -> PatchWeights:
    """Weights for the patches of a viewer's data (JSON).

    Raises:
        InputError: data of a page that an older version wrote.
    """
    data = json.loads(part)
    if "facing" not in data:
        raise InputError("report.html: was written by an older version; to fix: `stitch report RUN --no-diagnosis`")
    axes, radius = np.array(data["axes"]), float(data["patchRadius"])
    points = (_floats(data["patches"]) * data["size"] + np.array(data["centre"])) @ axes
    normals = _floats(data["facing"]) @ axes
    half = len(rows.view) // 2  # both sides share the place
    near = min(_PATCHES, len(points))
    distance, index = KDTree(np.ascontiguousarray(points)).query(
        np.ascontiguousarray(rows.place[:half]), k=near, distance_upper_bound=_REACH * radius
    )
    distance, index = distance.reshape(half, near), index.reshape(half, near)
    found = np.isfinite(distance)
    index = np.where(found, index, 0).astype(np.int32)
    found &= np.einsum("nki,ni->nk", normals[index], rows.normal[:half]) > _SAME_SIDE
    weight = np.where(found, np.exp(-((distance / radius) ** 2) / 2), 0.0).astype(np.float32)
    return PatchWeights(index, weight, len(points), radius)


def numbered_marks(rows: ResidualRows, part: str) -> Indices:
    """(M, 2) view and target of the marks of a viewer's data (JSON), as numbers of the rows.

    Raises:
        InputError: data of a page that an older version wrote, or of another run.
    """
    data = json.loads(part)
    try:
        return np.array([_numbered(view, target, rows) for view, target in data["marks"]], np.int64)
    except (KeyError, ValueError):
        raise InputError(
            "report.html: is not of this run as it stands; to fix: `stitch report RUN --no-diagnosis`"
        ) from None


def _numbered(view: str | None, target: str | None, rows: ResidualRows) -> tuple[int, int]:
    if view is None and target is None:
        return NOTHING, NOTHING
    return (
        ANY if view is None else rows.views.index(view),
        ANY if target is None else rows.targets.index(target),
    )


def chosen_numbers(
    rows: ResidualRows, shown: PatchWeights | Indices, choice: Choice, comparison: dict[str, Any] | None, um: float
) -> dict[str, Any]:
    """What a picture shows of a choice, and its numbers; plain data, errors in µm.

    Args:
        shown: weights of the patches whose field is shown, or (M, 2) marks of labelled points as `numbered_marks` has
            them.
        comparison: compare.json, whose tables have the bins.

    Raises:
        InputError: a view, a target, a property or a bin that the run does not have.
    """
    mask = chosen_rows(rows, choice, comparison)
    e = rows.residual[mask] * um
    told = {
        "views": len(np.unique(rows.view[mask])),
        "correspondences": round(len(e) / rows.share),
        "rms": float(np.sqrt(np.mean(e**2))) if len(e) else None,
    }
    if not isinstance(shown, PatchWeights):  # distances of labelled points have no sign
        values = mark_values(shown, rows.view[mask], rows.target[mask], e)
        return told | {"signed": None, "mean": None, "values": packed_values(values)}
    overall = _overall(rows, shown, mask) * um
    seen = overall[np.isfinite(overall)]
    return told | {
        "signed": float(e.mean()) if len(e) else None,
        "mean": float(seen.mean()) if len(seen) else None,
        "values": packed_values(overall),
    }


def _overall(rows: ResidualRows, weights: PatchWeights, mask: Mask) -> Array:
    """(K,) mean over the chosen views of |their mean distance| at a patch; NaN where none of them tells."""
    half = max(len(rows.view) // 2, 1)
    size, count = np.zeros((2, weights.count))
    for v in range(len(rows.views)):
        own = np.flatnonzero(mask & (rows.view == v))
        patch, weight = weights.patch[own % half].ravel(), weights.weight[own % half]
        total = np.bincount(patch, weight.ravel(), weights.count)
        sums = np.bincount(patch, (weight * rows.residual[own, None]).ravel(), weights.count)
        told = total > _ENOUGH
        size[told] += np.abs(sums[told] / total[told])
        count += told
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(count > 0, size / np.maximum(count, 1), np.nan))


def chosen_rows(rows: ResidualRows, choice: Choice, comparison: dict[str, Any] | None) -> Mask:
    """(N,) sides that meet all that was stated.

    Raises:
        InputError: a view, a target, a property or a bin that the run does not have.
    """
    mask = np.ones(len(rows.view), bool)
    if choice.views:
        if unknown := sorted(choice.views - set(rows.views)):
            raise InputError(f"{unknown[0]}: no such view in this run")
        mask &= np.isin(rows.view, [rows.views.index(name) for name in choice.views])
    if choice.targets:
        if unknown := sorted(choice.targets - set(rows.targets)):
            raise InputError(f"{unknown[0]}: no such target in this run")
        mask &= np.isin(rows.target, [rows.targets.index(name) for name in choice.targets])
    for name, (first, last) in choice.bins.items():
        mask &= _in_bins(rows, name, first, last, comparison or {})
    if choice.place is not None:
        mask &= np.linalg.norm(rows.place - np.array(choice.place), axis=1) < choice.within
    return mask


def _in_bins(rows: ResidualRows, name: str, first: int, last: int, comparison: dict[str, Any]) -> Mask:
    """Sides whose value lies in the bins `first` … `last` of a table: low ≤ value < high, the last bin to its end."""
    table = next((t for t in comparison.get("tables", []) if t["name"] == name and not t["label"]), None)
    if table is None or not 0 <= first <= last < len(table["low"]):
        raise InputError(f"{name}: no such property or bin in compare.json; run `stitch compare` again")
    values = rows.properties.get(name)
    if values is None:
        known = {row["view"]: row["values"].get(name) for row in comparison.get("views", [])}
        of_view = np.array([np.nan if known.get(v) is None else known[v] for v in rows.views], float)
        values = of_view[rows.view]
    open_end = last < len(table["low"]) - 1
    low, high = table["low"][first], table["high"][last]
    # Few points lie beyond the ends of the table: its bins were made of a sample.
    above = values >= low if first else np.isfinite(values)
    return np.asarray(above & (values < high) if open_end else above)


def _floats(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 3).astype(float)
