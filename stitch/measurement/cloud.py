"""One scan as arrays."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.bounding_box import bounding_box
from stitch.measurement.scan import Scan


@dataclass(frozen=True)
class Cloud:
    """One scan in the scanner frame, in the session's length_unit."""

    points: Array  # (N, 3)
    normals: Array | None = None  # (N, 3) if the file has them
    scalars: dict[str, Array] = field(default_factory=dict)  # name -> (N,), e.g. intensity, time
    whole: "WholeCloud | None" = None  # None: these are all points that were scanned

    @property
    def count(self) -> int:
        """How many points were scanned."""
        return len(self.points) if self.whole is None else self.whole.count

    def within(self, box: Array) -> "Cloud":
        """Its points inside a box (2, 3)."""
        inside = ((self.points >= box[0]) & (self.points <= box[1])).all(axis=1)
        scalars = {name: column[inside] for name, column in self.scalars.items()}
        return Cloud(self.points[inside], None if self.normals is None else self.normals[inside], scalars)


@dataclass(frozen=True)
class WholeCloud:
    """All points of a scan of which a cloud holds some; they stay where they are, mostly in a file."""

    reload: Callable[[], Cloud]  # reads them
    count: int
    box: Array  # (2, 3) its lowest and highest corner, scanner frame
    scan: Scan  # the points that the cloud holds, with the surface of all of them

    def read(self) -> Cloud:
        """Every point, in the order in which they were scanned.

        Raises:
            InputError: the file is not what it was.
        """
        cloud = self.reload()
        if len(cloud.points) != self.count or not np.array_equal(bounding_box(cloud.points), self.box):
            raise InputError(f"the scan of view {self.scan.name} changed on disk during the run; to fix: run again")
        return cloud
