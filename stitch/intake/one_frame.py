"""Scans that lie in one frame already: moved there by the scanner's software, so that no pose is left to tell."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.intake.doctor import ConventionChoice
from stitch.intake.ways import MM
from stitch.integrity.motion_fit import FEWEST, ROTATION, TRANSLATION_M, rotation_angles
from stitch.integrity.relative_scans import RelativeScans


def require_own_frames(folder: Path, motions: Callable[[], RelativeScans], decided: ConventionChoice) -> None:
    """Refuse scans that no reading of the poses brings together, and most of which meet their neighbours as they are.

    Args:
        motions: between neighbouring scans, mm; asked only where the scans do not tell the reading.

    Raises:
        InputError: the scans hardly move against each other, and not as the poses do.
    """
    if decided.determined:
        return
    T = motions().T
    if len(T) < FEWEST:
        return
    moved = np.linalg.norm(T[:, :3, 3], axis=1)
    still = float(((rotation_angles(T) < ROTATION) & (moved < TRANSLATION_M / MM)).mean())
    if still > max(0.5, decided.best.closed or 0.0):
        raise InputError(
            f"{folder}: {still:.0%} of neighbouring scans meet as they are, and not as the poses say: they lie in one "
            "frame already, or most of what they show stands still before the scanner; to fix: export every scan in "
            "the scanner's own frame, or cut away what stands still"
        )
