"""The scans that a session's views name, read on all cores: what counts of each, in length_unit."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.cloud import Cloud
from stitch.measurement.session import Scanner
from stitch.measurement.thinning import thin_cloud
from stitch.reading.clouds import read_cloud
from stitch.reading.plausible import require_near
from stitch.reading.views_csv import ViewRow
from stitch.system.threads import parallel
from stitch.units import METRES

# Fewer points span no surface.
_FEWEST = 3


def read_scans(
    path: Path,
    rows: Sequence[ViewRow],
    length_unit: str,
    cloud_unit: str,
    scanner: Scanner,
    *,
    within: Array | None,
    at_most: int | None,
) -> Iterator[Cloud | None]:
    """The scans of a session folder in the order of its rows, None where a row names none.

    Args:
        cloud_unit: of the files; the clouds come in length_unit.
        within: (2, 3) lowest and highest corner of the box that counts, scanner frame, length_unit; None: all counts.
        at_most: points of a view that stay in memory; None: all.

    Raises:
        InputError: a file missing, broken, with too few points or in another unit; names the view and its line.
    """
    read = partial(_read_cropped, scale=METRES[cloud_unit] / METRES[length_unit], within=within)
    cloud = partial(_scan_of_row, path, read=read, metres=METRES[length_unit], scanner=scanner, at_most=at_most)
    return parallel(cloud, rows, "reading scans")


def _scan_of_row(
    path: Path, row: ViewRow, read: Callable[[Path], Cloud], metres: float, scanner: Scanner, at_most: int | None
) -> Cloud | None:
    if not row.cloud:
        return None
    file = path / row.cloud
    try:
        return checked_scan(row.name, str(file), partial(read, file), metres=metres, scanner=scanner, at_most=at_most)
    except InputError as error:
        raise InputError(f"view {row.name} (views.csv line {row.line}): {error}") from None


def checked_scan(
    name: str, where: str, read: Callable[[], Cloud], *, metres: float, scanner: Scanner, at_most: int | None
) -> Cloud:
    """Read one scan, check it, and keep so many of its points in memory.

    Args:
        name: of the view.
        where: file, or name of the scan, for messages.
        read: gives the whole scan in length_unit, and once more when it is fused.
        metres: in one length_unit.
        at_most: points that stay in memory; None: all.

    Raises:
        InputError: too few points, or one farther away than any sensor sees.
    """
    cloud = read()
    if len(cloud.points) < _FEWEST:
        raise InputError(
            f"{where}: {len(cloud.points)} of at least {_FEWEST} points; leave this view out of views.csv or scan "
            "it again"
        )
    # Looked at before some are taken: each of them will be fused.
    require_near(where, cloud.points * metres)
    return cloud if at_most is None else thin_cloud(name, cloud, at_most, scanner, read)


def _read_cropped(file: Path, scale: float, within: Array | None) -> Cloud:
    """A scan in length_unit, what counts of it."""
    cloud = read_cloud(file, scale)
    if within is None:
        return cloud
    inside = cloud.within(within)
    if not len(inside.points):
        middle = ", ".join(f"{x:.3g}" for x in np.median(cloud.points, axis=0))
        raise InputError(
            f"{file}: none of its {len(cloud.points)} points is in the box scanner.within of session.toml, their "
            f"middle lies at ({middle}); to fix: make the box larger, or leave this view out of views.csv"
        )
    return inside
