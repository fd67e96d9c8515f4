"""Whether an arm that another session showed holds in this one: what it leaves beside what the nominal arm leaves.

What imitates among the poses of one session may err at those of another; base, tool and targets are fitted with either
arm, so that nothing but the arm makes the difference.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stitch.frames import Array
from stitch.model.model_toml import ModelFile
from stitch.stages.finish import per_view_rms
from stitch.stages.fitted import FittedRig
from stitch.statistics.shares import significantly_smaller
from stitch.units import length_text

# That an arm which is right is doubted.
_ARM_CHANCE = 0.01
# A fit of the sessions with an arm, or with the nominal one.
FitWithArm = Callable[[ModelFile | None], FittedRig]


@dataclass(frozen=True)
class ArmTransfer:
    """Rms over all views with an arm, length_unit."""

    effects: tuple[str, ...]
    rms: float
    nominal_rms: float
    worse: bool  # the nominal arm leaves less, beyond chance
    better_without: str | None = None  # the effect without which the rest of the arm leaves least, and less
    without_rms: float = np.nan

    @property
    def holds(self) -> bool:
        """True unless the arm, or an effect of it, makes it worse."""
        return not self.worse and self.better_without is None

    def sentence(self, unit: str) -> str:
        """What the arm does here; where it does not hold, a doubt."""
        here, nominal, without = (length_text(x, unit) for x in (self.rms, self.nominal_rms, self.without_rms))
        if self.holds:
            return f"The arm of the other run leaves {here} where the nominal arm leaves {nominal}."
        told = f"The arm of the other run ({', '.join(self.effects)}) does not hold here: it leaves {here}"
        if self.better_without is None:
            return f"{told}, the nominal arm {nominal}; calibrate it at poses like these, or run without --arm."
        return (
            f"{told}, the nominal arm {nominal}, and without its {self.better_without} {without} would be left; "
            "take that out there (stitch drop)."
        )


def check_arm_transfer(fit: FitWithArm, arm: ModelFile, found: FittedRig) -> ArmTransfer:
    """Hold the arm that was kept against the nominal one, and against itself without one of its effects.

    Args:
        found: the fit with it.
    """
    own, nominal = view_mean_squares(found), view_mean_squares(fit(None))
    here = ArmTransfer(
        tuple(arm.effects),
        _rms_of_squares(own),
        _rms_of_squares(nominal),
        significantly_smaller(nominal, own, _ARM_CHANCE),
    )
    if len(arm.effects) < 2:
        return here
    rest = {name: {e: p for e, p in arm.effects.items() if e != name} for name in arm.effects}
    left = {name: view_mean_squares(fit(replace(arm, effects=effects))) for name, effects in rest.items()}
    best = min(left, key=lambda name: _rms_of_squares(left[name]))
    less = significantly_smaller(left[best], own, _ARM_CHANCE / len(left))
    return replace(here, better_without=best, without_rms=_rms_of_squares(left[best])) if less else here


def _rms_of_squares(squares: Array) -> float:
    return float(np.sqrt(np.nanmean(squares)))


def view_mean_squares(fitted: FittedRig) -> Array:
    """(ΣV,) mean square distance of the targets, or of the surfaces, in every view; NaN where nothing was seen."""
    if fitted.correction is not None:
        every = zip(fitted.captures, fitted.correction.overlaps, strict=True)
        return np.concatenate([per_view_rms(overlaps, len(c.scans)) ** 2 for c, overlaps in every])
    return np.concatenate([own.targets.view_squares for own in fitted.sessions if own.targets is not None])
