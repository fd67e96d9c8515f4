"""The guesses of a first session, each with its reason in words and with what decides it."""

from collections.abc import Sequence

import numpy as np

from stitch.numerics.frames import Array
from stitch.plugins.intake.convention_choice import ConventionChoice, ConventionScore
from stitch.plugins.intake.folder_files import FolderFiles
from stitch.plugins.intake.guesses import Because, Guess
from stitch.plugins.intake.layouts import POSE_UNITS, covariate_columns, size_words
from stitch.plugins.intake.raw_poses import RawPoses
from stitch.plugins.intake.stated_folder import StatedFolder

# Positions nearer to the origin are none of an arm.
_NEAR_M = 0.08


def session_guesses(
    files: FolderFiles,
    raw: RawPoses,
    decided: ConventionChoice,
    clouds: Sequence[Array],
    own_units: Sequence[str],
    stated: StatedFolder,
) -> tuple[Guess, ...]:
    """What was found and how it is read; of the mount speaks `choose_mounting`."""
    return (
        _files_guess(files, raw),
        _pairing_guess(decided),
        _columns_guess(raw, decided, stated),
        _rotation_guess(decided, stated),
        _length_unit_guess(decided, stated),
        _cloud_unit_guess(files, decided, clouds, own_units, stated),
    )


def score_words(score: ConventionScore) -> str:
    """What the scans say of a way."""
    if not np.isfinite(score.misfit):
        return "profiles do not tell it"
    if not score.meets:
        return "no two views meet"
    motions = "" if score.closed is None else f", {100 * score.closed:.0f} % of the scanner's motions close"
    return f"a rough fit leaves {score.misfit:.2f} mm{motions}"


def _files_guess(files: FolderFiles, raw: RawPoses) -> Guess:
    clouds = f"{len(files.clouds)} clouds {files.clouds[0].name} … {files.clouds[-1].name}"
    aside = f"; left aside: {', '.join(f.name for f in files.unused[:5])}" if files.unused else ""
    ends = dict.fromkeys((*files.poses[:1], *files.poses[-1:]))  # one, where there is one file
    found = f"{clouds}, {len(raw.numbers)} poses in {' … '.join(file.name for file in ends) or 'their headers'}"
    return Guess("files", found, f"{raw.words}{aside}", True, "--poses")


def _pairing_guess(decided: ConventionChoice) -> Guess:
    pairing = decided.best.interpretation.pairing
    if pairing.by_name:
        return Guess("pairing", pairing.words, "cloud and pose bear the same name, time or number", True, "--rows")
    reason = f"names do not tell it; under it {score_words(decided.best)}"
    states = {"rows": pairing.stated}
    return Guess("pairing", pairing.words, reason, decided.determined, "--rows", by="scans", states=states)


def _columns_guess(raw: RawPoses, decided: ConventionChoice, stated: StatedFolder) -> Guess:
    layout = decided.best.interpretation.reading.layout
    beside = list(covariate_columns(layout, range(len(raw.numbers)), raw.time_s))
    words = f"; beside the poses {', '.join(beside)}" if beside else ""
    taken = ", ".join(f"{x:.10g}" for x in layout.offset)
    words += f"; {taken} taken off all positions, as they are those of a site" if taken else ""
    words += f"; {raw.clock.words}" if raw.clock is not None and raw.clock.words else ""
    if stated.columns:
        return Guess("columns", ", ".join(stated.columns), f"stated with --columns{words}", True, "--columns")
    reason = ("the file names them" if layout.named else "told by their values") + words
    by: Because = "file" if layout.named else "scans"
    told = layout.named or decided.determined
    return Guess("columns", layout.words, reason, told, "--columns", by=by, states=layout.stated)


def _rotation_guess(decided: ConventionChoice, stated: StatedFolder) -> Guess:
    best = decided.best.interpretation.reading
    if stated.rotation:
        return Guess("rotation", best.words, "stated with --rotation", True, "--rotation")
    if decided.overruled:
        named = ", as the columns are named" * best.layout.named
        reason = f"the scans contradict {decided.overruled}{named}; {score_words(decided.best)}"
        return Guess("rotation", best.words, reason, decided.determined, "--rotation", by="scans", states=best.stated)
    if best.layout.convention is not None:
        sure = best.layout.sure or (decided.determined and not decided.only_believed)
        reason = f"only the names say so; {decided.only_believed or 'others'} would fit too"
        reason = "told by the file" if sure else reason
        return Guess("rotation", best.words, reason, sure, "--rotation", states=best.stated)
    reason = score_words(decided.best)
    alike = [w.reading.words for w in decided.equivalent if w.reading.words != best.words]
    if alike:
        reason += f"; {', '.join(dict.fromkeys(alike[:3]))} would stitch alike, with another hand-eye"
    other = decided.runner_up
    words = None
    if other is not None:
        direction = "poses as they are" if other.interpretation.carries else "poses inverted"
        words = f"{other.interpretation.reading.words}, {direction}, {score_words(other)}"
    worse = None if other is None or not decided.best.misfit else other.misfit / decided.best.misfit
    worse_by = None if worse is None or not np.isfinite(worse) else round(worse, 3)
    states, rival = best.stated, {} if other is None else other.interpretation.reading.stated
    told = decided.determined
    return Guess("rotation", best.words, reason, told, "--rotation", words, "scans", worse_by, states, rival)


def _length_unit_guess(decided: ConventionChoice, stated: StatedFolder) -> Guess:
    way = decided.best.interpretation
    reach = float(np.linalg.norm(way.reading.T[:, :3, 3], axis=1).max())
    if stated.length_unit:
        return Guess("length_unit", way.length_unit, "stated with --unit", True, "--unit")
    if way.reading.layout.length_unit:
        return Guess("length_unit", way.length_unit, "told by the file", True, "--unit")
    metres = reach * POSE_UNITS[way.length_unit]
    where = f"positions reach {reach:.4g}, that is {metres:.2f} m, as robots do"
    if metres < _NEAR_M:
        where = (
            f"positions reach {reach:.4g}, as of a turntable or of registered scans; taken to be in the clouds' unit"
        )
    reason = f"{where}; {score_words(decided.best)}"
    # The motions of the scans have a scale only where the unit of the clouds is known.
    by: Because = "scans" if stated.cloud_unit else "usual"
    states = {"unit": way.length_unit}
    return Guess("length_unit", way.length_unit, reason, decided.determined, "--unit", by=by, states=states)


def _cloud_unit_guess(
    files: FolderFiles,
    decided: ConventionChoice,
    clouds: Sequence[Array],
    own_units: Sequence[str],
    stated: StatedFolder,
) -> Guess:
    if stated.cloud_unit:
        return Guess("cloud_unit", stated.cloud_unit, "stated with --cloud-unit", True, "--cloud-unit")
    other = own_units[1] if len(own_units) > 1 else None
    counted = files.clouds[0].suffix.lower() in (".png", ".tif", ".tiff")
    words = "; whole numbers of depth are mm unless the intrinsics state depth_scale" * counted
    layout = decided.best.interpretation.reading.layout
    known = stated.length_unit or (layout.length_unit and not layout.turntable)
    by: Because = "scans" if known and decided.determined else "usual"
    reason = f"{size_words(clouds)}{words}"
    states, rival = {"cloud_unit": own_units[0]}, {"cloud_unit": other} if other else {}
    return Guess("cloud_unit", own_units[0], reason, other is None, "--cloud-unit", other, by, None, states, rival)
