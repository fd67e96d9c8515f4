"""session.toml with every guess as a comment beside its reason, and views.csv; written both or not at all."""

import os
import re
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.session_files import pose_columns, table_text
from stitch.plugins.intake.first_session import FirstSession
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.layouts import CLOUD_UNITS, MM, POSE_UNITS, covariate_columns
from stitch.plugins.intake.readings import JOINT_ANGLES, Reading, arm_links
from stitch.plugins.intake.refusals import Fix, Refusal
from stitch.plugins.intake.scan_targets import points_columns
from stitch.session.reading.session_toml import SESSION_FORMAT
from stitch.system.files import whole_file

_WIDTH = 118


def require_free(folder: Path, names: Iterable[str]) -> None:
    """Refuse a folder that holds one of these files already.

    Raises:
        InputError: with what to do.
    """
    for name in names:
        if (folder / name).exists() or (folder / name).is_symlink():
            raise Refusal(
                f"{folder / name}: exists already",
                Fix("replace it with --force", {"force": "yes"}),
                Fix("name another folder with -o", {"output": "OUT"}),
            )


def draft_files(targets: bool) -> tuple[str, ...]:
    """The files that `write_draft` writes; points.csv where targets are looked for."""
    return ("session.toml", "views.csv", *(["points.csv"] if targets else []))


def write_draft(folder: Path, first: FirstSession, *, force: bool = False, unpacked: bool = False) -> None:
    """Write both files into a folder, which is made where it does not exist.

    Args:
        force: replace those that are there.
        unpacked: the clouds lie in a passing folder, and move into the session's.

    Raises:
        InputError: there is a session already.
    """
    if not force:
        require_free(folder, draft_files(bool(first.sightings)))
    if unpacked:
        (folder / "clouds").mkdir(parents=True, exist_ok=True)
        moved = [Path(shutil.copy(cloud, folder / "clouds")) for cloud in first.files.clouds]
        first = replace(first, files=replace(first.files, clouds=tuple(moved), folder=folder))
    points = {"points.csv": table_text(_points_table(first))} if first.sightings else {}
    write_texts(folder, {"views.csv": views_text(folder, first), "session.toml": toml_text(folder, first), **points})


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files by name into a folder, which is made where it does not exist; all or none."""
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as files:
        for name, text in texts.items():
            files.enter_context(whole_file(folder / name)).write_text(text, encoding="utf-8")


def _points_table(first: FirstSession) -> dict[str, list[object]]:
    """points.csv of the views that have a pose, in the session's length_unit."""
    used = _clouds_in_order(first)
    names = _view_names([first.files.clouds[i] for i in used], first.files.folder)
    scale = MM / METRES[length_unit(first)]
    return points_columns(names, [first.sightings[i] for i in used], scale)


def length_unit(first: FirstSession) -> str:
    """The session's: that of the poses, mm where it has no other."""
    unit = first.choice.best.interpretation.length_unit
    return unit if unit in METRES else "mm"


def toml_text(folder: Path, first: FirstSession) -> str:
    """session.toml."""
    told = {guess.what: guess for guess in first.guesses}
    lines = [f'format = "{SESSION_FORMAT}"', f'name = "{session_name(first.files.folder)}"']
    lines += ["", "# What follows as a comment alone was read so into views.csv. To read it otherwise:"]
    own = first.files.folder
    into = "" if folder.resolve() == own.resolve() else f" -o {shlex.quote(str(folder))}"
    lines += [f"# stitch init {shlex.quote(str(own))}{into} --force, with the flag that is named beside it."]
    for what in ("files", "pairing", "columns", "rotation"):
        lines += ["", *comment_lines(told[what], with_flag=True)]
    unit = length_unit(first)
    lines += ["", *comment_lines(told["length_unit"]), f'length_unit = "{unit}"']
    lines += ["", *comment_lines(told["cloud_unit"]), f'cloud_unit = "{first.cloud_unit}"']
    lines += ["", *comment_lines(told["mount"]), f'mount = "{first.mount}"']
    lines += ["", "[scanner]", *comment_lines(told["optical_axis"]), f'optical_axis = "{first.optical_axis}"']
    if len(first.box):
        corners = (first.box * CLOUD_UNITS[first.cloud_unit] / METRES[unit]).tolist()
        lines += ["", "# stated with --within: what lies beyond stands still before the scanner", f"within = {corners}"]
    if first.sphere_mm is not None:
        lines += ["", "[sphere]", f"radius = {first.sphere_mm * MM / METRES[unit]:.9g}"]
    lines += axis_lines(first)
    if robot := robot_lines(folder, first.files.urdf, first.choice.best.interpretation.reading):
        lines += ["", *robot]
    return "\n".join(lines) + "\n"


def comment_lines(guess: Guess, with_flag: bool = False) -> list[str]:
    """Return a guess in lines that begin with #."""
    flag = f" ({guess.flag})" if with_flag and guess.determined else ""
    words, lines = f"{guess.line}{flag}".split(), [""]
    for word in words:
        if len(lines[-1]) + len(word) + 1 > _WIDTH - 2:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return [f"# {'  ' * bool(i)}{line}" for i, line in enumerate(lines)]


def robot_lines(folder: Path, urdf: Path | None, reading: Reading) -> list[str]:
    """Return the table [robot] of session.toml, in lines; none without joints or a URDF."""
    joints = reading.layout.joints
    if joints is None or urdf is None:
        return []
    path = Path(os.path.relpath(urdf, folder)).as_posix()
    base, flange = arm_links(urdf, joints.shape[1])
    return ["[robot]", f'urdf = "{path}"', f'base_link = "{base}"', f'flange_link = "{flange}"']


def session_name(folder: Path) -> str:
    """A name for the session that can be that of its run."""
    return re.sub(r"[^\w+-]+", "-", folder.resolve().name).strip("-") or "session"


def views_text(folder: Path, first: FirstSession) -> str:
    """views.csv: a row for every cloud that has a pose."""
    used = _clouds_in_order(first)
    clouds = [first.files.clouds[i] for i in used]
    rows = [int(first.pairing.rows[i] or 0) for i in used]
    columns: dict[str, list[str]] = {
        "view": _view_names(clouds, first.files.folder),
        "cloud": [Path(os.path.relpath(cloud, folder)).as_posix() for cloud in clouds],
    }
    reading = first.choice.best.interpretation.reading
    columns |= joint_columns(reading, rows)
    if reading.rotation != JOINT_ANGLES and not reading.layout.turntable:
        columns |= {
            name: [f"{x:.9g}" for x in values] for name, values in pose_columns(_flange_poses(first, rows)).items()
        }
    axis = _axis_column(first, rows)
    beside = covariate_columns(reading.layout, rows, first.raw.time_s)
    return table_text(columns | axis | {k: v for k, v in beside.items() if v not in axis.values()})


def axis_lines(first: FirstSession) -> list[str]:
    """Return the table [[axis]] of session.toml, in lines: a turntable whose place the scans show, or a rail."""
    reading = first.choice.best.interpretation.reading
    if reading.layout.turntable:
        return ["", "[[axis]]", 'name = "turntable"', 'kind = "rotary"', 'carries = "part"']
    if reading.axis is None:
        return []
    column, along, sign = reading.axis
    direction = [0.0, 0.0, 0.0]
    direction[along] = sign
    lines = ["", "[[axis]]", f'name = "{_axis_name(column)}"', 'kind = "linear"', 'carries = "robot"']
    return [*lines, f"direction = {direction}"]


def _axis_name(column: str) -> str:
    """A name for session.toml from that of a column: E1, rail of rail_mm."""
    letters = re.sub(r"[^A-Za-z0-9]+", "_", re.sub(r"[_ (\[]*(mm|m)[)\]]*$", "", column)).strip("_")
    return letters if letters[:1].isalpha() else "axis"


def _axis_column(first: FirstSession, rows: list[int]) -> dict[str, list[str]]:
    """The readings of an external axis as session.toml asks for them; none without one."""
    way = first.choice.best.interpretation
    reading = way.reading
    if reading.layout.turntable:
        T = reading.T[rows]
        return {"turntable_deg": [f"{x % 360:.9g}" for x in np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))]}
    if reading.axis is None:
        return {}
    values = np.asarray(reading.layout.rest[reading.axis[0]])[rows] * _scale_of_poses(first)
    return {f"{_axis_name(reading.axis[0])}_{length_unit(first)}": [f"{x:.9g}" for x in values]}


def _scale_of_poses(first: FirstSession) -> float:
    return POSE_UNITS[first.choice.best.interpretation.length_unit] / METRES[length_unit(first)]


def _clouds_in_order(first: FirstSession) -> tuple[int, ...]:
    """Clouds that have a pose, in the order of time: a table that names its clouds was written as the robot went."""
    pairing = first.pairing
    return tuple(sorted(pairing.used, key=lambda i: pairing.rows[i] or 0)) if pairing.by_name else pairing.used


def _flange_poses(first: FirstSession, rows: list[int]) -> Array:
    """T_base_flange (V, 4, 4) in the session's length_unit."""
    way = first.choice.best.interpretation
    T = way.reading.T[rows]
    if way.reading.axis is not None:
        # The axis stands beside the poses, as the controller reports them.
        column, along, sign = way.reading.axis
        T = T.copy()
        T[:, along, 3] -= sign * np.asarray(way.reading.layout.rest[column])[rows]
    scale = _scale_of_poses(first)
    T = frames.make(T[:, :3, :3], T[:, :3, 3] * scale)
    return frames.inverse(T) if first.inverted else T


def joint_columns(reading: Reading, rows: Sequence[int]) -> dict[str, list[str]]:
    """Columns j1_deg, j2_deg … of views.csv for some rows; none of a reading without joints."""
    joints = reading.layout.joints
    if joints is None:
        return {}
    in_radians = reading.angle_unit == "rad" if reading.rotation == JOINT_ANGLES else np.abs(joints).max() <= 2 * np.pi
    degrees = (np.degrees(joints) if in_radians else joints)[list(rows)]
    return {f"j{i}_deg": [f"{q:.9g}" for q in column] for i, column in enumerate(degrees.T, 1)}


def _view_names(clouds: list[Path], folder: Path) -> list[str]:
    """Names of views: those of the clouds' files, with their folders where two are called alike."""
    stems = [cloud.stem for cloud in clouds]
    if len(set(stems)) == len(stems):
        return stems
    return [cloud.relative_to(folder).with_suffix("").as_posix().replace("/", "-") for cloud in clouds]
