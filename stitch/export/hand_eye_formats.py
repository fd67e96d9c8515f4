"""A hand-eye as the text of each format, with what it means and its U (k = 2) in comments."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from xml.sax.saxutils import quoteattr

import numpy as np

from stitch import frames
from stitch.controllers.pose_numbers import fixed_xyz_numbers, quaternion_w_first_numbers
from stitch.export.controller_frames import controller_frame
from stitch.export.hand_eye import ExportedHandEye
from stitch.export.text_lines import commented, row, xml_comment
from stitch.frames import Array
from stitch.units import METRES
from stitch.writing.urdf_file import roll_pitch_yaw

_QUATERNION = ("x", "y", "z", "qx", "qy", "qz", "qw")


def ros_yaml(eye: ExportedHandEye) -> str:
    """A launch file of ROS 2 in YAML that publishes the transform: what MoveIt's own calibration saves."""
    numbers = zip(_QUATERNION, _pose_quaternion(eye.T_mount).tolist(), strict=True)
    flags = " ".join(f"--{key} {row([x])}" for key, x in numbers)
    return (
        f"{commented('# ', _quaternion_head(eye))}launch:\n  - node:\n      pkg: tf2_ros\n"
        f"      exec: static_transform_publisher\n      name: {eye.parent}_to_{eye.child}\n      output: log\n"
        f'      args: "--frame-id {eye.parent} --child-frame-id {eye.child} {flags}"\n'
    )


def ros_launch(eye: ExportedHandEye) -> str:
    """The same as a launch file of ROS 1."""
    args = f"{row(_pose_quaternion(eye.T_mount))} {eye.parent} {eye.child}"
    return (
        f"{xml_comment(_quaternion_head(eye))}<launch>\n"
        f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{eye.parent}_to_{eye.child}"\n'
        f"        args={quoteattr(args)} />\n</launch>\n"
    )


def urdf(eye: ExportedHandEye) -> str:
    """A link and a fixed joint, to be included in the robot's URDF; m and rad."""
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
    """YAML of cv::FileStorage: the matrix and its covariance in the session's length_unit."""
    unit = eye.length_unit
    scale = np.repeat([1.0, 1 / METRES[unit]], 3)
    facts = {"session": eye.session, "parent": eye.parent, "child": eye.child, "length_unit": unit}
    return (
        f"%YAML:1.0\n---\n{commented('# ', _matrix_head(eye, unit))}"
        + "".join(f"{key}: {_quoted(value)}\n" for key, value in facts.items())
        + _cv_matrix(eye.name, eye.lengths(unit))
        + "# Of a right perturbation T·exp(ξ) in the scanner's frame: rotation in rad, then translation\n"
        + _cv_matrix("covariance", eye.covariance * np.outer(scale, scale))
    )


def zivid(eye: ExportedHandEye) -> str:
    """YAML as Zivid's SDK saves a Matrix4x4; mm."""
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
    return np.asarray(fixed_xyz_numbers(T, None if near is None else near * turned) / turned)


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


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
