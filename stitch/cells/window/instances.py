"""Several parts of the same kind in one scan."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from stitch.cells.window.cad import CadSurface
from stitch.cells.window.joined_scans import JoinedScans
from stitch.errors import NoResultError

# Parts stand apart by more than this many point spacings, or this share of the part where the spacing is finer.
_GAP_SPACINGS, _GAP_SHARE = 6.0, 1 / 40
# A heap of points smaller than this share of the part's surface is no part.
_MIN_INSTANCE_SHARE = 0.1


def split_instances(scan: JoinedScans, cad: CadSurface, count: int) -> list[JoinedScans]:
    """The scan's heaps of points, linked where nearer than the gap between parts, largest first.

    Raises:
        NoResultError: fewer heaps of a part's size than wanted.
    """
    if count == 1:
        return [scan]
    gap = max(_GAP_SPACINGS * scan.spacing, _GAP_SHARE * cad.size)
    cells, where = np.unique(np.floor(scan.points / (gap / 3)).astype(int), axis=0, return_inverse=True)
    # Cells three to a gap: those whose centres lie within it belong together.
    pairs = cKDTree(cells).query_pairs(3.0, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells), len(cells)))
    labels = connected_components(graph, directed=False)[1][where.ravel()]
    heaps = [labels == label for label in range(labels.max() + 1)]
    # Of a part at most one side is seen, so half its surface is the most a heap can hold.
    big = [heap for heap in heaps if scan.area[heap].sum() > _MIN_INSTANCE_SHARE * cad.mesh.area / 2]
    if len(big) < count:
        raise NoResultError(
            f"{len(big)} separate parts in the scan, {count} wanted; scan the others, or correct `instances`"
        )
    return [scan.take(heap) for heap in sorted(big, key=lambda heap: -scan.area[heap].sum())[:count]]
