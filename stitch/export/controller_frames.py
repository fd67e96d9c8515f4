"""A hand-eye as a frame of a controller: KUKA, FANUC, ABB, UR, in the numbers that its screens show."""

from dataclasses import dataclass

import numpy as np

from stitch.controllers.pose_numbers import NUMBERS
from stitch.export.hand_eye import ExportedHandEye
from stitch.export.text_lines import commented
from stitch.frames import Array


@dataclass(frozen=True)
class ControllerFrame:
    """How one controller writes a frame."""

    labels: tuple[str, ...]
    units: tuple[str, ...]
    comment: str  # begins a line of comment
    template: str  # {name} and the numbers by position
    place: dict[str, str]  # mount → where it is entered


_DEGREES = ("mm", "mm", "mm", "°", "°", "°")
_CONTROLLERS = {
    "kuka": ControllerFrame(
        tuple("XYZABC"),
        _DEGREES,
        "; ",
        "DECL FRAME {name}={{X {0},Y {1},Z {2},A {3},B {4},C {5}}}",
        {"eye_in_hand": "TOOL_DATA", "eye_to_hand": "BASE_DATA"},
    ),
    "fanuc": ControllerFrame(
        tuple("XYZWPR"),
        _DEGREES,
        "! ",
        "{name}:\nX = {0} mm, Y = {1} mm, Z = {2} mm,\nW = {3} deg, P = {4} deg, R = {5} deg",
        {"eye_in_hand": "UTOOL", "eye_to_hand": "UFRAME"},
    ),
    "abb": ControllerFrame(
        ("x", "y", "z", "q1", "q2", "q3", "q4"),
        ("mm", "mm", "mm", "", "", "", ""),
        "! ",
        "PERS pose {name}:=[[{0},{1},{2}],[{3},{4},{5},{6}]];",
        {"eye_in_hand": "tframe of a tooldata", "eye_to_hand": "uframe of a wobjdata"},
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
    """The frame as a controller writes it, by "kuka", "fanuc", "abb" or "ur"."""
    form, near = _CONTROLLERS[controller], _frame_numbers(eye.T_mount, controller)
    head = eye.head(lambda T: _frame_numbers(T, controller, near), form.labels, form.units)
    lines = [*head, f"Entered as {form.place[eye.mount]}, in the controller's own base and flange"]
    text = form.template.format(*(f"{x + 0.0:.9f}" for x in near), name=eye.name)
    return f"{commented(form.comment, lines)}{text}\n"


def _frame_numbers(T: Array, controller: str, near: Array | None = None) -> Array:
    """Of a pose (4, 4) in m; the controllers' functions take mm."""
    T = T.copy()
    T[:3, 3] *= 1000
    return np.asarray(NUMBERS[controller](T, near))
