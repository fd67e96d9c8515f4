"""Does the hand-eye's sigma of a rig cover what sets of other objects, scanned at the same poses, say of it?

Usage: python bench/rig_of_objects.py PATH_OF_REGHEC_SESSIONS [--write]

Four objects before one eye-in-hand scanner, at equal poses of the robot: what the poses do wrong they do wrong before
every object. All sets of objects without a common one: difference of their hand-eyes against both covariances, χ²/6;
with errors that equal poses share, and as if all poses scattered independently. --write puts the table into
docs/method.md.
"""

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from blind_trials import pin

from stitch.fit.coarse import find_coarse_hand_eye
from stitch.fit.correct import correct
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import prior_pose_errors
from stitch.observations.surfaces.hand_eye_fit import SCANNER_FIELD, HandEyeFit, fit_hand_eye
from stitch.observations.surfaces.scanner_errors import field_scatter
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.session.capture import Capture, prepare_capture
from stitch.session.measurement import Measurement, measurement_of, with_part_origin
from stitch.session.reading.session_folder import load_session

IN_HAND = ("david", "cone", "sphere", "rubik")
PAGE = Path(__file__).resolve().parents[1] / "docs" / "method.md"
MARKS = ("<!-- rig: begin -->", "<!-- rig: end -->")
# Fits about the hand-eye of the fit before; the last one counts.
_FITS = 2


@dataclass(frozen=True)
class Object:
    """One scanned object, its views freed by their overlaps."""

    measurement: Measurement
    capture: Capture
    freed: UnconstrainedPoses
    field: Array  # (6V, K) errors of the scanner that all views share


def objects_of(folder: Path) -> tuple[dict[str, Object], Array]:
    """All objects, and the hand-eye (4, 4) of the first."""
    sessions = {name: load_session(folder / name) for name in IN_HAND}
    captures = {name: prepare_capture(session) for name, session in sessions.items()}
    begun = find_coarse_hand_eye([captures[IN_HAND[0]]])
    out, T_mount = {}, begun.T_mount
    for name, own in captures.items():
        found = correct([own], T_mount, begun.gate)
        T_mount = found.model.T_mount if name == IN_HAND[0] else T_mount
        measurement = with_part_origin(measurement_of(sessions[name], own), found.model.T_mount)
        field = field_scatter(measurement, found.unconstrained[0], None)
        out[name] = Object(measurement, found.captures[0], found.unconstrained[0], field)
    return out, T_mount


def fitted(objects: Sequence[Object], T_mount: Array, shared: bool) -> HandEyeFit:
    """The hand-eye of some objects as one rig."""
    captures = [o.capture for o in objects]
    for turn in range(_FITS):
        freed = [o.freed.relative_to(o.capture.poses(T_mount)) for o in objects]
        centres, errors = [f.overlaps.gram.centre for f in freed], None
        if shared and turn == _FITS - 1:
            errors = prior_pose_errors([o.measurement for o in objects], Model(T_mount), centres)
        found = fit_hand_eye(
            captures, freed, T_mount, scanner_errors={SCANNER_FIELD: [o.field for o in objects]}, errors=errors
        )
        T_mount = found.T_mount
    return found


def table(objects: dict[str, Object], T_mount: Array) -> list[str]:
    """Rows for errors that equal poses share, and for independent ones."""
    rows = ["| poses | single objects | two and two | one and three | sigma of one, mm | of two | of all four |"]
    rows.append("|---|---|---|---|---|---|---:|")
    for words, shared in (("independent", False), ("equal poses share their errors", True)):
        sets = [s for size in (1, 2, 3, 4) for s in combinations(objects, size)]
        found = {s: fitted([objects[name] for name in s], T_mount, shared) for s in sets}
        cells = []
        for sizes in ((1, 1), (2, 2), (1, 3)):
            pairs = [(a, b) for a, b in combinations(sets, 2) if (len(a), len(b)) == sizes and not set(a) & set(b)]
            ratios = [_chi_square(found[a], found[b]) / 6 for a, b in pairs]
            cells.append(f"{np.mean(ratios):.2f} ({min(ratios):.2f} … {max(ratios):.2f})")
        for size in (1, 2, 4):
            sigmas = [float(np.sqrt(np.trace(found[s].covariance[3:, 3:]))) for s in sets if len(s) == size]
            cells.append(f"{min(sigmas):.2f} … {max(sigmas):.2f}" if len(sigmas) > 1 else f"{sigmas[0]:.2f}")
        rows.append(f"| {words} | {' | '.join(cells)} |")
    return rows


def _chi_square(a: HandEyeFit, b: HandEyeFit) -> float:
    xi = frames.log(frames.inverse(a.T_mount) @ b.T_mount)
    return float(xi @ np.linalg.solve(a.covariance + b.covariance, xi))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    pin(0)
    rows = "\n".join(table(*objects_of(options.folder)))
    print(rows)
    if options.write:
        whole = f"{MARKS[0]}\n{rows}\n{MARKS[1]}"
        PAGE.write_text(re.sub(f"{MARKS[0]}.*?{MARKS[1]}", lambda _: whole, PAGE.read_text(), flags=re.S))


if __name__ == "__main__":
    main()
