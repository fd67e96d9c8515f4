"""From a folder of scans and poses to the first session: read, paired, judged by the scans, with reasons.

What a person states is taken; what the files tell is read; the rest is decided by the scans (`choose_convention`).
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.numerics.frames import Array
from stitch.plugins.intake.cloud_pairs import Pairing, pairings, stated_pairing
from stitch.plugins.intake.convention_choice import (
    MOST_CLOSED,
    ConventionChoice,
    ConventionScore,
    Interpretation,
    all_interpretations,
    choose_by_surfaces,
    choose_convention,
    choose_mounting,
    fitted_scale,
    require_no_background,
    require_own_frames,
    weigh_doubts,
)
from stitch.plugins.intake.folder_files import FolderFiles, angles_in_names, find_folder_files, lens_of
from stitch.plugins.intake.guesses import Because, Guess
from stitch.plugins.intake.inventory import several_lists
from stitch.plugins.intake.layouts import (
    CLOUD_UNITS,
    MM,
    POSE_UNITS,
    cloud_units,
    covariate_columns,
    kept_column,
    unit_pairs,
)
from stitch.plugins.intake.raw_poses import RawPoses, header_poses
from stitch.plugins.intake.readings import (
    Reading,
    all_readings,
    candidate_units,
    doubted_readings,
    left_handed_readings,
    mixed_readings,
    with_joints_of,
    with_uncoupled_joints,
)
from stitch.plugins.intake.refusals import Fix, Refusal, change, state
from stitch.plugins.intake.scan_headers import poses_in_scans
from stitch.plugins.intake.scan_targets import find_folder_targets, target_motions
from stitch.plugins.intake.session_guesses import session_guesses
from stitch.plugins.intake.stated_folder import StatedFolder
from stitch.plugins.intake.stops import rows_with_scans
from stitch.plugins.intake.sudden_change import groups_apart, require_no_change, require_one_part
from stitch.screening.motions import RelativeScans, register_scan_pairs
from stitch.session.capture import Capture
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.depth_image import DEPTH_SUFFIXES
from stitch.session.session import Cloud, Mount, Scanner, SessionData, Sighting, View
from stitch.session.thinning import distinct_points, thin_session
from stitch.system.process import steps

# Enough points a view to tell conventions.
_POINTS = 8000
_FEWEST = 3
# Lists that are tried where the scans contradict the likely one.
_MOST_LISTS = 4
# Of the width of a profile: how far its points lie from a plane through the scanner.
_FLAT = 1e-3
# Between units that people write; scans of one campaign differ by less, in size and in distance alike.
_UNIT_STEPS, _ALIKE = np.array([1e3, 25.4, 10.0, 0.1, 1 / 25.4, 1e-3]), 0.25
# Factors between clouds and robot that a fitted scale is taken for, within this share.
_ROUND, _ROUND_NEAR = (1.0, 2.0, 2.5, 4.0, 5.0, 8.0), 0.02
_INCHES = (25.4, 1 / 25.4, 2.54, 1 / 2.54, 0.0254, 1 / 0.0254)
# Scanners and robots agree within this share; beyond, a unit is wrong.
_SCALE = 0.05
# Factors that are none between units are scales up to this.
_LARGEST = 3.0


@dataclass(frozen=True)
class FirstSession:
    """What was found in a folder and how it is to be taken."""

    files: FolderFiles
    raw: RawPoses
    cloud_unit: str
    choice: ConventionChoice
    mount: str
    inverted: bool  # the poses as read are T_flange_base
    guesses: tuple[Guess, ...]
    optical_axis: str
    sightings: tuple[Sighting, ...] = ()  # mm, of every cloud, where targets are looked for
    sphere_mm: float | None = None  # radius, where the clouds are profiles of a sphere
    box: Array = field(default_factory=lambda: np.empty((0, 3)))  # corners, of the box that counts, unit of the clouds
    not_used: tuple[str, ...] = ()  # files, lists, rows and columns that were read or seen and left aside, and why

    @property
    def pairing(self) -> Pairing:
        """Which row belongs to which cloud."""
        return self.choice.best.interpretation.pairing


def first_session(folder: Path, stated: StatedFolder) -> FirstSession:
    """Find clouds and poses in a folder, read them, and let the scans tell how they belong together.

    Raises:
        InputError: no clouds or poses, or one that cannot be read; names the file and what to do.
    """
    found = find_folder_files(folder, stated.poses, stated.accepts)
    try:
        return _told_session(folder, found, stated)
    except Refusal as refused:
        refused.found = {"inventory": [listed.as_dict() for listed in found.inventory], **refused.found}
        raise


def _told_session(folder: Path, found: FolderFiles, stated: StatedFolder) -> FirstSession:
    """Return the session of the list of poses that the scans tell, where several may be it."""
    if found.alike == 1:
        first = _session_of(found, stated)
        if first.choice.determined or len(found.rivals) < 2:
            return first
    made = list[FirstSession]()
    for rival in found.rivals[: found.alike if found.alike > 1 else _MOST_LISTS]:
        with suppress(InputError, NoResultError):
            made.append(_session_of(replace(found, chosen=rival), stated))
    told = [other for other in made if other.choice.determined]
    if len(told) == 1:
        return told[0]
    if found.alike > 1:
        raise several_lists(folder, found.rivals[: found.alike])
    return first


def _session_of(found: FolderFiles, stated: StatedFolder) -> FirstSession:
    """Return the session of clouds and the one list of poses that was chosen."""
    raw = _read_table(found, stated)
    clouds, kept, lost = _read_clouds(found.clouds, stated.box)
    if stated.rows:
        ways_to_pair = [stated_pairing(found.clouds, stated.rows, len(raw.numbers))]
    else:
        ways_to_pair = pairings(found.clouds, raw.labels, raw.numbers)
    pairs = [pairing.of(kept, raw.without_pose) for pairing in ways_to_pair]
    every, found = found, replace(found, clouds=tuple(found.clouds[i] for i in kept))
    points = [c.points for c in clouds]
    own_units = [stated.cloud_unit] if stated.cloud_unit else cloud_units(points)
    ways_to_read = all_readings(raw, found.urdf, stated)
    units = candidate_units(ways_to_read, stated, own_units[0])
    if all(_is_profile(cloud) for cloud in points):
        way = all_interpretations(ways_to_read, pairs, units, (True,))[0]
        return _profiles_of_a_sphere(found, raw, clouds, way, stated)
    seen, of_targets = find_folder_targets(found, points, CLOUD_UNITS[own_units[0]], stated.targets)
    shown = target_motions(seen) if seen else None
    capture = capture_of(clouds, CLOUD_UNITS[own_units[0]] / MM)
    decided, scale = _decide(
        found, raw, ways_to_read, (capture, CLOUD_UNITS[own_units[0]] / MM), (pairs, units), stated, shown, every, kept
    )
    decided = _uncoupled(decided, found.urdf)
    alike = _units_of_scale(scale, decided, points, own_units[0], stated)
    if alike and alike[0] != (decided.best.interpretation.length_unit, own_units[0]):
        again = _session_of(every, replace(stated, length_unit=alike[0][0], cloud_unit=alike[0][1]))
        return replace(again, guesses=tuple(_unit_of_pairs(guess, alike, stated) for guess in again.guesses))
    require_scale(found, scale, stated)
    axis, axis_guess = guess_optical_axis(clouds)
    mount, inverted, mount_guess = choose_mounting(decided, stated.mount, stated.inverse)
    told = session_guesses(found, raw, decided, points, own_units, stated)
    told = tuple(_unit_of_pairs(guess, alike, stated) for guess in told) if len(alike) > 1 else told
    guesses = (*told, mount_guess, axis_guess, *of_targets)
    aside = _not_used(found, raw, decided, [*lost, *_coded(clouds)])
    return FirstSession(
        found, raw, own_units[0], decided, mount, inverted, guesses, axis, seen, box=stated.box, not_used=aside
    )


def _not_used(files: FolderFiles, raw: RawPoses, decided: ConventionChoice, lost: Sequence[str]) -> tuple[str, ...]:
    """Return what was read or seen and is no part of the session: lists, clouds, rows and columns, each with why."""
    pairing, layout = decided.best.interpretation.pairing, decided.best.interpretation.reading.layout
    lists = [found.words for found in files.inventory if not found.taken_for]
    listed = {file for found in files.inventory for file in found.files}
    others = [
        f"{file.name}: of another kind than {files.clouds[0].name}" for file in files.unused if file not in listed
    ]
    unposed = [f"{files.clouds[i].name}: no pose for it" for i, row in enumerate(pairing.rows) if row is None]
    rows = [_row_words(raw, row) for row in range(len(raw.numbers)) if row not in pairing.rows]
    kept = covariate_columns(layout, range(len(raw.numbers)), raw.time_s)
    columns = [f"column {name}: counts or runs backwards" for name in layout.rest if not kept_column(name, kept)]
    return (*lost, *unposed, *lists, *others, *rows, *columns)


def _row_words(raw: RawPoses, row: int) -> str:
    """A row of a table by its number and its texts."""
    why = "without a pose" if row in raw.without_pose else "no cloud for it"
    label = f" ({', '.join(raw.labels[row])})" if raw.labels[row] else ""
    return f"row {row + 1} of {Path(raw.source).name}{label}: {why}"


def _decide(
    found: FolderFiles,
    raw: RawPoses,
    ways_to_read: Sequence[Reading],
    scans: tuple[Capture, float],
    open_: tuple[Sequence[Pairing], Sequence[str]],
    stated: StatedFolder,
    shown: RelativeScans | None,
    every: FolderFiles,
    kept: Sequence[int],
) -> tuple[ConventionChoice, float | None]:
    """Let the scans choose among the readings, and among those that the names of columns deny.

    Returns the choice, and how many times larger than the robot's motions the scans are; None where they do not say.

    Args:
        scans: made light, mm, and the unit of their files in mm.
        open_: pairings and units of length that are possible.
        shown: motions that targets show.
        every: with the clouds that show nothing, of which `kept` are the others.

    Raises:
        InputError: scans that stand still, or lie in one frame.
    """
    (capture, mm), (pairs, units) = scans, open_

    @cache
    def motions() -> RelativeScans:
        # They are dear: what stands still before the scanner is told before.
        require_no_background(found.folder, capture, mm)
        return register_scan_pairs(capture)

    def choose(among: Sequence[Reading], units: Sequence[str] = units) -> ConventionChoice:
        return choose_convention(capture, motions, among, pairs, units, stated.carries, shown)

    decided = choose(ways_to_read)
    own = next(unit for unit, metres in CLOUD_UNITS.items() if metres == mm * MM)
    if not decided.determined and not stated.length_unit and own not in units:
        # Positions near the origin look like those of a robot in a larger unit.
        in_own = choose(ways_to_read, [own])
        decided = in_own if in_own.determined else decided
    require_own_frames(found.folder, motions, decided)
    # Where names do not pair all clouds, another pairing may be the change.
    complete = len(pairs[0].used) == len(kept)
    ways = all_interpretations(ways_to_read, pairs[:1], units, (True, False)) if complete else []
    _require_one_campaign(every.clouds, capture, kept, motions, ways, decided)
    layout = decided.best.interpretation.reading.layout
    doubted = [] if layout.turntable else doubted_readings(raw, found.urdf, stated)
    if not decided.determined:
        doubted += [*mixed_readings(raw, stated), *left_handed_readings(raw, stated)]
        unit = decided.best.interpretation.length_unit
        ways = all_interpretations([*ways_to_read, *doubted], pairs, [unit], (True, False))
        scale = _scale_beyond_units(found, motions(), ways)
        if scale is not None:
            return decided, scale
    if doubted and not decided.determined:
        decided = weigh_doubts(decided, choose(doubted))
    elif doubted and not (layout.sure or stated.rotation):
        decided = weigh_doubts(decided, choose_by_surfaces(capture, doubted, decided.best.interpretation))
    return decided, None


def _scale_beyond_units(found: FolderFiles, motions: RelativeScans, ways: Sequence[Interpretation]) -> float | None:
    """Return how many times the robot's motions the scans are, where no unit says so; None where one does."""
    depth = found.clouds[0].suffix.lower() in DEPTH_SUFFIXES
    # Where counts are far too large or small the motions close less well.
    scale = fitted_scale(motions, ways, (1.0, 10.0, 0.1) if depth else (1.0,))
    if scale is None or abs(np.log(scale)) < _SCALE:
        return None
    return scale if depth or _is_between_units(scale) else None


def _require_one_campaign(
    clouds: Sequence[Path],
    capture: Capture,
    kept: Sequence[int],
    motions: Callable[[], RelativeScans],
    ways: Sequence[Interpretation],
    decided: ConventionChoice,
) -> None:
    """Refuse scans between which something changed: tool, part or base at one view, two lists of poses, two parts.

    Args:
        clouds: of the folder, of which `kept` show something.
        ways: to read the poses, should something have changed; none: that is not asked.

    Raises:
        InputError: names the views.
    """
    closes = decided.determined and (decided.best.closed is None or decided.best.closed >= MOST_CLOSED)
    apart = groups_apart(capture, decided.best) if decided.determined else None
    if ways and (apart or not closes):
        require_no_change(clouds, (capture, kept, motions()), ways, decided.best)
    if apart:
        require_one_part(clouds, apart, decided.best, kept)


def _uncoupled(decided: ConventionChoice, urdf: Path | None) -> ConventionChoice:
    way = decided.best.interpretation
    way = replace(way, reading=with_uncoupled_joints(way.reading, urdf))
    return replace(decided, best=replace(decided.best, interpretation=way))


def _units_of_scale(
    scale: float | None, decided: ConventionChoice, clouds: Sequence[Array], cloud_unit: str, stated: StatedFolder
) -> list[tuple[str, str]]:
    """Units of poses and clouds under which the motions of both are alike; none where those tried are, or nothing is.

    Args:
        scale: of the scans against the robot's motions, in the units tried; None: alike, or not known.
        cloud_unit: the one tried.
    """
    if scale is None and not decided.determined:
        return []
    way = decided.best.interpretation
    factor = CLOUD_UNITS[cloud_unit] / POSE_UNITS[way.length_unit] / (scale or 1.0)
    known = stated.length_unit or way.reading.layout.length_unit
    pairs = unit_pairs(way.reading.T[:, :3, 3], clouds, factor)
    return [pair for pair in pairs if known in (None, pair[0]) and stated.cloud_unit in (None, pair[1])]


def _unit_of_pairs(guess: Guess, alike: Sequence[tuple[str, str]], stated: StatedFolder) -> Guess:
    """A guess of a unit with the pairs of units that fit as well: a scale common to both is shown by nothing."""
    side = {"length_unit": 0, "cloud_unit": 1}.get(guess.what)
    if side is None or (stated.length_unit, stated.cloud_unit)[side]:
        return guess
    others = ", ".join(f"{pose} with clouds in {cloud}" for pose, cloud in alike[1:])
    reason = f"motions of scans and robot are alike with poses in {alike[0][0]} and clouds in {alike[0][1]}"
    reason += "; only the usual size of a cell tells it from others" if others else ""
    name = ("unit", "cloud_unit")[side]
    states, rival = ({name: pair[side]} for pair in (alike[0], alike[-1]))
    by: Because = "scans" if (stated.cloud_unit, stated.length_unit)[side] else "usual"
    return replace(
        guess, reason=reason, determined=not others, runner_up=others or None, by=by, states=states, other=rival
    )


def _is_profile(points: Array) -> bool:
    """Return True of one line of a laser: all points lie in a plane through the scanner's origin."""
    extents = np.linalg.svd(points[:: -(-len(points) // _POINTS)], compute_uv=False)
    return bool(extents[2] < _FLAT * extents[1])


def _profiles_of_a_sphere(
    files: FolderFiles, raw: RawPoses, clouds: Sequence[Cloud], way: Interpretation, stated: StatedFolder
) -> FirstSession:
    """Return the session for `stitch calibrate sphere`; profiles tell nothing of how the poses are to be read.

    Raises:
        InputError: no radius of the sphere is stated.
    """
    radii = stated.targets.balls or ()
    if len(radii) != 1:
        words = f"for profiles of one sphere state its radius in mm, stitch init {files.folder} --ball RADIUS --yes"
        raise Refusal(
            f"{files.folder}: every cloud is one profile of a laser line and shows no surface",
            Fix(words, {"ball": "RADIUS"}),
        )
    decided = ConventionChoice(ConventionScore(way, np.eye(4), np.inf, False, None), None, False, (), 0.0, 0.0)
    points = [cloud.points for cloud in clouds]
    own_units = [stated.cloud_unit] if stated.cloud_unit else cloud_units(points)
    mount, inverted, mount_guess = choose_mounting(decided, stated.mount, stated.inverse)
    axis, axis_guess = guess_optical_axis(clouds)
    sphere = Guess("sphere", f"radius {radii[0]:g} mm", "stated with --ball", True, "--ball")
    guesses = (*session_guesses(files, raw, decided, points, own_units, stated), mount_guess, axis_guess, sphere)
    return FirstSession(files, raw, own_units[0], decided, mount, inverted, guesses, axis, sphere_mm=radii[0])


def _read_table(found: FolderFiles, stated: StatedFolder) -> RawPoses:
    """Return the rows of the poses, named and completed as stated; of a recording those that belong to scans."""
    raw = _read_folder_poses(found)
    raw = raw.renamed(stated.columns) if stated.columns else raw
    raw = raw.oriented(stated.orientation) if stated.orientation else raw
    if found.urdf is not None and raw.header is not None and not stated.columns:
        raw = with_joints_of(raw, found.urdf)
    return raw if stated.rows else rows_with_scans(raw, found.clouds, found.urdf, stated)


def _read_clouds(files: Sequence[Path], box: Array) -> tuple[list[Cloud], list[int], list[str]]:
    """Return the clouds that show something, their numbers among the files, and why the others do not.

    Raises:
        InputError: fewer than three do.
    """
    clouds, kept, lost = list[Cloud](), list[int](), list[InputError]()
    for i, file in enumerate(steps("clouds", files)):
        try:
            cloud = distinct_points(read_cloud(file))
            cloud = cloud.within(box) if len(box) else cloud
            if len(cloud.points) < _FEWEST:
                raise Refusal(f"{file}: {len(cloud.points)} points show no surface", change(file, "take the scan out"))
        except InputError as error:
            lost.append(error)
            continue
        clouds.append(cloud)
        kept.append(i)
    odd = _in_another_unit([files[i] for i in kept], clouds)
    lost += odd.values()
    if lost and (len(kept) - len(odd) < _FEWEST or len(lost) > len(kept)):
        raise lost[0]
    same = [k for k in range(len(kept)) if k not in odd]
    return [clouds[k] for k in same], [kept[k] for k in same], [error.what.split("; ")[0] for error in lost]


def _in_another_unit(files: Sequence[Path], clouds: Sequence[Cloud]) -> dict[int, Refusal]:
    """Return clouds that are so many times as large and as far as the others, each with what is wrong with it."""
    spread = [(np.linalg.norm(np.std(c.points, axis=0)), np.linalg.norm(np.mean(c.points, axis=0))) for c in clouds]
    ratio = np.log(spread) - np.log(np.median(spread, axis=0)) if clouds else np.empty((0, 2))
    step = np.abs(ratio[:, None] - np.log(_UNIT_STEPS)[:, None]).max(axis=2)
    out = {}
    for k in np.flatnonzero(step.min(axis=1, initial=np.inf) < _ALIKE).tolist():
        told = f"{files[k].name}: {np.exp(ratio[k].mean()):.4g} times as large and as far as the others"
        advice = change(files[k], "export it again in the unit of the others")
        out[k] = Refusal(f"{told}: that cloud alone is in another unit", advice)
    return out


def _coded(clouds: Sequence[Cloud]) -> list[str]:
    """Return what share of the points was read as a code for nothing measured."""
    coded = sum(cloud.coded for cloud in clouds)
    share = coded / (coded + sum(cloud.count for cloud in clouds))
    codes = ", ".join(f"{code:g}" for code in sorted({code for cloud in clouds for code in cloud.codes}))
    return [f"{share:.1%} of the points, which hold {codes}: nothing was measured there"] * (coded > 0)


def _is_between_units(scale: float) -> bool:
    """True of a factor that a unit or a scale can explain; positions that count for nothing are none."""
    near = np.abs(np.log(scale) - np.log([a / b for a in CLOUD_UNITS.values() for b in POSE_UNITS.values()])).min()
    return bool(near < _SCALE or abs(np.log(scale)) < np.log(_LARGEST))


def require_scale(files: FolderFiles, scale: float | None, stated: StatedFolder) -> None:
    """Refuse scans that move as the robot does, but so many times as far.

    Raises:
        InputError: names the file or the flag that states the unit, and what to write there.
    """
    if scale is None or abs(np.log(scale)) < _SCALE:
        return
    powers = [digit * 10.0**power for digit in _ROUND for power in range(-6, 7)] + [*_INCHES]
    near = min(powers, key=lambda x: abs(np.log(scale / x)))
    factor = near if abs(scale / near - 1) < _ROUND_NEAR else float(f"{scale:.4g}")
    first = files.clouds[0]
    told = f"the clouds are {scale:.4g} times as large as the robot's motions"
    camera = lens_of(first)
    if camera is not None and camera.pitch is None:
        per_metre = (camera.units_per_metre or 1000.0) * factor
        words = f'write depth_scale = {per_metre:.6g} (counts per metre) there, as "depth_scale": {per_metre:.6g}'
        raise Refusal(
            f"{camera.source}: {told}, so a count of depth is {1000 / per_metre:.4g} mm", change(camera.source, words)
        )
    if factor in (1000.0, 0.001) and stated.length_unit:
        raise Refusal(f"--unit {stated.length_unit}: {told}", Fix("leave --unit out", {"unit": ""}))
    if factor in (1000.0, 0.001):
        raise Refusal(f"{files.folder}: {told}", state(cloud_unit="mm" if factor == 0.001 else "m"))
    words = f"multiply x, y, z of the clouds by {1 / factor:.6g}, or those of the poses by {factor:.6g}"
    raise Refusal(f"{files.folder}: {told}", change(files.folder, words))


def _read_folder_poses(files: FolderFiles) -> RawPoses:
    if files.raw is None:
        angles = angles_in_names(files.clouds)
        if angles is not None and poses_in_scans(list(files.clouds)) is None:
            labels = tuple((cloud.name,) for cloud in files.clouds)
            source = f"{files.clouds[0].name} … {files.clouds[-1].name}"
            return RawPoses(
                source, ("turntable_deg",), np.array(angles)[:, None], labels, "angles in the names of the clouds"
            )
        return header_poses(files.clouds)
    return files.raw


def capture_of(clouds: Sequence[Cloud], scale: float) -> Capture:
    """Scans made light, in mm, at no poses."""
    scaled = [Cloud(cloud.points * scale, cloud.normals) for cloud in clouds]
    views = [View(f"v{i}", cloud, np.eye(4), None, None, time_s=None, covariates={}) for i, cloud in enumerate(scaled)]
    return thin_session(bare_session(views, "eye_in_hand"), _POINTS)[1]


def bare_session(views: Sequence[View], mount: Mount) -> SessionData:
    """A session in mm of which nothing but the views is known."""
    scanner = Scanner(None, None, None, np.array([0.0, 0.0, 1.0]))
    return SessionData(
        Path(), "", "mm", mount, scanner, robot=None, sphere_radius=None, cad=None, cad_unit=None, views=tuple(views)
    )


def guess_optical_axis(clouds: Sequence[Cloud]) -> tuple[str, Guess]:
    """The side of z on which the points lie."""
    middle: Array = np.mean([np.median(c.points, axis=0) for c in clouds], axis=0)
    axis = "-z" if middle[2] < 0 and abs(middle[2]) > np.linalg.norm(middle[:2]) else "+z"
    told = abs(middle[2]) > np.linalg.norm(middle[:2])
    where = ", ".join(f"{x:.3g}" for x in middle)
    reason = f"the middle of the scans lies at ({where}) in the scanner's frame"
    return axis, Guess("optical_axis", axis, reason, bool(told), "optical_axis in session.toml", by="scans")
