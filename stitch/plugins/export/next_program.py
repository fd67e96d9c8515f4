"""A robot program that drives to proposed views, one stop for each: KUKA, ABB, FANUC, UR, Yaskawa by its ending.

Joint moves, slow, to the angles that the session's views.csv would have; of a Yaskawa, whose pulses a session does not
know, linear moves of the flange in the base. Nobody has looked for collisions on the way: the header says so.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from stitch.errors import InputError
from stitch.numerics.frames import Array
from stitch.plugins.export.robot_program import couple_j2_j3
from stitch.plugins.intake.controllers.taught_points import fixed_xyz_numbers

_LONGEST_NAME = 20
_AXES = 6
# Before a move and after it: what every header says.
_WARNING = "Check it at reduced speed: the way there has not been checked for collisions."
_WAIT = "Scan here, then go on."
# Per cent of the joints' speed; rad/s and rad/s² of a UR; mm/s.
_PER_CENT, _UR_SPEED, _UR_ACCELERATION, _LINEAR = 5, 0.15, 0.3, 20


def next_program(
    file: Path,
    joints_deg: Sequence[Sequence[float]],
    T_base_flange: Sequence[Sequence[Sequence[float]]],
    about: str,
    j3: str | None = None,
) -> str:
    """Return the text of a program that drives to views one after the other.

    Args:
        file: to be written; its ending says of which controller.
        joints_deg: (K, n) of the views.
        T_base_flange: (K, 4, 4) mm.
        about: what the views are for, a sentence.
        j3: of a FANUC, own, or j2+j3 where the session's joint 3 is J2 + J3.

    Raises:
        InputError: an ending that no controller has, an arm of other than six joints, a FANUC without `j3`.
    """
    write = _WRITERS.get(file.suffix.lower())
    if write is None:
        raise InputError(f"{file}: unknown kind {file.suffix!r} of program; to fix: end it in {', '.join(_WRITERS)}")
    joints = np.array(joints_deg, float)
    if joints.shape[1] != _AXES:
        raise InputError(f"{file}: this arm has {joints.shape[1]} joints; programs are written for {_AXES}")
    if write is _fanuc:
        if j3 is None:
            raise InputError(
                f"{file}: a FANUC's J3 turns with J2; to fix: --j3 j2+j3 where the session's third joint is J2 + J3, "
                "--j3 own where its views.csv has J3 as the controller shows it"
            )
        joints = couple_j2_j3(joints, -1.0) if j3 == "j2+j3" else joints
    name = re.sub(r"\W", "_", file.stem)[:_LONGEST_NAME]
    name = name if name[:1].isalpha() else f"v_{name}"
    return write(
        name, [about, _WARNING, "Joint angles as in views.csv of the session."], joints, np.array(T_base_flange)
    )


def _kuka(name: str, header: Sequence[str], joints: Array, poses: Array) -> str:
    lines = [f"DEF {name}( )", *(f"; {line}" for line in header), "BAS(#INITMOV,0)", f"BAS(#VEL_PTP,{_PER_CENT})"]
    for q in joints:
        axes = ",".join(f"A{i + 1} {x:.4f}" for i, x in enumerate(q))
        lines += [f"PTP {{{axes}}}", f"HALT ; {_WAIT}"]
    return "\n".join([*lines, "END", ""])


def _abb(name: str, header: Sequence[str], joints: Array, poses: Array) -> str:
    lines = [f"MODULE {name}", *(f"  ! {line}" for line in header), f"  PROC {name}_drive()"]
    for q in joints:
        axes = ",".join(f"{x:.4f}" for x in q)
        move = f"MoveAbsJ [[{axes}],[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs,v50,fine,tool0;"
        lines += [f"    {move}", f"    Stop; ! {_WAIT}"]
    return "\n".join([*lines, "  ENDPROC", "ENDMODULE", ""])


def _fanuc(name: str, header: Sequence[str], joints: Array, poses: Array) -> str:
    moves = [line for k in range(len(joints)) for line in (f"J P[{k + 1}] {_PER_CENT}% FINE", "  PAUSE")]
    lines = [f"/PROG  {name.upper()}", "/ATTR", 'COMMENT = "stitch next";', "DEFAULT_GROUP = 1,*,*,*,*;", "/MN"]
    # A remark of a listing holds 32 characters.
    told = [text[at : at + 32].strip() for text in header for at in range(0, len(text), 32)]
    every = [*(f"  !{text}" for text in told), *moves]
    lines += [f"{k:4d}:{line} ;" for k, line in enumerate(every, 1)]
    lines.append("/POS")
    for k, q in enumerate(joints):
        axes = ",\n".join(
            "\t" + ", ".join(f"J{i + 1} = {q[i]:.3f} deg" for i in half) for half in (range(3), range(3, _AXES))
        )
        lines += [f"P[{k + 1}]{{", "   GP1:", "\tUF : 0, UT : 1,", axes, "};"]
    return "\n".join([*lines, "/END", ""])


def _ur(name: str, header: Sequence[str], joints: Array, poses: Array) -> str:
    lines = [f"def {name}_drive():", *(f"  # {line}" for line in header)]
    for q in np.radians(joints):
        axes = ", ".join(f"{x:.6f}" for x in q)
        lines += [f"  movej([{axes}], a={_UR_ACCELERATION}, v={_UR_SPEED})", f'  popup("{_WAIT}", blocking=True)']
    return "\n".join([*lines, "end", f"{name}_drive()", ""])


def _yaskawa(name: str, header: Sequence[str], joints: Array, poses: Array) -> str:
    count = len(poses)
    lines = ["/JOB", f"//NAME {name.upper()}", "//POS", f"///NPOS {count},0,0,0,0,0", "///TOOL 0"]
    lines += ["///POSTYPE BASE", "///RECTAN", "///RCONF 1,0,0,0,0,0,0,0"]
    lines += [
        f"C{k:05d}=" + ",".join(f"{x:.4f}" if i > 2 else f"{x:.3f}" for i, x in enumerate(fixed_xyz_numbers(T)))
        for k, T in enumerate(poses)
    ]
    lines += ["//INST", "///ATTR SC,RW,RJ", "////FRAME BASE", "///GROUP1 RB1", "NOP"]
    told = [*header[:-1], "Flange in the base of the session; TOOL 0 has to be zero; check the figure (RCONF)."]
    lines += [f"'{line}" for line in told]
    for k in range(count):
        lines += [f"MOVL C{k:05d} V={_LINEAR:.1f}", "PAUSE"]
    return "\r\n".join([*lines, "END", ""])


_WRITERS: dict[str, Callable[[str, Sequence[str], Array, Array], str]] = {
    ".src": _kuka,
    ".mod": _abb,
    ".ls": _fanuc,
    ".script": _ur,
    ".jbi": _yaskawa,
}
