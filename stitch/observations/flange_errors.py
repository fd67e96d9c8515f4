"""How a flange errs whatever the joints do: how much it usually turns and moves, and how long that lasts."""

from collections.abc import Sequence

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.measurement.measurement import Measurement
from stitch.statistics.kernels import ornstein_uhlenbeck

# Usual sizes, rad and mm.
_ROTATION, _TRANSLATION = 2e-5, 0.02
_PER_MM = {"mm": 1.0, "m": 1e-3}
# What wanders, with correlation times in steps from view to view: what the next views forget, and what lasts as long as
# a usual session. Each has a size of its own: how much neighbours differ says how large it is, its memory what of it
# all views share; with both in one size that was understated.
DRIFT_MEMORY = {"quickly wandering": 2.0, "slowly wandering": 20.0}


def usual_twist(length_unit: str) -> Array:
    """(6,) how much a flange usually turns (rad) and moves."""
    return np.repeat([_ROTATION, _TRANSLATION * _PER_MM[length_unit]], 3)


def flange_twists(measurements: Sequence[Measurement], centres: Sequence[Array]) -> Array:
    """(6V, 6) twists of all views of a rig by a flange that turns and moves by its usual sizes, in its own frame.

    Args:
        centres: per session the point (3,) about which twists count, reference frame.
    """
    unit = usual_twist(measurements[0].length_unit)
    own = [
        frames.adjoint(frames.make(np.eye(3), -centre) @ m.capture.T_reference_flange)
        for m, centre in zip(measurements, centres, strict=True)
    ]
    return np.asarray(np.concatenate(own).reshape(-1, 6) * unit)


def mean_square_per_axis(columns: Array, measurements: Sequence[Measurement], centres: Sequence[Array]) -> Array:
    """(2,) mean squares, rad² and length_unit², along an axis of the flange of what columns (6V, n) of twists of the
    views, of unit variance each, turn and move it by."""
    flange = flange_twists(measurements, centres).reshape(-1, 6, 6)
    unit = usual_twist(measurements[0].length_unit)
    own = unit[:, None] * np.linalg.solve(flange, columns.reshape(len(flange), 6, -1))
    squares = (own**2).sum(axis=2).mean(axis=0)
    return np.asarray(squares.reshape(2, 3).mean(axis=1))


def drift_kernel(measurements: Sequence[Measurement], memory: float) -> Array:
    """(V, V) how alike views err that are near in time; sessions are far from each other.

    Args:
        memory: correlation time in steps from view to view.
    """
    counts = [m.views.count for m in measurements]
    out, at = np.zeros((sum(counts), sum(counts))), 0
    for m, count in zip(measurements, counts, strict=True):
        out[at : at + count, at : at + count] = ornstein_uhlenbeck(time_in_steps(m), memory)
        at += count
    return out


def time_in_steps(measurement: Measurement) -> Array:
    """(V,) times of the views in usual steps from one to the next; their numbers where no time is stated."""
    views, step = measurement.views, usual_time_step(measurement)
    return np.asarray(views.time / step if step > 0 else np.arange(views.count, dtype=float))


def usual_time_step(measurement: Measurement) -> float:
    """From one view to the next, s; 0 where no time is stated."""
    steps = np.diff(measurement.views.time)
    return float(np.median(steps)) if measurement.views.has("time") and (steps > 0).any() else 0.0
