"""What stands in the picture of a run on labelled points: which marks, where, and what their colours count."""

from dataclasses import dataclass

import numpy as np

from stitch.frames import Array, Indices
from stitch.runs.run import Run

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


def marks_of(run: Run) -> Marks:
    """What a stranger wants to see of a cell: who moves stands wherever it stood.

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
