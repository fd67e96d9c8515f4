"""A hand-eye as the text of each format, with what it means and its U (k = 2) in comments."""

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from stitch.effects.axis_effects import PLACEMENT
from stitch.errors import InputError
from stitch.model.model import COVERAGE_FACTOR, uncertainty_scope
from stitch.model.model_toml import ModelFile, read_model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES, length_text
from stitch.output.stored_run import read_diagnosis, read_result
from stitch.output.urdf_file import roll_pitch_yaw, xml_comment
from stitch.plugins.intake.controllers.taught_points import NUMBERS, fixed_xyz_numbers, quaternion_w_first_numbers
from stitch.session.axes import Axis
from stitch.system.packages import stitch_version

# Of a twist, for central differences: far above rounding, far below the bend of any angle.
_STEP = 1e-6
_PARENTS = {"eye_to_hand": "base_link", "eye_in_hand": "flange"}
_PARENT_WORDS = {"eye_to_hand": "base", "eye_in_hand": "flange"}
# Characters that a frame's name may have in every format: those of a link in URDF and of a name in YAML.
_PLAIN_LETTERS = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_")
_DEGREES = ("mm", "mm", "mm", "°", "°", "°")
_QUATERNION = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class ExportedHandEye:
    """A hand-eye with the names that other programs need."""

    session: str
    T_mount: Array  # (4, 4) T_parent_child, m
    covariance: Array  # (6, 6) of T·exp(ξ), scanner frame, rotation first; rad and m
    length_unit: str  # of the session
    mount: str  # eye_to_hand | eye_in_hand
    parent: str  # frame that carries the scanner, as other programs call it
    child: str  # the scanner's own frame
    notes: tuple[str, ...]  # plain sentences: what was not observable, what the numbers do not hold
    of_effects: str = ""  # the one of them that says what of the effects the numbers hold
    axes: tuple[tuple[str, Array], ...] = ()  # name and T_base_axis (4, 4), m, z along the axis

    @property
    def name(self) -> str:
        """T_base_scanner or T_flange_scanner."""
        return f"T_{_PARENT_WORDS[self.mount]}_scanner"

    def head(self, numbers: Callable[[Array], Array], labels: Sequence[str], units: Sequence[str]) -> list[str]:
        """Return lines for comments: what it is, U (k = 2) of each number that the format states, and the notes.

        Args:
            numbers: what the format writes of T_parent_child in m, (n,).
            labels: their names, (n,).
            units: their units, (n,).
        """
        sigma = np.sqrt(np.diag(_numbers_covariance(numbers, self.T_mount, self.covariance)))
        sizes = zip(labels, COVERAGE_FACTOR * sigma, units, strict=True)
        U = [f"{label} {size:.2g} {unit}".rstrip() for label, size, unit in sizes]
        return [
            f"{self.name} of session {self.session}: maps coordinates of {self.child} into {self.parent}; "
            f"stitch {stitch_version()}",
            f"U (k = 2), in the frame {self.parent}: {', '.join(U)}",
            *self.notes,
        ]

    def lengths(self, unit: str) -> Array:
        """Return (4, 4) T_parent_child with lengths in "mm" or "m"."""
        T = self.T_mount.copy()
        T[:3, 3] /= METRES[unit]
        return T


def _numbers_covariance(numbers: Callable[[Array], Array], T_mount: Array, covariance: Array) -> Array:
    """Return the covariance (n, n) of the numbers by which a controller states a hand-eye, to first order.

    Args:
        numbers: function of a pose (4, 4) that returns those numbers (n,), continuous near T_mount.
        T_mount: (4, 4) T_mount_scanner.
        covariance: (6, 6) of the right perturbation, rotation first.
    """
    steps = _STEP * np.eye(6)
    J = [(numbers(T_mount @ frames.exp(e)) - numbers(T_mount @ frames.exp(-e))) / (2 * _STEP) for e in steps]
    return np.transpose(J) @ covariance @ np.array(J)


def hand_eye_of_run(
    folder: Path,
    parent: str | None = None,
    child: str | None = None,
    with_effects: bool = False,
    scanner: str | None = None,
) -> ExportedHandEye:
    """Return the corrected hand-eye of a run folder.

    Args:
        parent, child: of `hand_eye_from`.
        with_effects: of `hand_eye_from`.
        scanner: name of one of several.

    Raises:
        InputError: no run, a damaged one, a name that a frame cannot have, or several scanners of which none is named.
    """
    result = read_result(folder)
    session = session_of_scanner(result, scanner)
    own = folder / session if session else folder
    model = read_model(own)
    if model.mount not in _PARENTS:
        raise InputError(f"{own}/model.toml: mount is {model.mount!r}; to fix: eye_to_hand or eye_in_hand")
    result = read_result(own) if session else result
    return hand_eye_from(result, model, read_diagnosis(folder), parent, child or scanner, with_effects)


def session_of_scanner(result: dict[str, Any], scanner: str | None) -> str:
    """Return the name of the session of one of several scanners; "" where there is one.

    Raises:
        InputError: none of several is named, or one that is not among them.
    """
    sessions = {row["scanner"]: row["session"] for row in result.get("scanners", ())}
    if scanner is None and not sessions:
        return ""
    if scanner not in sessions:
        raise InputError(
            f"{result['name']}: which scanner? to fix: --scanner {' or '.join(sessions)}"
            if sessions
            else f"--scanner {scanner}: {result['name']} is of one scanner; to fix: leave --scanner away"
        )
    return str(sessions[scanner])


def hand_eye_from(
    result: dict[str, Any],
    model: ModelFile,
    diagnosis: dict[str, Any],
    parent: str | None = None,
    child: str | None = None,
    with_effects: bool = False,
) -> ExportedHandEye:
    """Return the corrected hand-eye of a result and its model: at the mean of its effects over the views, unless asked
    for the one that goes with them.

    Args:
        result: as result.json.
        diagnosis: as diagnosis.json; {} where there is none.
        with_effects: for a program that corrects the effects itself.
        parent: name of the frame that carries the scanner; default base_link (eye_to_hand) or flange (eye_in_hand).
        child: name of the scanner's frame; default its name among several, else scanner.

    Raises:
        InputError: a name that a frame cannot have, or numbers that the views do not show and nobody states.
    """
    session = str(result.get("name") or Path(result["session"]).name)
    _require_hand_eye(result, session)
    metres = METRES[model.length_unit]
    scale = np.repeat([1.0, metres], 3)
    alone = None if with_effects else result.get("hand_eye_alone")
    T = np.array(alone["hand_eye"]) if alone else model.T_mount.copy()
    covariance = np.array(alone["covariance"]) if alone else model.covariance
    T[:3, 3] *= metres
    of_effects = _effects_note(alone, [name for name in model.effects if name != PLACEMENT], model.length_unit)
    axes = result.get("axes", ())
    notes = [
        *_uncertainty_notes(result, diagnosis, model.length_unit),
        *(_axis_note(axis, model.length_unit) for axis in axes),
    ]
    return ExportedHandEye(
        session=session,
        T_mount=T,
        covariance=covariance * np.outer(scale, scale),
        length_unit=model.length_unit,
        mount=model.mount,
        parent=_require_plain_name("--parent", parent or _PARENTS[model.mount]),
        child=_require_plain_name("--child", child or "scanner"),
        notes=(*notes, of_effects) if of_effects else tuple(notes),
        of_effects=of_effects,
        axes=tuple((axis["name"], _axis_frame(axis, metres)) for axis in axes),
    )


def _require_hand_eye(result: dict[str, Any], session: str) -> None:
    """Refuse a result without a hand-eye, or one of which numbers are neither shown nor stated.

    Raises:
        InputError: says which, and what to do.
    """
    unknown = result.get("hand_eye_unknown", [])
    if result.get("reference_frame") not in (None, "base", "flange"):
        raise InputError(
            f"{session}: without a robot there is no hand-eye; to fix: take the axes from result.json, their place in "
            "the scanner's frame"
        )
    if unknown and not result.get("hand_eye_stated"):
        raise InputError(
            f"{session}: these views do not show {', '.join(unknown)} of the hand-eye; to fix: add views turned about "
            "other axes, or state [scanner] pose in session.toml"
        )


def _uncertainty_notes(result: dict[str, Any], diagnosis: dict[str, Any], length_unit: str) -> list[str]:
    """Return sentences on what U holds, what it does not, and numbers that were not measured."""
    notes = [uncertainty_scope(diagnosis.get("verdict")).rstrip(".")]
    candidates = diagnosis.get("candidates", [])
    missed = [(c["hand_eye_if_missed"], c["effect"]) for c in candidates if c.get("hand_eye_if_missed") is not None]
    if missed:
        # U is that of the model.
        size, name = max(missed)
        pushed = length_text(size, length_unit, 2)
        notes.append(
            f"Not in U: an effect too small to be seen could displace it, at the part, by as much as {pushed} ({name})"
        )
    notes += [f"Not observable from these motions, left at the coarse value: {axis}" for axis in result["unobservable"]]
    if unknown := result.get("hand_eye_unknown"):
        notes.append(f"As stated in session.toml, not measured: {', '.join(unknown)}")
    return notes


def _effects_note(alone: dict[str, Any] | None, effects: Sequence[str], length_unit: str) -> str:
    """Return what of the effects the numbers hold; "" without effects.

    Args:
        alone: the hand-eye at the mean of the effects over the views, as result.json has it; None: another is exported.
    """
    if alone:
        off, spread = (length_text(alone[key], length_unit, 2) for key in ("displacement", "spread"))
        return (
            f"At the mean of {', '.join(effects)} over these views: without these effects the model's hand-eye "
            f"is off by {off} at the part. Single views differ by {spread} (rms), which U holds"
        )
    return f"Not in these numbers, as they are one rigid motion: {', '.join(effects)}" if effects else ""


def _axis_note(axis: dict[str, Any], length_unit: str) -> str:
    """Return where an external axis stands, in the base, as comments say it."""
    direction = ", ".join(f"{x:.6f}" for x in axis["direction"])
    to_mm = METRES[length_unit] * 1e3
    point = "" if "point" not in axis else f" through ({', '.join(f'{to_mm * x:.3f}' for x in axis['point'])}) mm"
    return f"Axis {axis['name']}, in the base: {axis['kind']}, along ({direction}){point}"


def _axis_frame(axis: dict[str, Any], metres: float) -> Array:
    point = None if "point" not in axis else metres * np.array(axis["point"])
    return Axis(axis["name"], axis["kind"], "part", np.array(axis["direction"]), point).frame


def _require_plain_name(flag: str, name: str) -> str:
    if not name or not set(name) <= _PLAIN_LETTERS or name[0].isdigit():
        raise InputError(f"{flag} {name!r}: to fix: a name of letters, digits and _, as links in URDF have it")
    return name


@dataclass(frozen=True)
class ControllerFrame:
    """How one controller writes a frame."""

    labels: tuple[str, ...]
    units: tuple[str, ...]
    comment: str  # begins a line of comment
    template: str  # {name} and the numbers by position
    place: dict[str, str]  # mount → where it is entered
    axis: str = "a feature of the installation"  # where the frame of an external axis is entered


_CONTROLLERS = {
    "kuka": ControllerFrame(
        tuple("XYZABC"),
        _DEGREES,
        "; ",
        "DECL FRAME {name}={{X {0},Y {1},Z {2},A {3},B {4},C {5}}}",
        {"eye_in_hand": "TOOL_DATA", "eye_to_hand": "BASE_DATA"},
        "root point of the external kinematic, E1 …",
    ),
    "fanuc": ControllerFrame(
        tuple("XYZWPR"),
        _DEGREES,
        "! ",
        "{name}:\nX = {0} mm, Y = {1} mm, Z = {2} mm,\nW = {3} deg, P = {4} deg, R = {5} deg",
        {"eye_in_hand": "UTOOL", "eye_to_hand": "UFRAME"},
        "extended axis, or frame of the positioner's group",
    ),
    "abb": ControllerFrame(
        ("x", "y", "z", "q1", "q2", "q3", "q4"),
        ("mm", "mm", "mm", "", "", "", ""),
        "! ",
        "PERS pose {name}:=[[{0},{1},{2}],[{3},{4},{5},{6}]];",
        {"eye_in_hand": "tframe of a tooldata", "eye_to_hand": "uframe of a wobjdata"},
        "base frame of the mechanical unit",
    ),
    "ur": ControllerFrame(
        ("x", "y", "z", "rx", "ry", "rz"),
        ("m", "m", "m", "rad", "rad", "rad"),
        "# ",
        "{name} = p[{0}, {1}, {2}, {3}, {4}, {5}]",
        {"eye_in_hand": "TCP", "eye_to_hand": "plane feature"},
    ),
}


def controller_frame(eye: ExportedHandEye, controller: str) -> str:
    """Return the frame as a controller writes it, by "kuka", "fanuc", "abb" or "ur"."""
    form, near = _CONTROLLERS[controller], _frame_numbers(eye.T_mount, controller)
    head = eye.head(lambda T: _frame_numbers(T, controller, near), form.labels, form.units)
    lines = [*head, f"Entered as {form.place[eye.mount]}, in the controller's own base and flange"]
    text = form.template.format(*(f"{x + 0.0:.9f}" for x in near), name=eye.name)
    for name, T in eye.axes:
        text += f"\n{commented(form.comment, [f'Axis {name}, z along it: {form.axis}'])}"
        text += form.template.format(*(f"{x + 0.0:.9f}" for x in _frame_numbers(T, controller)), name=f"T_base_{name}")
    return f"{commented(form.comment, lines)}{text}\n"


def _frame_numbers(T: Array, controller: str, near: Array | None = None) -> Array:
    """Of a pose (4, 4) in m; the controllers' functions take mm."""
    T = T.copy()
    T[:3, 3] *= 1000
    return NUMBERS[controller](T, near)


def ros_yaml(eye: ExportedHandEye) -> str:
    """Return a launch file of ROS 2 in YAML that publishes the transform: what MoveIt's own calibration saves."""
    numbers = zip(_QUATERNION, _pose_quaternion(eye.T_mount).tolist(), strict=True)
    flags = " ".join(f"--{key} {row([x])}" for key, x in numbers)
    return (
        f"{commented('# ', _quaternion_head(eye))}launch:\n  - node:\n      pkg: tf2_ros\n"
        f"      exec: static_transform_publisher\n      name: {eye.parent}_to_{eye.child}\n      output: log\n"
        f'      args: "--frame-id {eye.parent} --child-frame-id {eye.child} {flags}"\n'
    )


def ros_launch(eye: ExportedHandEye) -> str:
    """Return the same as a launch file of ROS 1."""
    args = f"{row(_pose_quaternion(eye.T_mount))} {eye.parent} {eye.child}"
    return (
        f"{xml_comment(_quaternion_head(eye))}<launch>\n"
        f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{eye.parent}_to_{eye.child}"\n'
        f"        args={quoteattr(args)} />\n</launch>\n"
    )


def urdf(eye: ExportedHandEye) -> str:
    """Return a link and a fixed joint, to be included in the robot's URDF; m and rad."""
    near = _roll_pitch_yaw(eye.T_mount)
    labels, units = ("x", "y", "z", "roll", "pitch", "yaw"), ("m",) * 3 + ("rad",) * 3
    head = xml_comment(eye.head(lambda T: _roll_pitch_yaw(T, near), labels, units))
    root = ElementTree.Element("robot", name=eye.child)
    ElementTree.SubElement(root, "link", name=eye.child)
    joint = ElementTree.SubElement(root, "joint", name=f"{eye.parent}_to_{eye.child}", type="fixed")
    ElementTree.SubElement(joint, "parent", link=eye.parent)
    ElementTree.SubElement(joint, "child", link=eye.child)
    rpy = roll_pitch_yaw(eye.T_mount[:3, :3])
    ElementTree.SubElement(joint, "origin", xyz=row(eye.T_mount[:3, 3]), rpy=row(rpy))
    ElementTree.indent(root)
    return f"{head}{ElementTree.tostring(root, encoding='unicode')}\n"


def opencv(eye: ExportedHandEye) -> str:
    """Return YAML of cv::FileStorage: the matrix and its covariance in the session's length_unit."""
    unit = eye.length_unit
    scale = np.repeat([1.0, 1 / METRES[unit]], 3)
    facts = {"session": eye.session, "parent": eye.parent, "child": eye.child, "length_unit": unit}
    return (
        f"%YAML:1.0\n---\n{commented('# ', _matrix_head(eye, unit))}"
        + "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in facts.items())
        + _cv_matrix(eye.name, eye.lengths(unit))
        + "# Of a right perturbation T·exp(ξ) in the scanner's frame: rotation in rad, then translation\n"
        + _cv_matrix("covariance", eye.covariance * np.outer(scale, scale))
    )


def zivid(eye: ExportedHandEye) -> str:
    """Return YAML as Zivid's SDK saves a Matrix4x4; mm."""
    rows = ",\n".join(f"      [{row(line, ', ')}]" for line in eye.lengths("mm"))
    head = commented("# ", _matrix_head(eye, "mm"))
    return f"{head}__version__:\n  serializer: 1\n  data: 1\nFloatMatrix:\n  Data:\n    [\n{rows}\n    ]\n"


HAND_EYE_FORMATS: dict[str, Callable[[ExportedHandEye], str]] = {
    "ros": ros_yaml,
    "urdf": urdf,
    "opencv": opencv,
    "zivid": zivid,
    "kuka": lambda eye: controller_frame(eye, "kuka"),
    "fanuc": lambda eye: controller_frame(eye, "fanuc"),
    "abb": lambda eye: controller_frame(eye, "abb"),
    "ur": lambda eye: controller_frame(eye, "ur"),
}


def _pose_quaternion(T: Array) -> Array:
    """(7,) x, y, z, qx, qy, qz, qw."""
    return np.append(T[:3, 3], frames.to_quaternion(T))


def _quaternion_head(eye: ExportedHandEye) -> list[str]:
    near = quaternion_w_first_numbers(eye.T_mount)
    order = [0, 1, 2, 4, 5, 6, 3]
    return eye.head(lambda T: quaternion_w_first_numbers(T, near)[order], _QUATERNION, ("m",) * 3 + ("",) * 4)


def _roll_pitch_yaw(T: Array, near: Array | None = None) -> Array:
    """FANUC's angles are those of URDF, in degrees."""
    turned = np.repeat([1.0, 180 / np.pi], 3)
    return fixed_xyz_numbers(T, None if near is None else near * turned) / turned


def _matrix_head(eye: ExportedHandEye, unit: str) -> list[str]:
    """For matrices U of position, and of a small turn about the axes of the parent."""

    def numbers(T: Array) -> Array:
        move = frames.log(frames.inverse(eye.T_mount) @ T)
        return np.append(T[:3, 3] / METRES[unit], 1e3 * eye.T_mount[:3, :3] @ move[:3])

    labels = ("x", "y", "z", "turn about x", "turn about y", "turn about z")
    return eye.head(numbers, labels, (unit,) * 3 + ("mrad",) * 3)


def _cv_matrix(name: str, matrix: Array) -> str:
    rows = ",\n       ".join(row(line, ", ") for line in matrix)
    return f"{name}: !!opencv-matrix\n   rows: {len(matrix)}\n   cols: {len(matrix.T)}\n   dt: d\n   data: [ {rows} ]\n"


def digits(x: float) -> str:
    """Return the shortest decimals that read back as the same float64, without an exponent: some readers take none."""
    return np.format_float_positional(x + 0.0, trim="0")


def row(numbers: Iterable[float], separator: str = " ") -> str:
    """Return several of them."""
    return separator.join(digits(x) for x in numbers)


def commented(mark: str, lines: Sequence[str]) -> str:
    """Return lines of comment behind a mark."""
    return "".join(f"{mark}{' '.join(line.split())}\n" for line in lines)
