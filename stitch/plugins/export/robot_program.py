"""A compensated copy of a robot program: what moves, by how much, and whether it is to be believed."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.errors import InputError, NoResultError
from stitch.model.model import COVERAGE_FACTOR, Term, values_of, with_parameter_values
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.plugins.export.formats import LIMIT_MM
from stitch.plugins.intake.controllers.program import Program
from stitch.plugins.intake.controllers.taught_points import NUMBERS, Span, TaughtPoint
from stitch.plugins.metrology.calibrate.arm_model import ArmModel
from stitch.session import robot as kinematics
from stitch.session.robot import Robot

# A radian weighs as much as this length, m: about the reach of an arm, so that both parts of a twist count alike.
LEVER = 1.0
_NEWTON_STEPS = 100
# Largest step of a joint (rad): the arm stays on its way to the nearest solution.
_LONGEST = 0.3
_CLOSE = 1e-11
_COMPENSATION_STEPS = 30
_STEP_TOLERANCE = 1e-13
# Motions that a unit of joint angles turns into less than this part of the largest are not asked of the arm: at a
# singular pose whole turns would bring micrometres.
_SINGULAR = 1e-3
# From the target before, an arm goes on in the same configuration while no joint turns by more than this (rad).
_SAME = np.radians(90.0)
# Poses of the run from which a first target is looked for.
_STARTS = 40
# Joints and pose of one waypoint agree within the calibration of an arm and the rounding of both (m).
_AGREE = 0.02
# Decimals of positions, of rotations and of joint angles: what each controller stores, so that a moved target is not
# rounded away where its number was written short. FANUC listings have three, whatever they show.
_DECIMALS = {"kuka": (4, 5, 5), "fanuc": (3, 3, 3), "abb": (4, 9, 5), "ur": (7, 7, 7), "yaskawa": (3, 4, 4)}
# A move below this (mm and rad together) is none: numbers are not written anew for rounding's sake.
_NEGLIGIBLE_CHANGE = 1e-9
# The rotation that goes with that, mrad for each mm: what moves a hand of half a metre by so much.
_MRAD_PER_MM = 2.0
# Largest turn of one joint, rad: near a singular pose joints turn far for a small move.
_LARGEST_TURN = np.radians(3.0)
# Joint angles this far beyond those of the run's views are worth a word (rad).
_MAX_JOINT_EXCESS = np.radians(15.0)
# Effects that hang on where a joint comes from.
_HISTORY_EFFECTS = ("backlash", "settling")


def joint_solutions(robot: Robot, T_base_flange: Array, near: Array) -> Array:
    """Return (m, n) solutions in rad, each once, found by damped Newton steps from joint angles (s, n); m may be 0.

    Levenberg-Marquardt on the pose error (Sugihara 2011, IEEE Trans. Robotics 27:984): the damping follows the error.
    """
    q = np.array(near, float)
    weight = np.repeat([1.0, robot.metres_per_unit / LEVER], 3)
    for _ in range(_NEWTON_STEPS):
        off = weight * frames.log(frames.inverse(kinematics.forward(robot, q)) @ T_base_flange)
        size = np.einsum("si,si->s", off, off)
        if (size < _CLOSE**2).all():
            break
        J = weight[:, None] * kinematics.jacobian(robot, q)
        damped = J @ np.swapaxes(J, -1, -2) + (0.5 * size + 1e-14)[:, None, None] * np.eye(6)
        step = np.einsum("sij,si->sj", J, np.linalg.solve(damped, off[..., None])[..., 0])
        longest = np.abs(step).max(axis=1, keepdims=True)
        q = q + step * np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300))
    off = weight * frames.log(frames.inverse(kinematics.forward(robot, q)) @ T_base_flange)
    solutions: list[Array] = []
    # A singular pose is closed in slowly; a nanometre and a nanoradian are far below any arm.
    for solution in q[np.linalg.norm(off, axis=1) < 1e-9]:
        # Whole turns apart they are the same.
        if all(np.abs(np.angle(np.exp(1j * (solution - other)))).max() > 1e-4 for other in solutions):
            solutions.append(solution)
    return np.array(solutions).reshape(-1, robot.n_joints)


def compensate_targets(arm: ArmModel, joints: Array, T_flange_tool: Array) -> tuple[Array, Array, Array, Array]:
    """Solve true_flange(commanded) = forward(nominal) for targets one after the other.

    Newton steps with the nominal arm's Jacobian: the true one differs from it by thousandths, and so does the error
    after each step.

    Args:
        joints: (K, n) rad that the nominal arm would take.
        T_flange_tool: (4, 4) of the place that matters, length_unit.

    Returns:
        Commanded joints (K, n); by what a Cartesian target moves, T_meant_commanded of the nominal arm's tool
        (K, 4, 4); the twist of the tool by which the true arm still misses the meant pose under the model (K, 6); and
        the expanded uncertainty (k = 2) of the tool's position (K,).
    """
    meant = kinematics.forward(arm.robot, joints)
    # How the joints come from the targets before: 0 where nobody knows or nothing moves.
    turn = joints - _previous_joints(joints)
    approach = np.where(np.abs(turn) > 1e-9, np.sign(turn), 0.0)
    weight = np.repeat([1.0, arm.robot.metres_per_unit / LEVER], 3)
    q = joints.copy()

    def missed(q: Array) -> Array:
        return frames.log(frames.inverse(arm.true_flange(q, _previous_joints(q), approach)) @ meant)

    for _ in range(_COMPENSATION_STEPS):
        J = weight[:, None] * kinematics.jacobian(arm.robot, q)
        inverse = np.linalg.pinv(J, rcond=_SINGULAR)
        step = np.einsum("kij,kj->ki", inverse, weight * missed(q))
        q = q + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    q = np.where(np.abs(q - joints) < _STEP_TOLERANCE, joints, q)
    T_tool_flange = frames.inverse(T_flange_tool)
    move = T_tool_flange @ frames.inverse(meant) @ kinematics.forward(arm.robot, q) @ T_flange_tool
    left = missed(q) @ frames.adjoint(T_tool_flange).T
    return q, move, left, _uncertainty(arm, q, approach, T_flange_tool)


def _previous_joints(q: Array) -> Array:
    """Return (K, n) of the targets before; its own for the first."""
    return np.vstack([q[:1], q[:-1]])


def _uncertainty(arm: ArmModel, q: Array, approach: Array, T_flange_tool: Array) -> Array:
    """Return (K,) 2·√tr(J·Σ·Jᵀ), Σ of all fitted parameters together: errors of one make up for errors of another."""

    def place(terms: tuple[Term, ...]) -> Array:
        return (replace(arm, terms=terms).true_flange(q, _previous_joints(q), approach) @ T_flange_tool)[:, :3, 3]

    here = place(arm.terms)
    values = values_of(arm.terms)
    # Columns of the root are steps of about one sigma: J·L by differences, column by column.
    steps = arm.covariance.root(arm.terms).T
    moved = np.array([place(with_parameter_values(arm.terms, values + step)) - here for step in steps]).reshape(
        -1, *here.shape
    )
    return COVERAGE_FACTOR * np.sqrt(np.einsum("pki,pki->k", moved, moved))


def couple_j2_j3(joints: Array, sign: float = 1.0) -> Array:
    """Return joint angles of DH rows: FANUC's J3 counts from the horizontal, theirs is J2 + J3.

    Args:
        sign: −1 for the way back.
    """
    out = np.array(joints, float)
    out[..., 2] += sign * out[..., 1]
    return out


def program_targets(
    program: Program, arm: ArmModel, near: Array | None = None, j2_in_j3: bool = False
) -> tuple[Array, Array]:
    """Return joint angles (K, n) in rad that the nominal arm takes at each target, and T_flange_tool (4, 4); the
    session's length_unit.

    Those of a pose are found from the target before, the first from `near` or from the poses of the run: that arm
    configuration is taken which needs the least turn.

    Args:
        near: (n,) rad about which the arm works.
        j2_in_j3: the program's J3 is a FANUC's, the session's third joint is J2 + J3.

    Raises:
        InputError: joints of another arm, a pose out of reach, a waypoint whose joints and pose contradict each other.
    """
    unit = 1e-3 / arm.robot.metres_per_unit
    T_base_frame = _scaled_pose(program.T_base_frame, unit)
    T_flange_tool = _scaled_pose(program.T_flange_tool, unit)
    starts = arm.joints[:: max(1, len(arm.joints) // _STARTS)] if near is None else near[None]
    joints: list[Array] = []
    for point in program.points:
        T = None
        if point.T_frame_tool is not None:
            T = T_base_frame @ _scaled_pose(point.T_frame_tool, unit) @ frames.inverse(T_flange_tool)
        if point.joints is None and T is not None:
            joints.append(_nearest_solution(program, arm, point, T, joints[-1] if joints else None, starts))
            continue
        joints.append(_taught_joints(program, arm, point, j2_in_j3))
        if T is None:
            continue
        off = kinematics.forward(arm.robot, joints[-1])[:3, 3] - T[:3, 3]
        metres = float(np.linalg.norm(off)) * arm.robot.metres_per_unit
        if metres > _AGREE:
            raise InputError(
                f"{program.file} line {point.line}: joints and pose of {point.name} are {metres * 1e3:.0f} mm apart; "
                "to fix: check --tool, --frame, and that the session's [robot] is this arm"
            )
    return np.array(joints), T_flange_tool


def _scaled_pose(T: Array, unit: float) -> Array:
    out = T.copy()
    out[:3, 3] *= unit
    return out


def _taught_joints(program: Program, arm: ArmModel, point: TaughtPoint, j2_in_j3: bool) -> Array:
    assert point.joints is not None
    n = arm.robot.n_joints
    if len(point.joints) != n:
        raise InputError(
            f"{program.file} line {point.line}: {point.name} has {len(point.joints)} joints, the arm of session "
            f"{arm.session} has {n}; to fix: name a program of that arm"
        )
    return couple_j2_j3(point.joints) if j2_in_j3 else point.joints


def _nearest_solution(
    program: Program, arm: ArmModel, point: TaughtPoint, T: Array, before: Array | None, starts: Array
) -> Array:
    """Return the solution nearest to the target before, or to the poses of the run."""
    if before is not None:
        onward = joint_solutions(arm.robot, T, before[None])
        if len(onward) and np.abs(onward[0] - before).max() < _SAME:
            return onward[0]
    solutions = joint_solutions(arm.robot, T, starts if before is None else np.vstack([before[None], starts]))
    if not len(solutions):
        raise InputError(
            f"{program.file} line {point.line}: {point.name} is out of reach of the arm of session {arm.session}; to "
            "fix: check --frame and --tool, or state joint angles nearby with --near"
        )
    reference = starts if before is None else before[None]
    turn = np.linalg.norm(solutions[:, None] - reference, axis=2).min(axis=1)
    return solutions[turn.argmin()]


def part_motion(file: Path, part: int = 1) -> Array:
    """Return T (4, 4) in mm that takes the nominal place of a part to the found one, base frame, from a fit.json.

    Raises:
        InputError: the file is no fit.json, has no such part, or its job stated no nominal place or no length unit.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        nominal, unit = document["T_base_part_nominal"], document["length_unit"]
        places = [np.array(entry["T_base_part"], float).reshape(4, 4) for entry in document["parts"]]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{file}: is no fit.json of this version; to fix: run stitch fit again with -o") from None
    if nominal is None or unit not in METRES:
        missing = "[nominal], the place for which the program was taught" if nominal is None else 'length_unit = "mm"'
        raise InputError(f"{file}: the job of this fit states no {missing}; to fix: state it, and run stitch fit again")
    if not 1 <= part <= len(places):
        raise InputError(f"{file}: has {len(places)} parts, no part {part}; to fix: name one of them with --part")
    T = places[part - 1] @ frames.inverse(np.array(nominal))
    return _scaled_pose(T, METRES[unit] * 1e3)


def moved_program(program: Program, T_base: Array) -> tuple[dict[Path, str], list[dict[str, Any]]]:
    """Return the texts of a copy whose targets stand to the moved part as the program's own do to the nominal one, and
    a row a target: how far it moves and turns.

    Args:
        T_base: (4, 4) mm, motion of the part in the base frame.

    Raises:
        InputError: a target with joint angles, which say nothing of its place without the arm.
    """
    moves = []
    for point in program.points:
        if point.T_frame_tool is None or point.joints is not None:
            raise InputError(
                f"{program.file} line {point.line}: {point.name} is taught by joint angles, which do not say where it "
                "lies; to fix: teach it as a pose"
            )
        meant = program.T_base_frame @ point.T_frame_tool
        moves.append(frames.inverse(meant) @ T_base @ meant)
    rows = [
        {"target": point.name, "line": point.line, "moved_mm": float(mm), "moved_mrad": float(mrad)}
        for point, (mm, mrad) in zip(program.points, _move_sizes(frames.log(np.array(moves)), 1.0), strict=True)
    ]
    return compensated_texts(program, np.array(moves), np.zeros((len(moves), 1))), rows


def compensated_texts(program: Program, moves: Array, turns: Array, j2_in_j3: bool = False) -> dict[Path, str]:
    """Return the program's texts with its targets moved: their numbers change, every other byte stays.

    Args:
        moves: (K, 4, 4) of each target's tool in mm: T_meant_commanded.
        turns: (K, n) rad that each joint is commanded farther; counted where a target has joint angles.
        j2_in_j3: the joints are those of a session whose third one is J2 + J3 of this FANUC.
    """
    edits: dict[Path, list[tuple[Span, str]]] = {file: [] for file in program.texts}
    place, turn, joint = _DECIMALS[program.controller]
    for point, move, step in zip(program.points, moves, turns, strict=True):
        file = point.file or program.file
        text = program.texts[file]
        if point.T_frame_tool is not None and np.abs(frames.log(move)).max() > _NEGLIGIBLE_CHANGE:
            old = _span_values(text, point.pose_at)
            new = NUMBERS[program.controller](point.T_frame_tool @ move, old)
            if program.controller in ("kuka", "fanuc", "yaskawa"):
                # Controllers take angles within ±180°; what was beyond already stays beyond.
                new[3:] = np.where(np.abs(old[3:]) <= 180, (new[3:] + 180) % 360 - 180, new[3:])
            edits[file] += _edits(text, point.pose_at, new, [place] * 3 + [turn] * (len(new) - 3))
        if point.joints is not None and np.abs(step).max() > _NEGLIGIBLE_CHANGE:
            taught_step = couple_j2_j3(step, -1.0) if j2_in_j3 else step
            angles = taught_step if program.controller == "ur" else np.degrees(taught_step)
            new = _span_values(text, point.joints_at) + angles
            edits[file] += _edits(text, point.joints_at, new, [joint] * len(new))
    texts = dict(program.texts)
    for file, changes in edits.items():
        # From behind, so that places before a change stay.
        for (begin, end), new_text in sorted(changes, reverse=True):
            texts[file] = texts[file][:begin] + new_text + texts[file][end:]
    return texts


def number_text(old: str, value: float, decimals: int) -> str:
    """Return a number in the manner of the one that it replaces; the same text where it says the same."""
    written = len(old.lower().split("e")[0].partition(".")[2])
    text = f"{value:.{max(written, decimals)}f}"
    if float(text) == float(old):
        return old
    if old.lstrip("+-").startswith("."):
        text = text.replace("0.", ".", 1) if text.lstrip("-").startswith("0.") else text
    return "+" + text if old.startswith("+") and value >= 0 else text


def _span_values(text: str, spans: Sequence[Span]) -> Array:
    return np.array([float(text[begin:end]) for begin, end in spans])


def _edits(text: str, spans: Sequence[Span], new: Array, decimals: Sequence[int]) -> list[tuple[Span, str]]:
    return [
        (span, number_text(text[slice(*span)], float(value), places))
        for span, value, places in zip(spans, new, decimals, strict=True)
    ]


@dataclass(frozen=True)
class CompensatedProgram:
    """The copy, K targets commanded anew, and the table of their moves."""

    program: Program
    arm: ArmModel
    meant_joints: Array  # (K, n) rad, that the nominal arm would take
    joints: Array  # (K, n) rad, commanded
    move: Array  # (K, 4, 4) length_unit, of the tool: T_meant_commanded
    residual: Array  # (K, 6) twist by which the true arm still misses the meant pose under the model
    U: Array  # (K,) expanded uncertainty (k = 2) of the tool's position, length_unit
    texts: dict[Path, str]
    beyond: tuple[str, ...]  # effects of the arm that a program's targets do not decide
    notes: tuple[str, ...]

    def rows(self) -> list[dict[str, Any]]:
        """Return a row a target: moved, left under the model, U (k = 2)."""
        mm = self.arm.robot.metres_per_unit * 1e3
        sizes = _move_sizes(frames.log(self.move), mm)
        left = _move_sizes(self.residual, mm)
        turned = np.degrees(self.joints - self.meant_joints)
        return [
            {
                "target": point.name,
                "line": point.line,
                "moved_mm": float(sizes[k, 0]),
                "moved_mrad": float(sizes[k, 1]),
                "U_mm": float(self.U[k] * mm),
                "left_mm": float(left[k, 0]),
                "left_mrad": float(left[k, 1]),
                "joints_deg": turned[k].tolist(),
            }
            for k, point in enumerate(self.program.points)
        ]


def compensated_program(
    program: Program, arm: ArmModel, limit_mm: float = LIMIT_MM, near: Array | None = None, j2_in_j3: bool = False
) -> CompensatedProgram:
    """Return a program's copy with targets moved so that the true arm goes where the program meant.

    Args:
        limit_mm: a target that would move farther is not believed.
        near, j2_in_j3: see `program_targets`.

    Raises:
        InputError: a target that would move too far, or see `program_targets`.
        NoResultError: the model has no effect of the arm that a program's targets decide.
    """
    still, beyond = arm.at_rest()
    if not still.terms:
        raise NoResultError(
            f"the model of session {arm.session} has no effect of the arm"
            + (f" but {', '.join(beyond)}, which hangs on more than the targets" if beyond else "")
            + ", so that a copy would be the same; to fix: diagnose, and add what is missing"
        )
    meant, T_flange_tool = program_targets(program, arm, near, j2_in_j3)
    joints, move, residual, U = compensate_targets(still, meant, T_flange_tool)
    mm = arm.robot.metres_per_unit * 1e3
    _require_believable(program, _move_sizes(frames.log(move), mm), np.abs(joints - meant), limit_mm)
    moves_mm = move.copy()
    moves_mm[:, :3, 3] *= mm
    return CompensatedProgram(
        program=program,
        arm=still,
        meant_joints=meant,
        joints=joints,
        move=move,
        residual=residual,
        U=U,
        texts=compensated_texts(program, moves_mm, joints - meant, j2_in_j3),
        beyond=beyond,
        notes=_program_notes(program, arm, meant, joints, beyond),
    )


def _move_sizes(twists: Array, mm: float) -> Array:
    """Return (K, 2) mm and mrad of twists (K, 6)."""
    return np.column_stack([np.linalg.norm(twists[:, 3:], axis=1) * mm, np.linalg.norm(twists[:, :3], axis=1) * 1e3])


def _require_believable(program: Program, sizes: Array, turned: Array, limit: float) -> None:
    """Refuse targets that move (K, 2) mm and mrad, or turn (K, n) rad of a joint, farther than an arm is off."""
    for k, point in enumerate(program.points):
        where = f"{program.file} line {point.line}: {point.name}"
        if not (sizes[k] <= (limit, _MRAD_PER_MM * limit)).all():
            raise InputError(
                f"{where} would move by {sizes[k, 0]:.3g} mm and {sizes[k, 1]:.3g} mrad, more than the {limit:g} mm "
                f"and {_MRAD_PER_MM * limit:g} mrad that are believed of an arm; to fix: check the model, --frame "
                "and --tool, or raise --limit"
            )
        if point.joints is not None and turned[k].max() > _LARGEST_TURN:
            raise InputError(
                f"{where}: joint {turned[k].argmax() + 1} would turn by {np.degrees(turned[k].max()):.2g}°, near a "
                "singular pose; to fix: teach it with the wrist bent farther"
            )


def unread_motions(program: Program) -> list[str]:
    """Return a note of the lines whose motions stay as they are; none where all are read."""
    lines = ", ".join(map(str, program.unread))
    note = f"not moved, since these motions are not read (arcs, registers, computed targets): lines {lines}"
    return [note] if lines else []


def _program_notes(
    program: Program, arm: ArmModel, meant: Array, joints: Array, beyond: tuple[str, ...]
) -> tuple[str, ...]:
    notes = []
    if beyond:
        notes.append(f"not compensated, since it hangs on time, speed or temperature: {', '.join(beyond)}")
    if arm.other_effects:
        notes.append(f"not in a program's targets: {', '.join(arm.other_effects)}")
    notes += unread_motions(program)
    if program.other:
        notes.append(f"no targets of a motion, left as they are: {', '.join(program.other)}")
    sided = [term.name for term in arm.terms if term.name in _HISTORY_EFFECTS]
    if sided and program.repeated:
        undone = f"{' and '.join(sided)} undone for the first time alone"
        notes.append(f"moved to more than once, {undone}: {', '.join(program.repeated)}")
    low = arm.joints.min(axis=0) - _MAX_JOINT_EXCESS
    high = arm.joints.max(axis=0) + _MAX_JOINT_EXCESS
    outside = (meant < low) | (meant > high)
    names = [point.name for point, out in zip(program.points, outside.any(axis=1), strict=True) if out]
    if names:
        listed = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        notes.append(
            "beyond the joint angles on which the model was fitted, by more than "
            f"{np.degrees(_MAX_JOINT_EXCESS):.0f}°: {listed}"
        )
    # Configurations count quadrants, signs and half turns.
    crosses = (np.floor(meant / (np.pi / 2)) != np.floor(joints / (np.pi / 2))).any(axis=1)
    crossing = [p.name for p, crossed in zip(program.points, crosses, strict=True) if crossed and p.joints is None]
    if crossing:
        notes.append(
            "a joint passes a multiple of 90°, so that its configuration may have to be set anew: "
            f"{', '.join(crossing)}"
        )
    return tuple(notes)
