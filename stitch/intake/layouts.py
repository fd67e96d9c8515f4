"""Which columns of a table hold the position, the rotation or the joint angles: by name, by count, by their values."""

from dataclasses import dataclass, field, replace

import numpy as np

from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.column_names import read_names
from stitch.intake.pairs_by_time import since_1970
from stitch.intake.raw_poses import RawPoses

# A quaternion with three digits has length 1 within this.
_UNIT_LENGTH = 5e-3
_ORTHONORMAL = 1e-2
# Larger numbers are no angles; with room for what rounding adds to a full turn.
_DEGREES = 360.5


@dataclass(frozen=True)
class ColumnLayout:
    """Columns of one meaning; positions (V, 3) in the file's unit, rotations (V, k) as the file writes them."""

    position: Array  # (V, 3); (V, 0) for joint angles alone
    rotation: Array  # (V, 3) angles, (V, 4) quaternion, (V, 9) matrix by rows; (V, 0) for joint angles alone
    joints: Array | None  # (V, n) in the file's unit
    words: str
    convention: str | None = None  # where names or values tell it
    length_unit: str | None = None
    angle_unit: str | None = None
    named: bool = False  # the file names its columns
    rest: dict[str, Array] = field(default_factory=dict)  # other named columns (V,): times, temperatures

    @property
    def angles(self) -> Array:
        """Numbers that are angles: of the rotation, else of the joints."""
        return self.rotation if self.rotation.shape[1] == 3 or self.joints is None else self.joints


def possible_layouts(raw: RawPoses) -> list[ColumnLayout]:
    """Every meaning that the columns can have, the usual first.

    Raises:
        InputError: columns that hold no pose, with the flag that names them.
    """
    if raw.header is not None:
        found = _layout_by_name(raw)
        if found is not None:
            return [found]
    x, rest = _without_time(_without_index(raw.numbers))
    count = x.shape[1]
    tried = {6: _six_column_layouts, 7: _seven_column_layouts, 12: _twelve_column_layouts, 16: _sixteen_column_layouts}
    found_all = tried[count](x) if count in tried else []
    if not found_all:
        called = "" if raw.header is None else f", called {', '.join(raw.header)},"
        raise InputError(
            f"{raw.source}: {raw.numbers.shape[1]} columns of numbers{called} "
            "hold no pose that is known; to fix: name each with --columns, for example --columns x,y,z,rx,ry,rz "
            "(qx,qy,qz,qw for a quaternion, j1,j2 … for joint angles, - for one to leave out)"
        )
    return [replace(layout, rest=rest) for layout in found_all]


def _layout_by_name(raw: RawPoses) -> ColumnLayout | None:
    named = read_names(raw.header or ())
    x = raw.numbers
    if len(named.rotation) in (12, 16):
        matrices = (_sixteen_column_layouts if len(named.rotation) == 16 else _twelve_column_layouts)(
            x[:, named.rotation]
        )
        rest = {name: x[:, i] for name, i in named.rest.items()}
        return replace(matrices[0], rest=rest) if matrices else None
    posed = bool(named.position and named.rotation)
    if not posed and not named.joints:
        return None
    nothing = np.zeros((len(x), 0))
    return ColumnLayout(
        position=x[:, named.position] if posed else nothing,
        rotation=x[:, named.rotation] if posed else nothing,
        joints=x[:, named.joints] if named.joints else None,
        words="columns by their names",
        convention=named.convention,
        length_unit=named.length_unit,
        angle_unit=named.angle_unit,
        named=True,
        rest={name: x[:, i] for name, i in named.rest.items()},
    )


def _without_index(x: Array) -> Array:
    """The table without a first column that counts its rows."""
    counts = len(x) > 2 and x.shape[1] in (7, 8, 13, 17) and bool((np.diff(x[:, 0]) == 1).all())
    return x[:, 1:] if counts and x[0, 0] in (0, 1) else x


def _without_time(x: Array) -> tuple[Array, dict[str, Array]]:
    """The table without a first column of times since 1970, and that column by its name."""
    timed = x.shape[1] in (7, 8, 13, 17) and len(x) > 1 and since_1970(x[:, 0]) is not None
    return (x[:, 1:], {"time": x[:, 0]}) if timed else (x, {})


def _six_column_layouts(x: Array) -> list[ColumnLayout]:
    """A position and three angles, either first: both where both can be angles in degrees, as small positions can."""
    first, last = x[:, :3], x[:, 3:]
    ahead = ColumnLayout(first, last, None, "columns 1 to 3 are the position, 4 to 6 the angles")
    behind = ColumnLayout(last, first, None, "columns 1 to 3 are the angles, 4 to 6 the position")
    return [layout for layout in (ahead, behind) if np.abs(layout.rotation).max() <= _DEGREES]


def _seven_column_layouts(x: Array) -> list[ColumnLayout]:
    ahead = ColumnLayout(x[:, :3], x[:, 3:], None, "columns 1 to 3 are the position, 4 to 7 the quaternion")
    behind = ColumnLayout(x[:, 4:], x[:, :4], None, "columns 1 to 4 are the quaternion, 5 to 7 the position")
    return [layout for layout in (ahead, behind) if _is_quaternion(layout.rotation)]


def _is_quaternion(q: Array) -> bool:
    return bool((np.abs(np.linalg.norm(q, axis=1) - 1) < _UNIT_LENGTH).all())


def _twelve_column_layouts(x: Array) -> list[ColumnLayout]:
    """3×4 matrices by rows, or a rotation by rows and the position behind it or before it."""
    rows = x.reshape(-1, 3, 4)
    forms = (
        ColumnLayout(rows[:, :, 3], rows[:, :, :3].reshape(-1, 9), None, "3×4 matrices by rows", "matrix"),
        ColumnLayout(x[:, 9:], x[:, :9], None, "columns 1 to 9 are the rotation, 10 to 12 the position"),
        ColumnLayout(x[:, :3], x[:, 3:], None, "columns 1 to 3 are the position, 4 to 12 the rotation"),
    )
    return [layout for layout in forms if _is_rotation(layout.rotation)]


def _sixteen_column_layouts(x: Array) -> list[ColumnLayout]:
    """4×4 matrices by rows, or by columns: the row 0 0 0 1 tells."""
    T = x.reshape(-1, 4, 4)
    for words, M in (("4×4 matrices by rows", T), ("4×4 matrices by columns", T.transpose(0, 2, 1))):
        if np.allclose(M[:, 3], [0, 0, 0, 1], atol=1e-6) and _is_rotation(M[:, :3, :3].reshape(-1, 9)):
            return [ColumnLayout(M[:, :3, 3], M[:, :3, :3].reshape(-1, 9), None, words, "matrix")]
    return []


def _is_rotation(rows: Array) -> bool:
    R = rows.reshape(-1, 3, 3)
    return bool(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < _ORTHONORMAL and (np.linalg.det(R) > 0).all())
