"""Large scans made light for questions about poses: fewer points, each with the surface of all of them.

Evidence counts in views, and a view is asked a few thousand times (`overlaps.FINE_SAMPLES`). What remains must be
dense enough that the nearest point lies on the same piece of surface; normals, edges and noise come from all points.
"""

from dataclasses import replace

import numpy as np

from stitch.frames import Indices
from stitch.measurement.capture import Capture, place
from stitch.measurement.cloud import Cloud
from stitch.measurement.scan import Scan, prepare_view
from stitch.measurement.session import Session
from stitch.measurement.sightings import sightings_of
from stitch.observations.surfaces.overlaps import FINE_SAMPLES
from stitch.system.threads import parallel

# Some ten points for every query: √10 spacings of the queries lie between a point and its partner at most.
ENOUGH = 13 * FINE_SAMPLES


def thinned(session: Session, at_most: int = ENOUGH) -> tuple[Session, Capture]:
    """A cloud session with at most `at_most` points a view, evenly over the scan order, and its capture."""
    picked = [np.zeros(0, np.int64) if v.cloud is None else _pick(len(v.cloud.points), at_most) for v in session.views]
    views = [
        view if view.cloud is None else replace(view, cloud=_taken(view.cloud, index))
        for view, index in zip(session.views, picked, strict=True)
    ]

    def scan_of(v: int) -> Scan:
        cloud = session.views[v].cloud
        assert cloud is not None
        return prepare_view(session.views[v].name, cloud.points, picked[v])

    scans = list(parallel(scan_of, [v for v, view in enumerate(session.views) if view.cloud is not None]))
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    placed = place(session.name, scans, T_base_flange, session.mount, sightings_of(session))
    return replace(session, views=tuple(views)), placed


def _pick(count: int, at_most: int) -> Indices:
    return np.linspace(0, count - 1, min(count, at_most)).astype(np.int64)


def _taken(cloud: Cloud, index: Indices) -> Cloud:
    normals = None if cloud.normals is None else cloud.normals[index]
    return Cloud(cloud.points[index], normals, {name: values[index] for name, values in cloud.scalars.items()})
