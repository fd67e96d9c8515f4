"""What a person states with flags, of a table of poses and of the folder it lies in; None where nothing is stated."""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from stitch.errors import InputError
from stitch.intake.plausible_units import CLOUD_UNITS, POSE_UNITS
from stitch.intake.readings import rotation_conventions
from stitch.intake.targets_in_scans import TargetSearch

_MOUNTS = ("eye_in_hand", "eye_to_hand")


@dataclass(frozen=True)
class StatedTable:
    """How a table of poses is to be read, checked."""

    columns: tuple[str, ...] = ()
    rotation: str | None = None
    angle_unit: str | None = None
    length_unit: str | None = None  # of the poses
    inverse: bool | None = None  # the table holds T_flange_base

    def __post_init__(self) -> None:
        """Refuse words that mean nothing.

        Raises:
            InputError: names the flag and what it knows.
        """
        _require_known_word("--rotation", self.rotation, rotation_conventions())
        _require_known_word("--angles", self.angle_unit, ("deg", "rad"))
        _require_known_word("--unit, --file-unit", self.length_unit, POSE_UNITS)


@dataclass(frozen=True)
class StatedFolder(StatedTable):
    """And what its folder holds beside it, checked."""

    poses: Path | None = None
    cloud_unit: str | None = None
    mount: str | None = None
    targets: TargetSearch = field(default_factory=TargetSearch)  # boards and balls in the scans

    def __post_init__(self) -> None:
        """As of the table."""
        super().__post_init__()
        _require_known_word("--cloud-unit", self.cloud_unit, CLOUD_UNITS)
        _require_known_word("--mount", self.mount, _MOUNTS)

    @property
    def carries(self) -> bool | None:
        """Whether the poses as written carry the mount's frame, where mount and direction are both stated."""
        if self.mount is None or self.inverse is None:
            return None
        return (self.mount == "eye_in_hand") != self.inverse


def _require_known_word(flag: str, value: str | None, known: Collection[str]) -> None:
    if value is not None and value not in known:
        raise InputError(f"{flag} {value}: to fix: use {', '.join(known)}")
