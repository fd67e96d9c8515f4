"""The surfaces of a session's scans as a run folder keeps them, so that a diagnosis need not find them again.

Normals take a fifth of a diagnosis. A scan is taken from the file only where points, eye and the code that made it are
the same to the last bit; else it is prepared anew, and nothing is said.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pykdtree.kdtree import KDTree

from stitch.numerics.frames import Array
from stitch.session import scan as scan_module
from stitch.session.scan import Scan

# Beyond so many points the file would take more than 200 MB.
_MOST_POINTS = 5_000_000
_BY_POINT = ("normals", "usable", "area", "confidence")
_BY_SCAN = ("spacing", "scanned_spacing", "noise")


@dataclass(frozen=True)
class KeptScans:
    """What was found on scans, by the digest of what it was found from."""

    found: dict[bytes, dict[str, Any]]

    def scan(self, name: str, points: Array, eye: Array) -> Scan | None:
        """Return the scan that `prepare_scan` makes of points (N, 3) seen from an eye (3,); None where it is not kept.

        Args:
            name: of the view.
        """
        kept = self.found.get(_digest(points, eye))
        if kept is None:
            return None
        points = np.ascontiguousarray(points, float)
        return Scan(name=name, points=points, eye=eye, tree=KDTree(points, leafsize=16), **kept)


def write_scans(scans: Sequence[Scan], points: Sequence[Array], path: Path) -> None:
    """Write what was found on scans; nothing where they have more than `_MOST_POINTS` points, or are none.

    Args:
        points: per scan (N, 3) as scanned: those of the scan itself may have lost stock.
    """
    if not scans or sum(map(len, points)) > _MOST_POINTS:
        return
    table: dict[str, Any] = {key: np.concatenate([getattr(scan, key) for scan in scans]) for key in _BY_POINT}
    table |= {key: [getattr(scan, key) for scan in scans] for key in _BY_SCAN}
    digests = [np.frombuffer(_digest(each, scan.eye), np.uint8) for each, scan in zip(points, scans, strict=True)]
    np.savez(path, digests=digests, counts=[len(each) for each in points], **table)


def read_scans(path: Path) -> KeptScans:
    """Return the kept scans of a file; of none, or a damaged one, nothing."""
    try:
        with np.load(path) as table:
            ends = np.cumsum(table["counts"])[:-1]
            columns = {key: np.split(table[key], ends) for key in _BY_POINT} | {
                key: table[key].tolist() for key in _BY_SCAN
            }
            rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
            return KeptScans({digest.tobytes(): row for digest, row in zip(table["digests"], rows, strict=True)})
    except Exception:  # whatever is wrong with it, the scans can be prepared anew
        return KeptScans({})


def _digest(points: Array, eye: Array) -> bytes:
    """Return what identifies a scan: points (N, 3), eye (3,), and the code that finds its surface."""
    digest = hashlib.blake2b(Path(scan_module.__file__).read_bytes())
    digest.update(np.ascontiguousarray(eye, float).data)
    digest.update(np.ascontiguousarray(points, float).data)
    return digest.digest()
