"""A way to take clouds and table together: how rotations read, unit, direction, which row to which cloud."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stitch import frames
from stitch.frames import Array
from stitch.intake.cloud_pairs import Pairing
from stitch.intake.plausible_units import POSE_UNITS
from stitch.intake.readings import Reading
from stitch.integrity.hypotheses import Hypothesis
from stitch.measurement.session import Mount

# The doctor counts in millimetres.
MM = 1e-3


@dataclass(frozen=True)
class Interpretation:
    """One way. `carries`: the poses as read take the mount's frame to the reference; else their inverse does."""

    reading: Reading
    pairing: Pairing
    length_unit: str
    carries: bool

    @property
    def T(self) -> Array:
        """Poses (V, 4, 4) of the clouds, mm; identity where a cloud has none."""
        scale = POSE_UNITS[self.length_unit] / MM
        out = np.tile(np.eye(4), (len(self.pairing.rows), 1, 1))
        for i, row in enumerate(self.pairing.rows):
            if row is not None:
                T = self.reading.T[row]
                out[i] = frames.make(T[:3, :3], T[:3, 3] * scale)
        return out

    def hypothesis(self, number: int) -> Hypothesis:
        """The same for the judges of integrity, which know it again by its number."""
        mount: Mount = "eye_in_hand" if self.carries else "eye_to_hand"
        complete = len(self.pairing.used) == len(self.pairing.rows)
        return Hypothesis(str(number), self.T, mount, "", used=None if complete else self.pairing.used)


def all_interpretations(
    readings: Iterable[Reading], pairs: Sequence[Pairing], units: Sequence[str], directions: Sequence[bool]
) -> list[Interpretation]:
    """Every combination, the usual first.

    Args:
        units: for readings of which the file does not tell it.
        directions: whether the poses carry the mount's frame.
    """
    ranked = sorted(readings, key=lambda r: r.rank)
    return [
        Interpretation(reading, pairing, unit, carries)
        for pairing in pairs
        for reading in ranked
        for unit in ([reading.layout.length_unit] if reading.layout.length_unit else units)
        for carries in directions
    ]
