"""A compensated copy of a robot program: what moves, by how much, and whether it is to be believed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stitch import frames
from stitch.controllers.program import Program
from stitch.errors import InputError, NoResultError
from stitch.export.arm_model import ArmModel
from stitch.export.compensation import ProgramCompensation, compensate_targets
from stitch.export.export_options import LIMIT_MM
from stitch.export.program_copy import compensated_texts
from stitch.export.program_targets import ProgramTargets, program_targets
from stitch.frames import Array

# The rotation that goes with that, mrad for each mm: what moves a hand of half a metre by so much.
_MRAD_PER_MM = 2.0
# Largest turn of one joint, rad: near a singular pose joints turn far for a small move.
_LARGEST_TURN = np.radians(3.0)
# Joint angles this far beyond those of the run's views are worth a word (rad).
_MAX_JOINT_EXCESS = np.radians(15.0)
# Effects that hang on where a joint comes from.
_HISTORY_EFFECTS = ("backlash", "settling")


@dataclass(frozen=True)
class CompensatedProgram:
    """The copy and the table of its moves; lengths in mm."""

    program: Program
    arm: ArmModel
    targets: ProgramTargets
    compensation: ProgramCompensation
    texts: dict[Path, str]
    beyond: tuple[str, ...]  # effects of the arm that a program's targets do not decide
    notes: tuple[str, ...]

    @property
    def mm(self) -> float:
        """In one length_unit."""
        return self.arm.robot.metres_per_unit * 1e3

    def rows(self) -> list[dict[str, Any]]:
        """One per target: moved, left under the model, U (k = 2)."""
        sizes = _move_sizes(frames.log(self.compensation.move), self.mm)
        left = _move_sizes(self.compensation.residual, self.mm)
        turned = np.degrees(self.compensation.joints - self.targets.joints)
        return [
            {
                "target": point.name,
                "line": point.line,
                "moved_mm": float(sizes[k, 0]),
                "moved_mrad": float(sizes[k, 1]),
                "U_mm": float(self.compensation.U[k] * self.mm),
                "left_mm": float(left[k, 0]),
                "left_mrad": float(left[k, 1]),
                "joints_deg": turned[k].tolist(),
            }
            for k, point in enumerate(self.program.points)
        ]


def compensated_program(
    program: Program,
    arm: ArmModel,
    limit_mm: float = LIMIT_MM,
    near: Array | None = None,
    j2_in_j3: bool = False,
) -> CompensatedProgram:
    """Targets moved so that the true arm goes where the program meant.

    Args:
        limit_mm: a target that would move farther is not believed.
        near, j2_in_j3: see `targets_of`.

    Raises:
        InputError: a target that would move too far, or see `targets_of`.
        NoResultError: the model has no effect of the arm that a program's targets decide.
    """
    still, beyond = arm.at_rest()
    if not still.terms:
        raise NoResultError(
            f"the model of session {arm.session} has no effect of the arm"
            + (f" but {', '.join(beyond)}, which hangs on more than the targets" if beyond else "")
            + ": a copy would be the same; diagnose, and add what is missing"
        )
    targets = program_targets(program, arm, near, j2_in_j3)
    found = compensate_targets(still, targets.joints, targets.T_flange_tool)
    mm = arm.robot.metres_per_unit * 1e3
    _require_believable(program, targets, found, limit_mm, mm)
    moves = found.move.copy()
    moves[:, :3, 3] *= mm
    texts = compensated_texts(program, moves, found.joints - targets.joints, j2_in_j3)
    notes = _program_notes(program, arm, targets, found, beyond)
    return CompensatedProgram(program, still, targets, found, texts, beyond, notes)


def _move_sizes(twists: Array, mm: float) -> Array:
    """(K, 2) mm and mrad of twists (K, 6)."""
    return np.column_stack([np.linalg.norm(twists[:, 3:], axis=1) * mm, np.linalg.norm(twists[:, :3], axis=1) * 1e3])


def _require_believable(
    program: Program, targets: ProgramTargets, compensation: ProgramCompensation, limit: float, mm: float
) -> None:
    sizes, turned = _move_sizes(frames.log(compensation.move), mm), np.abs(compensation.joints - targets.joints)
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


def _program_notes(
    program: Program, arm: ArmModel, targets: ProgramTargets, compensation: ProgramCompensation, beyond: tuple[str, ...]
) -> tuple[str, ...]:
    notes = []
    if beyond:
        notes.append(f"not compensated, since it hangs on time, speed or temperature: {', '.join(beyond)}")
    if arm.other_effects:
        notes.append(f"not in a program's targets: {', '.join(arm.other_effects)}")
    if program.unread:
        told = ", ".join(str(line) for line in program.unread)
        notes.append(f"not moved, since these motions are not read (arcs, registers, computed targets): lines {told}")
    if program.other:
        notes.append(f"no targets of a motion, left as they are: {', '.join(program.other)}")
    sided = [term.name for term in arm.terms if term.name in _HISTORY_EFFECTS]
    if sided and program.repeated:
        told = f"moved to more than once, {' and '.join(sided)} undone for the first time alone"
        notes.append(f"{told}: {', '.join(program.repeated)}")
    low, high = arm.joints.min(axis=0) - _MAX_JOINT_EXCESS, arm.joints.max(axis=0) + _MAX_JOINT_EXCESS
    outside = (targets.joints < low) | (targets.joints > high)
    names = [point.name for point, out in zip(program.points, outside.any(axis=1), strict=True) if out]
    if names:
        told = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
        notes.append(
            f"beyond the joint angles on which the model was fitted, by more than {np.degrees(_MAX_JOINT_EXCESS):.0f}°: {told}"
        )
    crossing = _configuration_note(program, targets, compensation)
    if crossing:
        notes.append(f"a joint passes a multiple of 90°, so that its configuration may have to be set anew: {crossing}")
    return tuple(notes)


def _configuration_note(program: Program, targets: ProgramTargets, compensation: ProgramCompensation) -> str:
    """Cartesian targets whose joints pass what configurations count: quadrants, signs, half turns."""
    quadrants = [np.floor(q / (np.pi / 2)) for q in (targets.joints, compensation.joints)]
    moved = (quadrants[0] != quadrants[1]).any(axis=1) & np.array(targets.cartesian)
    return ", ".join(point.name for point, has in zip(program.points, moved, strict=True) if has)
