"""Points with names: as a sensor shows them in one view, and as a drawing states them."""

from dataclasses import dataclass

from stitch.frames import Array


@dataclass(frozen=True)
class Sighting:
    """What one view shows of named targets, sensor frame; a 6D probe is a target with an orientation."""

    targets: tuple[str, ...]  # k
    points: Array  # (k, 3) length_unit
    sigma: Array  # (k,) of a coordinate; NaN where nobody states it
    rotation: Array | None = None  # (3, 3) R_sensor_probe of the one target
    sigma_rotation: float = float("nan")  # rad


@dataclass(frozen=True)
class NominalTargets:
    """Where targets.csv puts the targets, part frame."""

    targets: tuple[str, ...]  # T
    points: Array  # (T, 3) length_unit
    sigma: Array  # (T,) of a coordinate; NaN where nobody states it
