"""What a person states with flags, of a table of poses and of the folder it lies in; None where nothing is stated."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from stitch.cli.options import split_names
from stitch.numerics.frames import Array
from stitch.plugins.intake.detect import parse_target_options
from stitch.plugins.intake.layouts import CLOUD_UNITS
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.readings import StatedTable, require_known_word
from stitch.plugins.intake.refusals import Fix, Refusal
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
    rows: tuple[int | None, ...] = ()  # of the table, from 0, of each cloud in the order of their names

    @classmethod
    def of(cls, options: Mapping[str, str]) -> "StatedFolder":
        """Return what options of `stitch init` state, by name, as they are typed.

        Raises:
            InputError: a word or a number that an option does not take.
        """
        inverse = options.get("inverse")
        return cls(
            split_names(options.get("columns")),
            options.get("rotation"),
            options.get("angles"),
            length_unit=options.get("unit"),
            inverse=None if inverse is None else inverse == "yes",
            poses=Path(options["poses"]) if options.get("poses") else None,
            cloud_unit=options.get("cloud_unit"),
            mount=options.get("mount"),
            orientation=_numbers("orientation", options),
            within=_numbers("within", options),
            targets=parse_target_options(options.get("board", "").split(), options.get("ball", "").split()),
            rows=_rows(options.get("rows", "")),
        )

    def __post_init__(self) -> None:
        """As of the table."""
        super().__post_init__()
        require_known_word("--cloud-unit", self.cloud_unit, CLOUD_UNITS)
        require_known_word("--mount", self.mount, _MOUNTS)
        if self.within and (len(self.within) != 6 or not (self.box[0] < self.box[1]).all()):
            words = "state the lowest and the highest corner, x,y,z,x,y,z, of a box"
            raise Refusal("--within:", Fix(words, {"within": "WITHIN"}))

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


def _numbers(name: str, options: Mapping[str, str]) -> tuple[float, ...]:
    """Return the numbers of an option."""
    text = options.get(name)
    try:
        return tuple(float(cell) for cell in split_names(text))
    except ValueError:
        raise Refusal(
            f"--{name} {text}: is no list of numbers", Fix("write numbers with commas between", {name: name.upper()})
        ) from None


def _rows(text: str) -> tuple[int | None, ...]:
    """Return rows from 0 of 1-3,-,7."""
    out: list[int | None] = []
    for part in split_names(text):
        found = re.fullmatch(r"(\d+)(?:-(\d+))?|-", part)
        if found is None or found[1] == "0":
            fix = Fix("write the numbers of rows from 1, as 1-7,-,9", {"rows": "ROWS"})
            raise Refusal(f"--rows {text}: {part} is no row", fix)
        out += range(int(found[1]) - 1, int(found[2] or found[1])) if found[1] else [None]
    return tuple(out)
