"""What a person states about a folder, with flags; None where nothing is stated."""

from dataclasses import dataclass, field
from pathlib import Path

from stitch.errors import InputError
from stitch.intake.plausible_units import CLOUD_UNITS, POSE_UNITS
from stitch.intake.readings import conventions
from stitch.intake.targets_in_scans import LookedFor

_MOUNTS = ("eye_in_hand", "eye_to_hand")


@dataclass(frozen=True)
class Stated:
    """Flags of `stitch init`, checked."""

    poses: Path | None = None
    columns: tuple[str, ...] = ()
    rotation: str | None = None
    angle_unit: str | None = None
    length_unit: str | None = None  # of the poses
    cloud_unit: str | None = None
    mount: str | None = None
    inverse: bool | None = None  # the table holds T_flange_base
    targets: LookedFor = field(default_factory=LookedFor)  # boards and balls in the scans

    def __post_init__(self) -> None:
        """Refuse words that mean nothing.

        Raises:
            InputError: names the flag and what it knows.
        """
        for flag, value, known in (
            ("--rotation", self.rotation, conventions()),
            ("--angles", self.angle_unit, ("deg", "rad")),
            ("--unit, --file-unit", self.length_unit, tuple(POSE_UNITS)),
            ("--cloud-unit", self.cloud_unit, tuple(CLOUD_UNITS)),
            ("--mount", self.mount, _MOUNTS),
        ):
            if value is not None and value not in known:
                raise InputError(f"{flag} {value}: use {', '.join(known)}")

    @property
    def carries(self) -> bool | None:
        """Whether the poses as written carry the mount's frame, where mount and direction are both stated."""
        if self.mount is None or self.inverse is None:
            return None
        return (self.mount == "eye_in_hand") != self.inverse
