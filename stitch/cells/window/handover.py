"""The scans of a part or a seam as a cloud session, with the hand-eye that placed them and their CAD."""

from pathlib import Path

from stitch.cells.session_folder import HandOver
from stitch.cells.window.scans import Placed


def session(name: str, placed: Placed, cad: Path | None = None) -> HandOver:
    """One view for each scan; where the job knew only the scanner's poses, the scanner itself counts as the flange."""
    return HandOver(
        name, placed.length_unit, "eye_in_hand", placed.names, placed.T_base_flange, placed.T_flange_scanner,
        clouds=placed.clouds, cad=cad,
    )  # fmt: skip
