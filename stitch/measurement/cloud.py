"""One scan as arrays."""

from dataclasses import dataclass, field

from stitch.frames import Array


@dataclass(frozen=True)
class Cloud:
    """One scan in the scanner frame, in the session's length_unit."""

    points: Array  # (N, 3)
    normals: Array | None = None  # (N, 3) if the file has them
    scalars: dict[str, Array] = field(default_factory=dict)  # name -> (N,), e.g. intensity, time
