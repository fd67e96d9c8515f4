"""What the timeline `model` of a recording shows: the part, where every step puts the views, and what is magnified."""

from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.comparison.disagreement_field import ModelHistory, ModelStep, full_colour_distance
from stitch.frames import Array
from stitch.runs.run import Run
from stitch.units import MICROMETRES, length_text
from viz.part_surface import PartSurface

# Views whose scans are shown displaced: those farthest off under the first model.
_FEW = 4
# The largest displacement is shown as this share of the part's size.
_SHOWN_SHARE = 0.08


@dataclass(frozen=True)
class ModelScene:
    """The steps ready to be drawn; V views. Lengths in length_unit."""

    history: ModelHistory
    surface: PartSurface
    names: tuple[str, ...]
    um: float
    limit: float  # full colour of the field
    centre: Array  # (3,) of the part
    twists: Array  # (S, V, 6) about the centre: from where register puts a view to where the step puts it
    magnified: Array  # (S,)
    farthest: tuple[int, ...]  # views that are off most under the first model
    cell: Array  # (N, 3) some points of the cell, base frame

    def title(self, step: ModelStep) -> str:
        """Name of a step and how far the views disagree there."""
        return f"{step.name}: views disagree by {length_text(step.field.mean_abs * self.um / 1e3, 'mm')} on average"


def model_scene(run: Run, history: ModelHistory, surface: PartSurface, cell: Array) -> ModelScene:
    """Where every step puts the views, and by how much that has to be magnified to be seen."""
    centre = surface.vertices.mean(axis=0)
    to_centre = frames.make(np.eye(3), -centre)
    at_rest = frames.inverse(to_centre @ history.steps[-1].poses)
    twists = np.array([frames.log(to_centre @ s.poses @ at_rest) for s in history.steps])
    # A motion that all views share moves the part, and nothing against anything.
    twists -= twists.mean(axis=1, keepdims=True)
    size = float(np.ptp(surface.vertices, axis=0).max())
    far = np.linalg.norm(twists[..., 3:], axis=2) + 0.3 * size * np.linalg.norm(twists[..., :3], axis=2)
    first = history.models[0].field
    models = np.array([size * _SHOWN_SHARE / max(x, 1e-12) for x in far.max(axis=1)])
    # One factor for all that is fitted, its own for the coarse step, which is so much farther off.
    factors = np.array([_round(models[0]), *[_round(models[1:-1].min())] * (len(models) - 1)])
    return ModelScene(
        history=history,
        surface=surface,
        names=tuple(run.session.names),
        um=MICROMETRES[run.session.length_unit],
        limit=full_colour_distance(first),
        centre=centre,
        twists=twists,
        magnified=factors,
        farthest=tuple(int(v) for v in np.argsort(-mean_sizes(first.values), kind="stable")[:_FEW]),
        cell=cell,
    )


def shown_steps(history: ModelHistory) -> tuple[ModelStep, ModelStep]:
    """Before and after: the first model and the last, or the only one and register."""
    models = history.models
    return models[0], models[-1] if len(models) > 1 else history.steps[-1]


def mean_sizes(values: Array) -> Array:
    """(V,) mean size of the values (V, K) that are known; 0 where none is."""
    known = np.isfinite(values)
    return np.where(known, np.abs(np.nan_to_num(values)), 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)


def _round(factor: float) -> float:
    """The next smaller of 1, 2, 5, 10, …"""
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(x * power for x in (1, 2, 5) if x * power <= factor * (1 + 1e-9)))
