"""The picture of a run on labelled points: targets and views in the base frame, coloured by how far off they lie."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.units import MICROMETRES
from stitch.output.comparison.model_history import TargetStep, target_history
from stitch.run_data import RunData
from viz.colours import robust_limit
from viz.part_data import colour_stops, extent_of, packed_surface, packed_values
from viz.part_surface import Camera, PartSurface, camera_for

if TYPE_CHECKING:
    import trimesh


# More than a screen can tell apart, and than a page of a few megabytes holds.
_MOST = 4000
_MANY = 800
ANY, NOTHING = -1, -2


@dataclass(frozen=True)
class Marks:
    """M marks in the base frame; each stands for what its view shows of its target."""

    shape: list[str]  # ball | pebble | probe | scanner | base
    T: Array  # (M, 4, 4)
    view: Indices  # (M,) number of the view, ANY, or NOTHING for a mark without a value
    target: Indices  # (M,) likewise

    @property
    def valued(self) -> Array:
        """(N, 3) places of those that have a value."""
        return self.T[self.view != NOTHING, :3, 3]

    @property
    def counted(self) -> Indices:
        """(M, 2) view and target of each."""
        return np.column_stack([self.view, self.target])


def marks_of(run: RunData) -> Marks:
    """Return the marks of a cell: a moving body stands wherever it stood.

    A carried scanner: the targets, and the scanner of every view. Carried targets: each wherever a view saw it.
    """
    assert run.targets is not None
    rows, carried = run.targets.rows, run.session.mount == "eye_to_hand"
    s, places = rows.sightings, np.tile(np.eye(4), (len(rows.sightings.targets), 1, 1))
    places[:, :3, 3] = run.targets.landmarks.positions
    shape = "ball" if s.used.sum() < _MANY else "pebble"
    if run.targets.landmarks.orientation is not None:
        shape, places[:, :3, :3] = "probe", run.targets.landmarks.orientation
    if carried:
        v, slot = np.nonzero(s.used)
        v, slot = (x[:: -(-len(v) // _MOST)] for x in (v, slot))
        k = s.target[v, slot]
        found = Marks([shape] * len(v), run.measurement.T_base_flange[v] @ places[k], v, k)
        return _with_fixed(found, {"scanner": run.T_mount, "base": np.eye(4)})
    k = np.flatnonzero(np.isfinite(places[:, :3, 3]).all(axis=1) & (s.view_counts > 0))
    v = np.flatnonzero(s.used.any(axis=1))
    v = v[:: -(-len(v) // _MOST)]
    found = Marks(
        [shape] * len(k) + ["scanner"] * len(v),
        np.concatenate([places[k], run.poses[v]]),
        np.append(np.full(len(k), ANY), v),
        np.append(k, np.full(len(v), ANY)),
    )
    return _with_fixed(found, {"base": np.eye(4)})


def _with_fixed(found: Marks, fixed: dict[str, Array]) -> Marks:
    """With what stands still and has no value, where it is not so far away that the rest would be small."""
    places = found.valued
    middle, size = (places.max(axis=0) + places.min(axis=0)) / 2, float(np.ptp(places, axis=0).max())
    near = {name: T for name, T in fixed.items() if np.linalg.norm(T[:3, 3] - middle) < 1.5 * size}
    none = np.full(len(near), NOTHING)
    return Marks(
        [*found.shape, *near],
        np.concatenate([found.T, *(T[None] for T in near.values())]),
        np.append(found.view, none),
        np.append(found.target, none),
    )


def mark_values(marks: Indices, view: Indices, target: Indices, distance: Array) -> Array:
    """(M,) rms of the distances (N,) that each mark stands for; NaN where there are none.

    Args:
        marks: (M, 2) view and target of the marks, or ANY.
        view, target: (N,) of the distances.
    """
    out = np.full(len(marks), np.nan)
    views, targets = (1 + max(x.max(initial=0), marks[:, i].max(initial=0)) for i, x in enumerate((view, target)))
    kinds = (
        ((marks[:, 0] >= 0) & (marks[:, 1] >= 0), view * targets + target, marks[:, 0] * targets + marks[:, 1]),
        ((marks[:, 0] >= 0) & (marks[:, 1] == ANY), view, marks[:, 0]),
        ((marks[:, 0] == ANY) & (marks[:, 1] >= 0), target, marks[:, 1]),
    )
    for own, group, wanted in kinds:
        count = np.bincount(group, minlength=views * targets)
        total = np.bincount(group, distance**2, minlength=views * targets)
        with np.errstate(invalid="ignore"):
            out[own] = np.sqrt(total / count)[wanted[own]]
    return out


#
# Runs on clouds have none of them, and do not wait for the library of meshes.


def ball() -> "trimesh.Trimesh":
    """Radius 1."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=1)


def pebble() -> "trimesh.Trimesh":
    """A ball for those of which there are thousands: its normals make twenty triangles look round."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=0)


def scanner() -> "trimesh.Trimesh":
    """A pyramid of height 1 that opens along z, from the eye at the origin to what is seen."""
    import trimesh

    corners = [[0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1]]
    return _faceted(trimesh.Trimesh(corners).convex_hull)


def pedestal() -> "trimesh.Trimesh":
    """Return a robot's base: a disc of radius 1 below the origin, and a stub of height 1 upon it."""
    import trimesh

    disc = trimesh.creation.cylinder(radius=1.0, height=0.3, sections=24)
    disc.apply_translation([0, 0, -0.15])
    stub = trimesh.creation.cylinder(radius=0.5, height=1.0, sections=24)
    stub.apply_translation([0, 0, 0.5])
    return _faceted(trimesh.util.concatenate([disc, stub]))


def probe() -> "trimesh.Trimesh":
    """Three rods of length 1 along the axes, x the thickest."""
    import trimesh

    rods = []
    for axis, thick in enumerate((0.3, 0.22, 0.14)):
        low, high = np.full(3, -thick / 2), np.full(3, thick / 2)
        high[axis] = 1.0
        rods.append(trimesh.creation.box(bounds=[low, high]))
    return _faceted(trimesh.util.concatenate(rods))


def _faceted(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Every triangle with corners of its own, so that its edges are seen."""
    mesh.unmerge_vertices()
    return mesh


# Sizes in radii of a ball; what stands still is for orientation.
_BODIES = {
    "ball": (ball, 1.0),
    "pebble": (pebble, 1.0),
    "probe": (probe, 2.5),
    "scanner": (scanner, 3.0),
    "base": (pedestal, 3.0),
}


def bodies(marks: Marks) -> PartSurface:
    """All bodies in the base frame; the value of mark m colours the m-th."""
    size = _radius(marks)
    vertices, normals, triangles, owner, count = [], [], [], [], 0
    shapes = {name: form() for name, (form, _) in _BODIES.items()}
    for m, (name, T) in enumerate(zip(marks.shape, marks.T, strict=True)):
        body = shapes[name]
        vertices.append(frames.transform(T, body.vertices * size * _BODIES[name][1]))
        normals.append(frames.rotate(T, body.vertex_normals))
        triangles.append(body.faces + count)
        owner.append(np.full(len(body.vertices), m))
        count += len(body.vertices)
    mark = np.concatenate(owner)
    return PartSurface(
        np.vstack(vertices),
        np.vstack(normals),
        np.vstack(triangles).astype(np.int64),
        patch=np.stack([mark] * 3, axis=1),
        weight=np.tile([1.0, 0.0, 0.0], (len(mark), 1)),
    )


def camera_of(marks: Marks) -> Camera:
    """Upright, from the level direction in which the places spread least: most of them are seen."""
    places = marks.valued
    across = np.linalg.eigh(np.cov(places[:, :2].T))[1][:, 0]
    return camera_for(places, np.tile([*across, 0.0], (len(places), 1)), upright=True)


def _radius(marks: Marks) -> float:
    """Return the radius of a ball, length_unit: large enough to be seen, smaller than the gaps between balls."""
    places = marks.valued
    size = float(np.ptp(places, axis=0).max()) or 1.0
    return float(size * np.clip(0.05 * len(places) ** -0.25, 0.004, 0.03))


_SEEN = "the views see the targets {} off their place, rms"
_PICTURE = "The targets in 3D, coloured by how far off their place they are seen."
_ENDS = ["on their place", "off their place"]


def target_scene(run: RunData) -> dict[str, Any] | None:
    """Return the data of the viewer; None where no targets were seen."""
    steps = target_history(run)
    if run.targets is None or not steps:
        return None
    um, marks = MICROMETRES[run.session.length_unit], marks_of(run)
    values = [step_values(run, marks, step) * um for step in steps]
    limit = robust_limit(values[1])
    surface, camera = bodies(marks), camera_of(marks)
    packed = packed_surface(surface, camera, marks.T[:, :3, 3], extent_of(surface.vertices, camera))
    return packed | _told(run, steps, values, limit) | {"marks": _names(run, marks)}


def step_values(run: RunData, marks: Marks, step: TargetStep) -> Array:
    """(M,) what the marks count at a step, length_unit."""
    assert run.targets is not None
    s = run.targets.rows.sightings
    v, slot = np.nonzero(s.used)
    return mark_values(marks.counted, v, s.target[v, slot], step.distances[v, slot])


def _told(run: RunData, steps: tuple[TargetStep, ...], values: list[Array], limit: float) -> dict[str, Any]:
    """Return values and titles of every step for the viewer; µm."""
    assert run.targets is not None
    um = MICROMETRES[run.session.length_unit]
    floor = run.targets.noise_floor * um
    return {
        "steps": [
            {"name": step.name, "mean": step.rms * um, "noise": floor, "values": packed_values(own)}
            for step, own in zip(steps, values, strict=True)
        ],
        "views": [],
        "names": run.session.names,
        "full": limit,
        "colours": colour_stops(),
        "words": {"picture": _PICTURE, "all": _SEEN, "ends": _ENDS},
        "begin": 1,
        "end": len(steps) - 2,
    }


def _names(run: RunData, marks: Marks) -> list[list[str | None]]:
    """View and target of every mark, null where it stands for all of them; both null where it counts nothing."""
    assert run.targets is not None
    views, targets = run.session.names, run.targets.rows.sightings.targets
    return [[None if v < 0 else views[v], None if k < 0 else targets[k]] for v, k in marks.counted.tolist()]
