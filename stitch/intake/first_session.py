"""From a folder of scans and poses to the first session: read, paired, judged by the scans, with reasons.

What a person states is taken; what the files tell is read; the rest is decided by the scans (`choose_convention`).
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.folder_files import (
    MM,
    FolderFiles,
    Guess,
    Interpretation,
    Pairing,
    all_interpretations,
    find_folder_files,
    pairings,
)
from stitch.intake.layouts import (
    CLOUD_UNITS,
    JOINT_ANGLES,
    POSE_UNITS,
    Reading,
    cloud_units,
    covariate_columns,
    joint_layouts,
    joint_readings,
    pose_units,
    possible_layouts,
    readings,
    rotation_conventions,
    size_words,
)
from stitch.intake.raw_poses import RawPoses, header_poses, is_program, program_poses, read_raw_poses
from stitch.intake.scan_targets import TargetSearch, find_folder_targets, target_motions
from stitch.integrity.conventions import (
    CLEARLY_BETTER,
    FEWEST,
    ROTATION,
    TRANSLATION_M,
    MotionFit,
    RelativeScans,
    SurfaceFit,
    equivalent_hypotheses,
    fit_centroids,
    fit_hypotheses,
    register_scan_pairs,
    rotation_angles,
    surface_misfit,
)
from stitch.integrity.hypotheses import Hypothesis
from stitch.measurement.capture import Capture, thin_session
from stitch.measurement.session import Cloud, Scanner, Session, Sighting, View
from stitch.reading.clouds import read_cloud
from stitch.system.process import steps

# Ways that stitch alike: poses that differ by one fixed frame before or behind them cannot be told apart by scans.


def equivalent_interpretations(
    interpretation: Interpretation, interpretations: Sequence[Interpretation]
) -> tuple[Interpretation, ...]:
    """All ways that stitch like one, itself included, in their order: the usual first."""
    own = interpretation.hypothesis(0)
    same = [w for w in interpretations if w.carries == interpretation.carries and _are_equivalent(w.hypothesis(0), own)]
    return tuple(same) or (interpretation,)


def transferred_hand_eye(interpretation: Interpretation, to: Interpretation, T_mount: Array) -> Array:
    """The hand-eye (4, 4) of one way as that of another that stitches alike."""
    a, b = interpretation.hypothesis(0), to.hypothesis(0)
    if interpretation is to or _same_scanner_motion(a, b):
        return T_mount
    first = interpretation.pairing.used[0]
    return np.asarray(frames.inverse(b.T_reference_mount[first]) @ a.T_reference_mount[first] @ T_mount)


def distinct_hypotheses(ranked: Sequence[int], tried: Sequence[Hypothesis], most: int) -> list[int]:
    """The first few that move the scanner differently; of those that move it alike the first stays."""
    kept: list[int] = []
    for i in ranked:
        if len(kept) == most:
            break
        if not any(_are_equivalent(tried[i], tried[k]) for k in kept):
            kept.append(i)
    return kept


def _are_equivalent(a: Hypothesis, b: Hypothesis) -> bool:
    """Poses that differ by one fixed frame before or behind them stitch alike."""
    if a.used != b.used:
        return False
    A, B = _used_poses(a), _used_poses(b)
    behind = np.abs(A @ frames.inverse(A[:1]) - B @ frames.inverse(B[:1]))
    return _same_scanner_motion(a, b) or _small(behind)


def _same_scanner_motion(a: Hypothesis, b: Hypothesis) -> bool:
    A, B = _used_poses(a), _used_poses(b)
    return _small(np.abs(frames.inverse(A[:1]) @ A - frames.inverse(B[:1]) @ B))


def _used_poses(h: Hypothesis) -> Array:
    return h.T_reference_mount if h.used is None else h.T_reference_mount[list(h.used)]


def _small(off: Array) -> bool:
    """Below a milliradian and a millimetre."""
    return bool(off[:, :3, :3].max() < 1e-3 and off[:, :3, 3].max() < 1.0)


# What a table does not tell is told by the scans: order of rotations, direction, unit and pairing, tried on all ways.
#
# Three judges, from cheap to dear: the centroids of the clouds come to one point, the motions between neighbouring
# scans close, the surfaces of all views fall together. The engine is that of `stitch check --deep`.

# Ways that the dear judge sees: the best of each cheap one.
_SHORT = 4
# Motions that closed give a start for the surfaces.
_CLOSED = 0.5
# A fitted scale belongs to a unit within this factor: 10 and 25.4 lie 2.5 apart.
_UNIT_FACTOR = 1.5
# Scanner or part sits at the flange if it lies this much nearer to its frame's origin than the other.
_NEARER = 1.5


@dataclass(frozen=True)
class ConventionScore:
    """A way with what the scans say of it."""

    interpretation: Interpretation
    T_mount: Array  # (4, 4) mm
    misfit: float  # mm, rms distance between the views, truncated
    meets: bool  # some views overlap
    closed: float | None  # share of the scanner's motions that close; None where not asked


@dataclass(frozen=True)
class ConventionChoice:
    """The best way and the next; `told`: the scans tell them apart."""

    best: ConventionScore
    runner_up: ConventionScore | None
    determined: bool
    equivalent: tuple[Interpretation, ...]  # others that stitch alike: they differ from the best by one fixed frame
    scanner_away: float  # mm: of the scanner from the origin of its mount's frame
    part_away: float  # mm: of the part from the origin of the reference frame

    @property
    def scanner_at_flange(self) -> bool:
        """True if the scanner rather than the part sits at the flange."""
        return self.scanner_away <= self.part_away

    @property
    def mount_determined(self) -> bool:
        """True if one of the two clearly sits nearer than the other."""
        low, high = sorted((self.scanner_away, self.part_away))
        return high > _NEARER * low


def choose_convention(
    capture: Capture,
    motions: Callable[[], RelativeScans],
    readings: Sequence[Reading],
    pairs: Sequence[Pairing],
    units: Sequence[str],
    carries: bool | None = None,
    target_motions: RelativeScans | None = None,
) -> ConventionChoice:
    """Try all ways; the motions, and pairings beside the first, only where the surfaces alone do not tell.

    Args:
        capture: the scans, mm; its poses do not count.
        motions: gives those between neighbouring scans, mm; dear.
        units: that positions can have of which the file does not say it.
        carries: whether the poses carry the mount's frame (see `Way`); None tries both.
        target_motions: motions between views that targets show, mm: where there are enough, they alone decide.
    """
    directions = (True, False) if carries is None else (carries,)
    if target_motions is not None and len(target_motions.pairs) >= FEWEST:
        paired = _with_confirmed_unit(target_motions, all_interpretations(readings, pairs, units, directions))
        return _choose_interpretation(capture, paired, target_motions, by_targets=True)
    ways = all_interpretations(readings, pairs[:1], units, directions)
    if len({way.length_unit for way in ways}) > 1:
        ways = _with_confirmed_unit(motions(), ways)
    first = _choose_interpretation(capture, ways, None)
    if not first.determined:
        first = _choose_interpretation(capture, ways, motions())
    if first.determined or len(pairs) == 1:
        return first
    every = _choose_interpretation(
        capture, _with_confirmed_unit(motions(), all_interpretations(readings, pairs, units, directions)), motions()
    )
    # What is a guess anyway leaves out no view for it.
    whole = len(every.best.interpretation.pairing.used) >= len(first.best.interpretation.pairing.used)
    return every if every.determined or (whole and every.best.misfit < first.best.misfit) else first


def _choose_interpretation(
    capture: Capture, interpretations: Sequence[Interpretation], motions: RelativeScans | None, by_targets: bool = False
) -> ConventionChoice:
    tried = [way.hypothesis(i) for i, way in enumerate(interpretations)]
    meets = fit_centroids(tried, np.array([scan.points.mean(axis=0) for scan in capture.scans]))
    closing = {} if motions is None else {int(e.hypothesis.kind): e for e in fit_hypotheses(tried, motions, "mm")}
    by_motion = sorted(closing, key=lambda i: closing[i].open)
    by_centroid = sorted(range(len(interpretations)), key=lambda i: meets[i][0])
    by_motion = distinct_hypotheses(by_motion, tried, _SHORT)
    short = (
        by_motion if by_targets else list(dict.fromkeys([*distinct_hypotheses(by_centroid, tried, _SHORT), *by_motion]))
    )
    judged = []
    for i in steps("ways to read the poses", short):
        closed = closing.get(i)
        starts = [meets[i][1], *([closed.T_mount] if closed is not None and closed.closed >= _CLOSED else [])]
        judged.append(_convention_score(interpretations[i], surface_misfit(capture, tried[i], starts), closed))
    if not by_targets:
        judged.sort(key=lambda j: j.misfit)
    best, runner_up = judged[0], judged[1] if len(judged) > 1 else None
    alone = _sole_contender(list(closing.values()))
    clear = runner_up is None or runner_up.misfit >= CLEARLY_BETTER * best.misfit
    single = alone is not None and interpretations[alone] is best.interpretation
    told = single if by_targets else (clear or single) and best.meets and len(best.interpretation.pairing.used) > 2
    same = equivalent_interpretations(best.interpretation, interpretations)
    best = replace(
        best, interpretation=same[0], T_mount=transferred_hand_eye(best.interpretation, same[0], best.T_mount)
    )
    return ConventionChoice(best, runner_up, bool(told), same[1:], *_flange_distances(capture, best))


def _convention_score(interpretation: Interpretation, fallen: SurfaceFit, closing: MotionFit | None) -> ConventionScore:
    return ConventionScore(
        interpretation, fallen.T_mount, fallen.misfit, fallen.meets, None if closing is None else closing.closed
    )


def _sole_contender(explained: Sequence[MotionFit]) -> int | None:
    """The way that the motions alone single out, if they do."""
    close = equivalent_hypotheses(explained)
    return int(close[0].hypothesis.kind) if len(close) == 1 else None


def _with_confirmed_unit(motions: RelativeScans, interpretations: Sequence[Interpretation]) -> list[Interpretation]:
    """The ways whose unit of length the motions of the scanner confirm; all where they say nothing."""
    units = {way.length_unit for way in interpretations}
    if len(units) == 1:
        return list(interpretations)
    first = {
        (way.reading.words, way.reading.layout.words, way.pairing, way.carries): way for way in interpretations[::-1]
    }
    plain = [replace(way, length_unit="mm") for way in first.values()]
    fitted = fit_hypotheses([w.hypothesis(i) for i, w in enumerate(plain)], motions, "mm", scaled=True)
    best = equivalent_hypotheses([e for e in fitted if e.scale > 0])
    if not best:
        return list(interpretations)
    unit = min(units, key=lambda u: abs(np.log(best[0].scale * MM / POSE_UNITS[u])))
    near = abs(np.log(best[0].scale * MM / POSE_UNITS[unit])) < np.log(_UNIT_FACTOR)
    return [way for way in interpretations if way.length_unit == unit] if near else list(interpretations)


def _flange_distances(capture: Capture, score: ConventionScore) -> tuple[float, float]:
    """How far the scanner lies from its mount's origin, and the part from that of the reference frame."""
    hypothesis = score.interpretation.hypothesis(0)
    poses = hypothesis.T_reference_mount @ score.T_mount
    used = range(len(poses)) if hypothesis.used is None else hypothesis.used
    centres = [frames.transform(poses[v], capture.scans[v].points.mean(axis=0)[None])[0] for v in used]
    return float(np.linalg.norm(score.T_mount[:3, 3])), float(np.linalg.norm(np.mean(centres, axis=0)))


# Which of scanner and part the robot carries, and whether poses are of the flange in the base or the other way round.
#
# Scans cannot tell "the scanner at the flange" from "the part at the flange, poses inverted": both move alike. What
# tells them apart is where things lie: what sits at the flange is near its origin, what stands in the cell is not near
# that of the base.

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


def choose_mounting(decided: ConventionChoice, mount: str | None, inverse: bool | None, of_joints: bool) -> Mounting:
    """Settle it, by what a person states, else by where things lie.

    Args:
        mount, inverse: as stated; None where they are not.
        of_joints: poses are from joint angles, so that their direction is known.
    """
    direct = "eye_in_hand" if decided.best.interpretation.carries else "eye_to_hand"
    other = "eye_to_hand" if decided.best.interpretation.carries else "eye_in_hand"
    nearer = "eye_in_hand" if decided.scanner_at_flange else "eye_to_hand"
    scanner, part = (f"{mm:.0f} mm" for mm in (decided.scanner_away, decided.part_away))
    placed = (
        f"under it the scanner lies {scanner} from the origin of its frame and the part {part} from that of its own"
    )
    told = True
    if mount is not None:
        chosen, reason = mount, "stated with --mount"
    elif inverse is not None or of_joints:
        chosen = other if inverse else direct
        reason = "the direction of the poses is " + ("stated" if inverse is not None else "known from joint angles")
    elif decided.determined and decided.mount_determined:
        chosen, reason = nearer, f"{placed}: what lies nearer sits at the flange"
    else:
        chosen, told = direct, False
        reason = (
            f"{placed}; poses are usually those of the flange in the base"
            if decided.determined
            else "as poses usually are"
        )
    inverted = chosen != direct
    value = f"{chosen}, {_WORDS[chosen]}; the poses are {'T_flange_base' if inverted else 'T_base_flange'}"
    rest = other if chosen == direct else direct
    runner_up = f"{rest} with poses {'inverted' if not inverted else 'as they are'}" if mount is None else None
    return Mounting(chosen, inverted, Guess("mount", value, reason, told, "--mount", runner_up))


# Scans that lie in one frame already: moved there by the scanner's software, so that no pose is left to tell.


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


# What a person states with flags, of a table of poses and of the folder it lies in; None where nothing is stated.

_MOUNTS = ("eye_in_hand", "eye_to_hand")


@dataclass(frozen=True)
class StatedTable:
    """How a table of poses is to be read, checked."""

    columns: tuple[str, ...] = ()
    rotation: str | None = None
    angle_unit: str | None = None
    length_unit: str | None = None  # of the poses
    inverse: bool | None = None  # the table holds T_flange_base

    def __post_init__(self) -> None:
        """Refuse words that mean nothing.

        Raises:
            InputError: names the flag and what it knows.
        """
        _require_known_word("--rotation", self.rotation, rotation_conventions())
        _require_known_word("--angles", self.angle_unit, ("deg", "rad"))
        _require_known_word("--unit, --file-unit", self.length_unit, POSE_UNITS)


@dataclass(frozen=True)
class StatedFolder(StatedTable):
    """And what its folder holds beside it, checked."""

    poses: Path | None = None
    cloud_unit: str | None = None
    mount: str | None = None
    targets: TargetSearch = field(default_factory=TargetSearch)  # boards and balls in the scans

    def __post_init__(self) -> None:
        """As of the table."""
        super().__post_init__()
        _require_known_word("--cloud-unit", self.cloud_unit, CLOUD_UNITS)
        _require_known_word("--mount", self.mount, _MOUNTS)

    @property
    def carries(self) -> bool | None:
        """Whether the poses as written carry the mount's frame, where mount and direction are both stated."""
        if self.mount is None or self.inverse is None:
            return None
        return (self.mount == "eye_in_hand") != self.inverse


def _require_known_word(flag: str, value: str | None, known: Collection[str]) -> None:
    if value is not None and value not in known:
        raise InputError(f"{flag} {value}: to fix: use {', '.join(known)}")


# The guesses of a first session, each with its reason in words.


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


# Enough points a view to tell conventions.
_POINTS = 8000
_FEWEST = 3


@dataclass(frozen=True)
class FirstSession:
    """What was found in a folder and how it is to be taken."""

    files: FolderFiles
    raw: RawPoses
    cloud_unit: str
    choice: ConventionChoice
    mounting: Mounting
    guesses: tuple[Guess, ...]
    optical_axis: str
    sightings: tuple[Sighting, ...] = ()  # mm, of every cloud, where targets are looked for

    @property
    def pairing(self) -> Pairing:
        """Which row belongs to which cloud."""
        return self.choice.best.interpretation.pairing


def first_session(folder: Path, stated: StatedFolder) -> FirstSession:
    """Find, read and judge.

    Raises:
        InputError: no clouds or poses, or one that cannot be read; names the file and what to do.
    """
    found = find_folder_files(folder, stated.poses)
    raw = _read_folder_poses(found)
    raw = raw.renamed(stated.columns) if stated.columns else raw
    ways_to_read = all_readings(raw, found.urdf, stated)
    clouds = [read_cloud(file) for file in found.clouds]
    for file, cloud in zip(found.clouds, clouds, strict=True):
        if len(cloud.points) < _FEWEST:
            raise InputError(f"{file}: {len(cloud.points)} points show no surface; to fix: take the scan out")
    points = [c.points for c in clouds]
    own_units = [stated.cloud_unit] if stated.cloud_unit else cloud_units(points)
    pairs = pairings(found.clouds, raw.labels, raw.numbers)
    capture = capture_of(clouds, CLOUD_UNITS[own_units[0]] / MM)
    units = candidate_units(ways_to_read, stated)
    seen, of_targets = find_folder_targets(found, points, CLOUD_UNITS[own_units[0]], stated.targets)
    motions = cache(lambda: register_scan_pairs(capture))
    shown = target_motions(seen) if seen else None
    decided = choose_convention(capture, motions, ways_to_read, pairs, units, stated.carries, shown)
    require_own_frames(folder, motions, decided)
    of_joints = decided.best.interpretation.reading.rotation == JOINT_ANGLES
    settled = choose_mounting(decided, stated.mount, stated.inverse, of_joints)
    axis, axis_guess = guess_optical_axis(clouds)
    told = session_guesses(found, raw, decided, points, own_units, stated)
    guesses = (*told, settled.guess, axis_guess, *of_targets)
    return FirstSession(found, raw, own_units[0], decided, settled, guesses, optical_axis=axis, sightings=seen)


def _read_folder_poses(files: FolderFiles) -> RawPoses:
    if not files.poses:
        return header_poses(files.clouds)
    first = files.poses[0]
    if is_program(first):
        return program_poses(first)
    return read_raw_poses(files.poses)


def all_readings(raw: RawPoses, urdf: Path | None, stated: StatedTable) -> list[Reading]:
    """Every reading of a table that is not ruled out by what a person states.

    Args:
        urdf: of the robot, where the table may hold joint angles.

    Raises:
        InputError: columns that hold no pose.
    """
    out: list[Reading] = []
    for layout in possible_layouts(raw):
        if layout.rotation.shape[1]:
            out += readings(layout, stated.rotation, stated.angle_unit)
        else:
            out += joint_readings(layout, urdf, stated.angle_unit)
    if raw.header is None and raw.numbers.shape[1] >= 6 and urdf is not None and stated.rotation is None:
        out += [r for layout in joint_layouts(raw) for r in joint_readings(layout, urdf, stated.angle_unit)]
    return out


def candidate_units(readings: Sequence[Reading], stated: StatedTable) -> list[str]:
    """Units that positions can have of which the file does not say it: stated, or plausible."""
    if stated.length_unit:
        return [stated.length_unit]
    open_ = [r for r in readings if r.layout.length_unit is None]
    return list(dict.fromkeys(unit for r in open_ for unit in pose_units(r.T[:, :3, 3]))) or ["mm"]


def capture_of(clouds: Sequence[Cloud], scale: float) -> Capture:
    """Scans made light, in mm, at no poses."""
    views = tuple(
        View(
            name=f"v{i}",
            cloud=Cloud(cloud.points * scale, cloud.normals),
            T_base_flange=np.eye(4),
            joints=None,
            approach=None,
            time_s=None,
            covariates={},
        )
        for i, cloud in enumerate(clouds)
    )
    session = Session(
        path=Path(),
        name="",
        length_unit="mm",
        mount="eye_in_hand",
        scanner=Scanner(None, None, None, np.array([0.0, 0.0, 1.0])),
        robot=None,
        sphere_radius=None,
        cad=None,
        cad_unit=None,
        views=views,
    )
    return thin_session(session, _POINTS)[1]


def guess_optical_axis(clouds: Sequence[Cloud]) -> tuple[str, Guess]:
    """The side of z on which the points lie."""
    middle: Array = np.mean([np.median(c.points, axis=0) for c in clouds], axis=0)
    axis = "-z" if middle[2] < 0 and abs(middle[2]) > np.linalg.norm(middle[:2]) else "+z"
    told = abs(middle[2]) > np.linalg.norm(middle[:2])
    where = ", ".join(f"{x:.3g}" for x in middle)
    reason = f"the middle of the scans lies at ({where}) in the scanner's frame"
    return axis, Guess("optical_axis", axis, reason, bool(told), "optical_axis in session.toml")
