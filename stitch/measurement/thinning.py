"""Large scans made light: fewer points, each with the surface of all of them; the whole cloud stays where it is.

Evidence about poses counts in views, and a view is asked a few thousand times (`overlaps.FINE_SAMPLES`). What remains
must be dense enough that the nearest point lies on the same piece of surface; normals, edges and noise come from all
points. Only what is fused is every point, and these are read once more when it is their turn.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stitch.errors import InputError
from stitch.frames import Indices
from stitch.measurement.bounding_box import box_of
from stitch.measurement.capture import Capture, capture
from stitch.measurement.cloud import Cloud, WholeCloud
from stitch.measurement.scan import evenly, prepare_view, sparse
from stitch.measurement.session import Scanner, Session, View
from stitch.system.threads import parallel

# Some ten points for every query: √10 spacings of the queries lie between a point and its partner at most. Hand-eye and
# fused surface are then as near to the truth as with all points (docs/large-sessions.md).
ENOUGH = 39_000
# Four points for every query still lie within two of their spacings.
_LEAST = 12_000
# Measured: bytes that a point in memory takes until the run is written, as cloud and scan with its tree, and with its
# share of the correspondences; and what libraries and the slabs take in which everything is fused.
_BYTES, _ALWAYS = 220, 1.2e9


def points_within(memory: float, views: int) -> int:
    """How many points of each view may stay in memory.

    Args:
        memory: bytes for the whole run.

    Raises:
        InputError: so many views need more.
    """
    room = int((memory - _ALWAYS) / (views * _BYTES))
    if room < _LEAST:
        least = np.ceil((_ALWAYS + views * _BYTES * _LEAST) / 1e8) / 10
        raise InputError(
            f"memory: {memory / 1e9:.3g} GB are too little for a run of {views} views; to fix: give {least:.1f} GB"
        )
    return min(room, ENOUGH)


def thinned(session: Session, at_most: int = ENOUGH) -> tuple[Session, Capture]:
    """A session with at most `at_most` points a view, evenly over the scan order, and its capture."""

    def of_view(view: View) -> View:
        if view.cloud is None:
            return view
        return replace(view, cloud=thinned_cloud(view.name, view.cloud, at_most, session.scanner))

    session = replace(session, views=tuple(parallel(of_view, session.views)))
    return session, capture(session)


def thinned_cloud(
    name: str, cloud: Cloud, at_most: int, scanner: Scanner, again: Callable[[], Cloud] | None = None
) -> Cloud:
    """A cloud with at most `at_most` of its points, and where the whole is.

    Args:
        name: of the view.
        again: reads the whole cloud again; None: it stays in memory.
    """
    picked = evenly(len(cloud.points), at_most)
    if len(picked) == len(cloud.points):
        return cloud
    if cloud.whole is not None:
        return _taken(cloud, picked, replace(cloud.whole, scan=sparse(cloud.whole.scan, at_most)))
    scan = prepare_view(name, cloud.points, picked, scanner.eye(cloud.points))
    whole = WholeCloud(again or (lambda: cloud), len(cloud.points), box_of(cloud.points), scan)
    return _taken(cloud, picked, whole)


def _taken(cloud: Cloud, index: Indices, whole: WholeCloud) -> Cloud:
    """Some of the points; those of the scan are the same, so that memory holds them once."""
    normals = None if cloud.normals is None else cloud.normals[index]
    scalars = {name: values[index] for name, values in cloud.scalars.items()}
    return Cloud(whole.scan.points, normals, scalars, whole)
