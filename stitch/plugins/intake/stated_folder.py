"""What a person states with flags, of a table of poses and of the folder it lies in; None where nothing is stated."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.intake.layouts import (
    CLOUD_UNITS,
)
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import (
    StatedTable,
    require_known_word,
)
from stitch.plugins.intake.scan_targets import TargetSearch

_MOUNTS = ("eye_in_hand", "eye_to_hand")


@dataclass(frozen=True)
class StatedFolder(StatedTable):
    """And what its folder holds beside it, checked."""

    poses: Path | None = None
    cloud_unit: str | None = None
    mount: str | None = None
    orientation: tuple[float, ...] = ()  # of all poses, where the table has x, y, z alone
    within: tuple[float, ...] = ()  # corners of the box that counts, low first, scanner frame, unit of the clouds
    targets: TargetSearch = field(default_factory=TargetSearch)  # boards and balls in the scans

    def __post_init__(self) -> None:
        """As of the table."""
        super().__post_init__()
        require_known_word("--cloud-unit", self.cloud_unit, CLOUD_UNITS)
        require_known_word("--mount", self.mount, _MOUNTS)
        if self.within and (len(self.within) != 6 or not (self.box[0] < self.box[1]).all()):
            raise InputError("--within: to fix: state the lowest and the highest corner, x,y,z,x,y,z, of a box")

    @property
    def box(self) -> Array:
        """The corners (2, 3) of the box that counts; (0, 3) where everything does."""
        return np.array(self.within, float).reshape(-1, 3)

    def accepts(self, raw: RawPoses) -> bool:
        """Whether the columns or the orientation stated make poses of rows that no layout accepts."""
        return len(self.columns) == raw.numbers.shape[1] or (len(self.orientation) > 0 and raw.numbers.shape[1] >= 3)

    @property
    def carries(self) -> bool | None:
        """Whether the poses as written carry the mount's frame, where mount and direction are both stated."""
        if self.mount is None or self.inverse is None:
            return None
        return (self.mount == "eye_in_hand") != self.inverse
