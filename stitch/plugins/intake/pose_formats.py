"""Poses in the texts of robots, trackers and reconstruction programs that are no plain tables: one reader a format.

A reader returns a row for each pose, or none where the text is not of its format. Numbers are named as columns are, so
that conventions and units which a format defines are told by the names: `x [mm]`, `qx`, `j1 [deg]`.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array

PoseRow = tuple[tuple[str, ...], dict[str, float]]  # texts beside a pose, and its numbers by name

_NUMBER = r"[+-]?(?:\d+(?:\.\d*|,\d+)?|\.\d+)(?:[eE][+-]?\d+)?"
_POINTED = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_KEYED = re.compile(
    rf"(?<![\w.$])(?:([A-Za-z_]+\d)[ \t]*[\s:=][ \t]*|([A-Za-z_]+)[ \t]*[:=]?[ \t]*)({_NUMBER})"
    r"[ \t]*(mm|cm|m|deg|rad|°)?(?![\w.])"
)
_KUKA = re.compile(r"E6POS|E3POS|POS_ACT|\bFRAME\b|KUKA|<RIst\b", re.IGNORECASE)
_KUKA_AXES = re.compile(r"E6AXIS|AXIS_ACT|<AIPos\b", re.IGNORECASE)
_ELEMENT = re.compile(r"<([\w:.-]+)((?:\s+[\w:.-]+\s*=\s*[\"'][^\"'<>]*[\"'])+)\s*/?>")
_ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*[\"']([^\"'<>]*)[\"']")
_TURNS: tuple[tuple[str, ...], ...] = (
    ("qx", "qy", "qz", "qw"),
    ("q0", "q1", "q2", "q3"),
    ("q1", "q2", "q3", "q4"),
    *(("w", "p", "r"), ("a", "b", "c"), ("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("o", "a", "t"), ("u", "v", "w")),
)
_JOINTS = [tuple(f"{letter}{i}" for i in range(1, 7)) for letter in "ja"]
# Angles whose order and unit the format defines: the columns of KUKA's A, B, C and of Kawasaki's O, A, T.
_DEFINED = {("a", "b", "c"): ("azyx", "bzyx", "czyx"), ("o", "a", "t"): ("ozyz", "azyz", "tzyz")}
_EXTERNAL = [f"e{i}" for i in range(1, 7)]
_UR_NAMES = ("x [m]", "y [m]", "z [m]", "rvx [rad]", "rvy [rad]", "rvz [rad]")
# Codes of create_pose: order of the rotation by its lower bits, the direction of the transform by the two others.
_HALCON_ORDERS = {0: "gba", 2: "abg", 4: "rodriguez"}
_COORDINATE_SYSTEM, _SUBTRACTED = 1, 8
_FOUR_NUMBERS = rf"[ \t]*\[*[ \t]*{_POINTED}(?:[ \t,;]+{_POINTED}){{3}}[ \t]*\]*[,;]?[ \t]*(?:\r?\n|$)"
_BLOCK = re.compile(rf"^(?:{_FOUR_NUMBERS}){{4}}", re.MULTILINE)
_STANFORD = re.compile(r"^bmesh\s+(\S+)" + rf"\s+({_POINTED})" * 7 + r"\s*$", re.MULTILINE)


def read_pose_text(text: str) -> dict[str, tuple[list[PoseRow], str]]:
    """Return lists of poses by name, each with its format: several of XML, else one; none of plain tables."""
    if tagged := _tagged_lists(text):
        return {tag: (rows, f"elements {tag} of XML") for tag, rows in tagged.items()}
    for words, read in _FORMATS:
        rows = read(text)
        if rows:
            return {"": (rows, words)}
    return {}


def posed(T: Array, unit: str = "") -> dict[str, float]:
    """Return position and quaternion of a pose (4, 4) by name.

    Args:
        unit: of lengths, where the format defines it.
    """
    names = [*(f"{axis} [{unit}]" if unit else axis for axis in "xyz"), "qx", "qy", "qz", "qw"]
    return dict(zip(names, [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()], strict=True))


def _floats(cells: Iterable[str]) -> list[float]:
    return [float(cell.replace(",", ".")) for cell in cells]


def _list_of(count: int) -> str:
    """A pattern of so many numbers in brackets, each a group."""
    return r"\[\s*" + r"\s*,\s*".join([f"({_POINTED})"] * count) + r"\s*\]"


def _labelled(text: str, spans: Sequence[tuple[int, int]], rows: Iterable[dict[str, float]]) -> list[PoseRow]:
    """Add to each row the words with digits before it, or behind it where none stand before the first.

    Words that are the same beside all rows say nothing.
    """
    ends = [0, *(end for _, end in spans)]
    starts = [*(start for start, _ in spans), len(text)]
    # Of what stands between two poses the line of the next one, and the one above it.
    gaps = [re.findall(r"[\w.:/\\+-]*\d[\w.:/\\+-]*", text[a:b]) for a, b in zip(ends, starts, strict=True)]
    behind = bool(gaps[-1]) and not gaps[0]
    gaps = [list(dict.fromkeys(word.strip(".:") for word in gap)) for gap in (gaps[1:] if behind else gaps[:-1])]
    same = set.intersection(*map(set, gaps)) if len(gaps) > 1 else set()
    kept = [tuple(word for word in gap if word not in same) for gap in gaps]
    width = min(len(labels) for labels in kept)
    # The word next to a pose is its name: the last before it, the first behind it.
    near = [labels[:width] if behind else labels[len(labels) - width :] for labels in kept]
    return list(zip(near, rows, strict=True))


def _keyed_rows(text: str) -> list[PoseRow]:
    """Rows of numbers that stand behind their names; a pose begins where its first name comes again."""
    pairs = list(_KEYED.finditer(text))
    names = [(m[1] or m[2]).lower() for m in pairs]
    first = next((name for name in names if name in ("x", "j1", "a1")), None)
    begins = [i for i, name in enumerate(names) if name == first and first is not None]
    if not begins:
        return []
    rows, spans = [], []
    for begin, end in zip(begins, [*begins[1:], len(pairs)], strict=True):
        record: dict[str, re.Match[str]] = {}
        for name, match in zip(names[begin:end], pairs[begin:end], strict=True):
            record.setdefault(name, match)
        row = _record_numbers({name: (match[3], match[4]) for name, match in record.items()}, text)
        if row is not None:
            rows.append(row)
            spans.append((pairs[begin].start(), pairs[end - 1].end()))
    alike = {name for name in rows[0] if all(name in row for row in rows)} if rows else set()
    still = {name for name in alike if name in _EXTERNAL and len({row[name] for row in rows}) == 1}
    rows = [{name: x for name, x in row.items() if name in alike - still} for row in rows]
    return _labelled(text, spans, rows) if rows else []


def _record_numbers(record: dict[str, tuple[str, str | None]], text: str) -> dict[str, float] | None:
    """Return the numbers of one pose, with units in their names; None where it has neither pose nor joint angles.

    Args:
        record: number and unit by name.
    """
    value = {name: float(number.replace(",", ".")) for name, (number, _) in record.items()}
    turn = next((turn for turn in _TURNS if all(name in value for name in turn)), None)
    joints = next((j for j in _JOINTS if all(name in value for name in j)), None)
    out: dict[str, float] = {}
    if turn is not None and all(axis in value for axis in "xyz"):
        if turn in _DEFINED and (turn == ("o", "a", "t") or _KUKA.search(text)):
            names = [*(f"{axis} [mm]" for axis in "xyz"), *(f"{name} [deg]" for name in _DEFINED[turn])]
        else:
            units = [(record[name][1] or "").replace("°", "deg") for name in (*"xyz", *turn)]
            names = [f"{name} [{unit}]" if unit else name for name, unit in zip((*"xyz", *turn), units, strict=True)]
        out = dict(zip(names, [value[name] for name in (*"xyz", *turn)], strict=True))
    if joints is not None:
        unit = "deg" if _KUKA_AXES.search(text) else record[joints[0]][1]
        out |= {f"j{i} [{unit}]" if unit else f"j{i}": value[name] for i, name in enumerate(joints, 1)}
    return out | {name: value[name] for name in _EXTERNAL if name in value} if out else None


def _tagged_lists(text: str) -> dict[str, list[PoseRow]]:
    """Return rows by the element of XML whose attributes hold them: RIst, RSol and AIPos of KUKA's RSI."""
    out: dict[str, list[PoseRow]] = {}
    for tag, attributes in _ELEMENT.findall(text) if text.lstrip().startswith("<") else ():
        cells = {name.lower(): cell for name, cell in _ATTRIBUTE.findall(attributes)}
        numbers = {name: cell for name, cell in cells.items() if re.fullmatch(_NUMBER, cell)}
        row = _record_numbers({name: (cell, None) for name, cell in numbers.items()}, text)
        if row is not None:
            out.setdefault(tag, []).append((tuple(cell for n, cell in cells.items() if n not in numbers), row))
    return out


_ROBTARGET = re.compile(rf"\[\s*{_list_of(3)}\s*,\s*{_list_of(4)}(?:\s*,\s*\[[^\]]*\])*\s*\]?")
_UR_POSE = re.compile(rf"(?<!\w)p\s*{_list_of(6)}")
_TF_ECHO = re.compile(rf"Translation:\s*{_list_of(3)}.*?Quaternion[^\[]*{_list_of(4)}", re.DOTALL)


def _tf_echo_rows(text: str) -> list[PoseRow]:
    rows = _matched_rows(_TF_ECHO, ("x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"), text)
    times = _floats(re.findall(rf"At time ({_POINTED})", text))
    if len(times) == len(rows):
        return [((), {"time_s": time} | numbers) for time, (_, numbers) in zip(times, rows, strict=True)]
    return [((), numbers) for _, numbers in rows]


def _matched_rows(pattern: re.Pattern[str], names: Sequence[str], text: str) -> list[PoseRow]:
    found = list(pattern.finditer(text))
    rows = [dict(zip(names, _floats(m.groups()), strict=True)) for m in found]
    return _labelled(text, [m.span() for m in found], rows) if found else []


def _halcon_rows(text: str) -> list[PoseRow]:
    lines = {words[0]: words[1:] for line in text.splitlines() if (words := line.split())}
    try:
        code, angles, shift = int(lines["f"][0]), _floats(lines["r"]), np.array(_floats(lines["t"]))
    except (KeyError, ValueError, IndexError):
        return []
    order = _HALCON_ORDERS.get(code & ~(_COORDINATE_SYSTEM | _SUBTRACTED))
    if order is None or len(angles) != 3 or len(shift) != 3:
        return []
    if order == "rodriguez":
        # A vector along the axis, tan(angle / 2) long.
        length = float(np.linalg.norm(angles))
        R = Rotation.from_rotvec(np.array(angles) * (2 * np.arctan(length) / length if length else 0.0)).as_matrix()
    else:
        R = Rotation.from_euler("XYZ" if order == "gba" else "xyz", angles, degrees=True).as_matrix()
    T = frames.make(R, -R @ shift if code & _SUBTRACTED else shift)
    return [((), posed(frames.inverse(T) if code & _COORDINATE_SYSTEM else T, "m"))]


def _matrix_rows(text: str) -> list[PoseRow]:
    """Rows of 4×4 matrices over four lines each, with words or other numbers before each: Open3D's trajectory.log."""
    blocks = list(_BLOCK.finditer(text))
    T = np.array([_floats(re.findall(_POINTED, block[0])) for block in blocks]).reshape(-1, 4, 4)
    words = _BLOCK.sub("", text).strip()
    # A plain table of matrices is read as one: a matrix of it without a number is a view without a pose.
    if not len(T) or not np.allclose(T[:, 3], [0, 0, 0, 1]) or not words or re.search("nan|inf|null", words, re.I):
        return []
    return _labelled(text, [block.span() for block in blocks], [_matrix_row(M) for M in T])


def _colmap_rows(text: str) -> list[PoseRow]:
    """Rows of COLMAP's images.txt, which holds T_camera_world; every other line lists points of the image."""
    lines = [line.split() for line in text.splitlines() if not line.startswith("#")]
    rows: list[PoseRow] = []
    for words in lines[::2]:
        try:
            w, x, y, z, *shift = _floats(words[1:8])
            int(words[0]), int(words[8]), words[9]
        except (ValueError, IndexError):
            if words:
                return []
            continue
        T = frames.make(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(shift))
        rows.append(((" ".join(words[9:]),), posed(frames.inverse(T))))
    return rows


def _stanford_rows(text: str) -> list[PoseRow]:
    """Rows of the .conf of Stanford's range scans; its quaternion turns from the common frame into the scan's."""
    rows = ((m[1], np.array(_floats(m.groups()[1:]))) for m in _STANFORD.finditer(text))
    return [((name,), posed(frames.make(Rotation.from_quat(x[3:]).inv().as_matrix(), x[:3]))) for name, x in rows]


def open3d_rows(document: Any) -> list[PoseRow] | None:
    """Return the nodes of Open3D's PoseGraph, or the cameras of a PinholeCameraTrajectory; None of others."""
    kind = document.get("class_name") if isinstance(document, dict) else None
    if kind == "PoseGraph":
        matrices = [node["pose"] for node in document.get("nodes", [])]
    elif kind == "PinholeCameraTrajectory":
        matrices = [camera["extrinsic"] for camera in document.get("parameters", [])]
    else:
        return None
    T = np.array(matrices, float).reshape(-1, 4, 4).transpose(0, 2, 1)  # by columns
    T = frames.inverse(T) if kind == "PinholeCameraTrajectory" else T
    return [((str(i),), _matrix_row(M)) for i, M in enumerate(T)]


def _matrix_row(T: Array) -> dict[str, float]:
    return {str(i): float(x) for i, x in enumerate(np.ravel(T))}


def joint_state_rows(documents: Any) -> list[PoseRow] | None:
    """Return the positions of sensor_msgs/JointState by the names of their joints; None of other documents."""
    states = documents if isinstance(documents, list) else [documents]
    rows: list[PoseRow] = []
    for state in states:
        names, angles = (state.get(key) if isinstance(state, dict) else None for key in ("name", "position"))
        if not (isinstance(names, list) and isinstance(angles, list) and len(names) == len(angles) > 0):
            return None
        if not all(isinstance(angle, (int, float)) for angle in angles):
            return None
        rows.append(((), {f"{name} [rad]": float(q) for name, q in zip(names, angles, strict=True)}))
    return rows or None


# By what only they have; names with numbers behind them come last, as logs hold many.
_FORMATS: tuple[tuple[str, Callable[[str], list[PoseRow]]], ...] = (
    ("a pose file of HALCON", _halcon_rows),
    ("4×4 matrices with words between", _matrix_rows),
    ("images of COLMAP, inverted to T_world_camera", _colmap_rows),
    ("alignment of Stanford's range scans", _stanford_rows),
    ("tf_echo of ROS", _tf_echo_rows),
    ("robtargets of ABB", partial(_matched_rows, _ROBTARGET, ("x [mm]", "y [mm]", "z [mm]", "qw", "qx", "qy", "qz"))),
    ("poses p[…] of Universal Robots", partial(_matched_rows, _UR_POSE, _UR_NAMES)),
    ("numbers behind their names", _keyed_rows),
)
