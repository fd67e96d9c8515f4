"""Who carries the scanner, and whether poses are of the flange in the base or the other way round.

Scans cannot tell "the scanner at the flange" from "the part at the flange, poses inverted": both move alike. What
tells them apart is where things lie: what sits at the flange is near its origin, what stands in the cell is not near
that of the base.
"""

from dataclasses import dataclass

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.plugins.intake.convention_choice import ConventionChoice
from stitch.plugins.intake.guesses import Because, Guess
from stitch.plugins.intake.readings import JOINT_ANGLES

# Scanner or part sits at the flange if it lies this much nearer to its frame's origin than the other.
_NEARER = 1.5
_WORDS = {"eye_in_hand": "the scanner sits at the flange", "eye_to_hand": "the part sits at the flange"}


@dataclass(frozen=True)
class Mounting:
    """How the poses are to be taken."""

    mount: str
    inverted: bool  # the table holds T_flange_base
    guess: Guess

    def flange(self, T: Array) -> Array:
        """T_base_flange from poses as the table has them, (..., 4, 4)."""
        return frames.inverse(T) if self.inverted else T


def choose_mounting(decided: ConventionChoice, mount: str | None, inverse: bool | None) -> Mounting:
    """Settle who carries the scanner: as a person states it, else by where things lie.

    Args:
        mount, inverse: as stated; None where they are not.
    """
    reading = decided.best.interpretation.reading
    of_joints = reading.rotation == JOINT_ANGLES
    direct = "eye_in_hand" if decided.best.interpretation.carries else "eye_to_hand"
    other = "eye_to_hand" if decided.best.interpretation.carries else "eye_in_hand"
    away = (decided.scanner_away, decided.part_away)
    scanner, part = (f"{mm:.0f} mm" for mm in away)
    placed = (
        f"under it the scanner lies {scanner} from the origin of its frame and the part {part} from that of its own"
    )
    told = True
    by: Because = "file"
    if mount is not None:
        chosen, reason = mount, "stated with --mount"
    elif reading.layout.turntable:
        chosen, reason = "eye_to_hand", "a turntable carries the part"
    elif inverse is not None or of_joints:
        chosen = other if inverse else direct
        reason = "the direction of the poses is " + ("stated" if inverse is not None else "known from joint angles")
    elif decided.determined and max(away) > _NEARER * min(away):
        chosen = "eye_in_hand" if min(away) == decided.scanner_away else "eye_to_hand"
        reason = f"{placed}: what lies nearer sits at the flange"
        by = "usual"
    elif decided.determined:
        chosen, reason, told = direct, f"{placed}; poses are usually those of the flange in the base", False
    else:
        chosen, reason, told = direct, "as poses usually are", False
    inverted = chosen != direct
    value = f"{chosen}, {_WORDS[chosen]}; the poses are {'T_flange_base' if inverted else 'T_base_flange'}"
    rest = other if chosen == direct else direct
    runner_up = f"{rest} with poses {'inverted' if not inverted else 'as they are'}" if mount is None else None
    guess = Guess("mount", value, reason, told, "--mount", runner_up, by, None, {"mount": chosen}, {"mount": rest})
    return Mounting(chosen, inverted, guess)
