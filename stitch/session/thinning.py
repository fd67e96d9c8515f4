"""Large scans made light: fewer points, each with the surface of all of them; the whole cloud stays where it is.

Evidence about poses counts in views, and a view is asked a few thousand times (`overlaps.FINE_SAMPLES`). What remains
must be dense enough that the nearest point lies on the same piece of surface; normals, edges and noise come from all
points. Only what is fused is every point, and these are read once more when it is their turn.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stitch.errors import InputError
from stitch.session.capture import Capture, prepare_capture
from stitch.session.scan import bounding_box, even_indices, prepare_scan, subsample
from stitch.session.session import Cloud, Scanner, SessionData, View, WholeCloud
from stitch.system.threads import parallel
from stitch.system.values import take_rows

# Some ten points for every query: √10 spacings of the queries lie between a point and its partner at most. Hand-eye and
# fused surface are then as near to the truth as with all points (docs/large-sessions.md).
MAX_POINTS = 39_000
# Four points for every query still lie within two of their spacings.
_MIN_POINTS = 12_000
# Measured: bytes that a point in memory takes until the run is written, as cloud and scan with its tree, and with its
# share of the correspondences.
_BYTES_PER_POINT = 220
# What libraries and the slabs take in which everything is fused.
_FIXED_BYTES = 1.2e9


def points_within(memory: float, views: int) -> int:
    """Return how many points of each view may be held in memory, at most `MAX_POINTS`.

    Args:
        memory: bytes for the whole run.
        views: number of views.

    Raises:
        InputError: the memory is too little for `_MIN_POINTS` of each view.
    """
    room = int((memory - _FIXED_BYTES) / (views * _BYTES_PER_POINT))
    if room < _MIN_POINTS:
        least = np.ceil((_FIXED_BYTES + views * _BYTES_PER_POINT * _MIN_POINTS) / 1e8) / 10
        raise InputError(
            f"memory: {memory / 1e9:.3g} GB are too little for a run of {views} views; to fix: give {least:.1f} GB"
        )
    return min(room, MAX_POINTS)


def thin_session(session: SessionData, at_most: int = MAX_POINTS) -> tuple[SessionData, Capture]:
    """Return a session with at most `at_most` points a view, evenly over the scan order, and its capture."""

    def thinned(view: View) -> View:
        if view.cloud is None:
            return view
        return replace(view, cloud=thin_cloud(view.name, view.cloud, at_most, session.scanner))

    session = replace(session, views=tuple(parallel(thinned, session.views)))
    return session, prepare_capture(session)


def thin_cloud(
    name: str, cloud: Cloud, at_most: int, scanner: Scanner, reload: Callable[[], Cloud] | None = None
) -> Cloud:
    """Return a cloud with at most `at_most` of its points, spread evenly over the scan order.

    Its `whole` says how all points are read again, and holds the scan whose normals come from all of them. A small
    cloud is returned as it is.

    Args:
        name: of the view.
        reload: reads the cloud with all points again; None: that one stays in memory.
    """
    picked = even_indices(len(cloud.points), at_most)
    if len(picked) == len(cloud.points):
        return cloud
    if cloud.whole is not None:
        whole = replace(cloud.whole, scan=subsample(cloud.whole.scan, at_most))
    else:
        scan = prepare_scan(name, cloud.points, picked, scanner.eye(cloud.points))
        whole = WholeCloud(reload or (lambda: cloud), len(cloud.points), bounding_box(cloud.points), scan)
    # The points are those of the scan, so that memory holds them once.
    return replace(cloud.at(picked), points=whole.scan.points, whole=whole)


def distinct_points(cloud: Cloud) -> Cloud:
    """Return the cloud without repeated points, in its order; the same object where no point is repeated.

    The nearest neighbours of a repeated point would be its copies: normals, noise and spacing would come from those.
    """
    x, y, z = cloud.points.T
    # Different points hardly ever agree in this sum, and one number sorts ten times as fast as three.
    if len(np.unique(x + np.sqrt(2) * y + np.sqrt(3) * z)) == len(cloud.points):
        return cloud
    _, first = np.unique(cloud.points, axis=0, return_index=True)
    if len(first) == len(cloud.points):
        return cloud
    return take_rows(cloud, np.sort(first), "points", "normals", "scalars")
