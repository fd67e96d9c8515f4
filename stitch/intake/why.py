"""The guesses of a first session, each with its reason in words."""

from collections.abc import Sequence

import numpy as np

from stitch.frames import Array
from stitch.intake.covariates import covariate_columns
from stitch.intake.doctor import ConventionChoice, ConventionScore
from stitch.intake.found_files import FolderFiles
from stitch.intake.guesses import Guess
from stitch.intake.plausible_units import POSE_UNITS, size_words
from stitch.intake.raw_poses import RawPoses
from stitch.intake.stated import StatedFolder


def session_guesses(
    files: FolderFiles,
    raw: RawPoses,
    decided: ConventionChoice,
    clouds: Sequence[Array],
    own_units: Sequence[str],
    stated: StatedFolder,
) -> tuple[Guess, ...]:
    """What was found and how it is read; of the mount speaks `mounting.py`."""
    return (
        _files_guess(files, raw),
        _pairing_guess(decided),
        _columns_guess(raw, decided, stated),
        _rotation_guess(decided, stated),
        _length_unit_guess(decided, stated),
        _cloud_unit_guess(files, clouds, own_units, stated),
    )


def score_words(score: ConventionScore) -> str:
    """What the scans say of a way."""
    if not score.meets:
        return "no two views meet"
    motions = "" if score.closed is None else f", {100 * score.closed:.0f} % of the scanner's motions close"
    return f"views {score.misfit:.2f} mm apart{motions}"


def _files_guess(files: FolderFiles, raw: RawPoses) -> Guess:
    clouds = f"{len(files.clouds)} clouds {files.clouds[0].name} … {files.clouds[-1].name}"
    aside = f"; left aside: {', '.join(f.name for f in files.unused[:5])}" if files.unused else ""
    return Guess(
        "files", f"{clouds}, {len(raw.numbers)} poses in {_files_words(files)}", f"{raw.words}{aside}", True, "--poses"
    )


def _files_words(files: FolderFiles) -> str:
    if not files.poses:
        return "their headers"
    first, last = files.poses[0].name, files.poses[-1].name
    return first if len(files.poses) == 1 else f"{first} … {last}"


def _pairing_guess(decided: ConventionChoice) -> Guess:
    pairing = decided.best.interpretation.pairing
    if pairing.by_name:
        return Guess("pairing", pairing.words, "cloud and pose bear the same name, time or number", True, "--poses")
    reason = f"names do not tell it; under it {score_words(decided.best)}"
    return Guess("pairing", pairing.words, reason, decided.determined, "a column with the cloud's file name")


def _columns_guess(raw: RawPoses, decided: ConventionChoice, stated: StatedFolder) -> Guess:
    layout = decided.best.interpretation.reading.layout
    beside = list(covariate_columns(layout, range(len(raw.numbers)), raw.time_s))
    words = f"; beside the poses {', '.join(beside)}" if beside else ""
    words += f"; {raw.clock.words}" if raw.clock is not None and raw.clock.words else ""
    if stated.columns:
        return Guess("columns", ", ".join(stated.columns), f"stated with --columns{words}", True, "--columns")
    reason = ("the file names them" if layout.named else "told by their values") + words
    return Guess("columns", layout.words, reason, layout.named or decided.determined, "--columns")


def _rotation_guess(decided: ConventionChoice, stated: StatedFolder) -> Guess:
    best = decided.best.interpretation.reading
    if stated.rotation:
        return Guess("rotation", best.words, "stated with --rotation", True, "--rotation")
    if best.layout.convention is not None:
        return Guess("rotation", best.words, "told by the file", True, "--rotation")
    reason = score_words(decided.best)
    alike = [w.reading.words for w in decided.equivalent if w.reading.words != best.words]
    if alike:
        reason += f"; {', '.join(dict.fromkeys(alike[:3]))} would stitch alike, with another hand-eye"
    other = decided.runner_up
    words = (
        None
        if other is None
        else f"{other.interpretation.reading.words}, {_direction_words(other)}, {score_words(other)}"
    )
    return Guess("rotation", best.words, reason, decided.determined, "--rotation", words)


def _direction_words(score: ConventionScore) -> str:
    return "poses as they are" if score.interpretation.carries else "poses inverted"


def _length_unit_guess(decided: ConventionChoice, stated: StatedFolder) -> Guess:
    way = decided.best.interpretation
    reach = float(np.linalg.norm(way.reading.T[:, :3, 3], axis=1).max())
    if stated.length_unit:
        return Guess("length_unit", way.length_unit, "stated with --unit", True, "--unit")
    if way.reading.layout.length_unit:
        return Guess("length_unit", way.length_unit, "told by the file", True, "--unit")
    metres = reach * POSE_UNITS[way.length_unit]
    reason = f"positions reach {reach:.4g}, that is {metres:.2f} m, as robots do; {score_words(decided.best)}"
    return Guess("length_unit", way.length_unit, reason, decided.determined, "--unit")


def _cloud_unit_guess(
    files: FolderFiles, clouds: Sequence[Array], own_units: Sequence[str], stated: StatedFolder
) -> Guess:
    if stated.cloud_unit:
        return Guess("cloud_unit", stated.cloud_unit, "stated with --cloud-unit", True, "--cloud-unit")
    other = own_units[1] if len(own_units) > 1 else None
    counted = files.clouds[0].suffix.lower() in (".png", ".tif", ".tiff")
    words = "; whole numbers of depth are mm unless the intrinsics state depth_scale" * counted
    return Guess("cloud_unit", own_units[0], f"{size_words(clouds)}{words}", other is None, "--cloud-unit", other)
