"""Pack the data of the part's viewer: the surface once, the field of every step of the model's history."""

import base64
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stitch.numerics.frames import Array
from stitch.numerics.units import MICROMETRES
from stitch.output.comparison.disagreement_field import full_colour_distance
from stitch.output.comparison.model_history import ModelHistory
from stitch.session.session import SessionData
from viz.colours import signed_colours, unsigned_colours
from viz.part_surface import Camera, PartSurface

# Arrays as text for a browser, small.


def packed_values(values: Array, bits: Literal[8, 16] = 16) -> dict[str, Any]:
    """So many bits a value and the size of one count; what nobody knows is the smallest number."""
    known, least = np.isfinite(values), -(2 ** (bits - 1))
    count = float(np.abs(values[known]).max(initial=0.0)) / (-least - 1) or 1.0
    counts = np.where(known, np.round(np.nan_to_num(values) / count), least).astype(f"<i{bits // 8}")
    return {"count": count, "bits": bits, "data": packed(counts)}


def packed_floats(numbers: Array) -> str:
    """32 bits a number."""
    return packed(numbers.astype("<f4"))


def packed(numbers: NDArray[Any]) -> str:
    """The bytes of an array, base64."""
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode()


# Views whose own field a page holds.
_VIEWS = 24
_STOPS = 31


class Extent(NamedTuple):
    """Hold centre and sides of what a viewer shows at first, in the camera's axes."""

    centre: Array  # (3,)
    sides: Array  # (3,)

    @property
    def size(self) -> float:
        """The longest side."""
        return float(self.sides.max()) or 1.0


def extent_of(points: Array, camera: Camera) -> Extent:
    """Return the extent of points (N, 3) in the reference frame."""
    flat = points @ camera.axes.T
    return Extent((flat.max(axis=0) + flat.min(axis=0)) / 2, np.ptp(flat, axis=0))


def part_data(
    surface: PartSurface,
    camera: Camera,
    history: ModelHistory,
    session: SessionData,
    extent: Extent | None = None,
) -> dict[str, Any]:
    """Plain data for JSON; lengths of the field in µm.

    Args:
        extent: shown at first, the part's own if None.
    """
    um, names = MICROMETRES[session.length_unit], session.names
    full = full_colour_distance(history.models[0].field, session) * um
    own = [step.field.values * um for step in history.steps]
    first = history.models[0].field
    worst = np.argsort(-np.nan_to_num(np.array([_mean_abs(v) for v in own[-2]])), kind="stable")[:_VIEWS]
    return {
        **packed_surface(surface, camera, history.patches.points, extent or extent_of(surface.vertices, camera)),
        "facing": packed_floats(history.patches.normals @ camera.axes.T),
        "patchRadius": history.patches.radius,
        "steps": [
            {
                "name": step.name,
                "mean": step.field.mean_abs * um,
                "noise": step.field.noise * um,
                "values": packed_values(step.field.overall * um),
            }
            for step in history.steps
        ],
        "views": [
            {
                "name": names[v],
                "index": v,
                "means": [_mean_abs(x[v]) for x in own],
                # For colours, of which there are fewer.
                "steps": [packed_values(x[v], 8) for x in own],
            }
            for v in sorted(int(v) for v in worst)
        ],
        "names": names,
        # Of the present model: how far each view lies off the others, how well each place is known, and who sees it.
        "byView": [float(f"{x:.4g}") if np.isfinite(x) else None for x in history.models[-1].field.by_view * um],
        "sigma": [round(x, 2) if np.isfinite(x) else None for x in (_standard_error(first.sigma) * um).tolist()],
        "seen": np.isfinite(first.values).sum(axis=0).tolist(),
        "full": full,
        "fullSigned": max(float(np.nanquantile(np.abs(first.values), 0.95)) * um, full),
        "colours": colour_stops(),
        "unseen": bool(np.isnan(first.overall).any()),
        "radius": f"{history.patches.radius:.3g} {session.length_unit}",
        "begin": 1,
        "end": len(history.steps) - 2,
    }


def packed_surface(surface: PartSurface, camera: Camera, patches: Array, extent: Extent) -> dict[str, Any]:
    """Vertices in the camera's axes within a box, 16 bits a coordinate."""
    flat = surface.vertices @ camera.axes.T
    centre, size = extent.centre, extent.size
    return {
        "vertices": packed(np.round((flat - centre) / size * 32767).astype("<i2")),
        "normals": packed(np.round(surface.normals @ camera.axes.T * 127).astype("i1")),
        "triangles": packed(surface.triangles.astype("<u4" if len(flat) > 65535 else "<u2")),
        "near": packed(surface.patch.astype("<u2")),
        "weight": packed(np.round(surface.weight * 255).astype("u1")),
        "patches": packed_floats((patches @ camera.axes.T - centre) / size),
        "axes": camera.axes.tolist(),
        "centre": centre.tolist(),
        "size": size,
        "box": (extent.sides / size).tolist(),
    }


def _mean_abs(values: Array) -> float:
    seen = np.abs(values[np.isfinite(values)])
    return float(seen.mean()) if len(seen) else 0.0


def _standard_error(sigma: Array) -> Array:
    """(K,) standard error of the mean over the views (V, K) that see a place."""
    known = np.isfinite(sigma)
    count = known.sum(axis=0)
    square = np.where(known, np.nan_to_num(sigma) ** 2, 0.0).sum(axis=0)
    return np.asarray(np.where(count > 0, np.sqrt(square) / np.maximum(count, 1), np.nan))


def colour_stops() -> dict[str, list[list[int]]]:
    """Return red, green and blue of both scales of a viewer at equal steps."""
    place = np.linspace(0, 1, _STOPS)
    signed, field = signed_colours(2 * place - 1, 1.0), unsigned_colours(place, 1.0)
    return {"field": field.tolist(), "signed": signed.tolist()}
