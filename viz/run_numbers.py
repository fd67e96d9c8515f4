"""Numbers of a run that pages, review and recording draw: shifts of views, offsets of targets."""

import numpy as np

from stitch.numerics.frames import Array
from stitch.run_data import RunData
from stitch.session.session import View


def view_shifts(run: RunData) -> Array:
    """(V, 3) how far register moved the middle of each view, reference frame, length_unit."""
    out = []
    for view, T_before, T_after in zip(run.session.views, run.poses_model, run.poses, strict=True):
        points = shown_points(view)
        middle = points.mean(axis=0) if len(points) else np.zeros(3)
        out.append((T_after - T_before)[:3, :3] @ middle + (T_after - T_before)[:3, 3])
    return np.array(out)


def shown_points(view: View) -> Array:
    """(N, 3) of the view's cloud, or its labelled points, scanner frame."""
    if view.cloud is not None:
        return view.cloud.points
    return np.zeros((0, 3)) if view.sighting is None else view.sighting.points


def residual_vectors(run: RunData) -> tuple[Array, Array]:
    """Number of the target (N,) and its offset (N, 3) under the model, reference frame, for all in use."""
    assert run.targets is not None
    rows, s = run.targets.rows, run.targets.rows.sightings
    residual = rows.residual[: len(s.used), : rows.positions].reshape(*s.used.shape, 3)
    return s.target[s.used], residual[s.used]
