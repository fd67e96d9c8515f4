"""The machine as a drawing: arm, scanner and part of one view, with what errs marked and its motion magnified.

The arm is drawn from its own kinematics, seen from the side on which it reaches farthest.
"""

import re
from collections.abc import Sequence

import numpy as np

from stitch.numerics.frames import Array
from stitch.run_data import RunData
from stitch.session.robot import link_frames

_WIDTH, _HEIGHT, _EDGE = 230.0, 250.0, 58.0
# The magnified motion carries what errs by this share of the arm's reach.
_SHOWN = 0.12
_MARK = "var(--best)"
_SCANNER, _PART = "var(--t0)", "var(--soft)"


def machine_svg(
    run: RunData, errs: Sequence[str] = (), centre_of_part: Array | None = None, suspected: bool = False
) -> str:
    """Return the machine as SVG; empty where no arm is known.

    Args:
        errs: what is marked: joint 5, link 4, the scanner's mount, the part, the scanner, the arm, the robot's base.
        centre_of_part: (3,) reference frame; None: of the stitched cloud.
        suspected: none of them is known to err: they are marked with a question, and nothing moves.
    """
    robot, joints = run.session.robot, run.measurement.views.joints
    if robot is None or not joints.shape[1]:
        return ""
    # The view in the middle of all.
    middle = int(np.linalg.norm(joints - np.median(joints, axis=0), axis=1).argmin())
    q = joints[middle]
    chain = link_frames(robot, q)
    eye_to_hand = run.session.mount == "eye_to_hand"
    T_scanner = run.T_mount if eye_to_hand else chain[-1] @ run.T_mount
    # The reference frame is the flange's where that carries the part, else the base.
    T_reference = chain[-1] if eye_to_hand else np.eye(4)
    if centre_of_part is None:
        centre_of_part = run.fused.points.mean(axis=0) if len(run.fused.points) else np.zeros(3)
    centre = (T_reference @ np.append(centre_of_part, 1.0))[:3]
    joints_marked = [int(number) - 1 for place in errs for number in re.findall(r"joint (\d+)", place)]
    arm = chain[:, :3, 3]
    moved = _magnified(run, q, joints_marked[0], arm) if joints_marked and not suspected else None
    every = np.vstack([arm, T_scanner[:3, 3], centre, *([] if moved is None else [moved])])
    flat = _projection(every, arm)
    lines = [_line(flat[: len(arm)], "var(--bar)", 9.0)]
    links = [int(number) for place in errs for number in re.findall(r"link (\d+)", place)]
    lines += [_line(flat[k - 1 : k + 1], _MARK, 9.0) for k in links if k < len(arm)]
    if moved is not None:
        lines.append(_line(flat[len(arm) + 2 :], _MARK, 2.0, "5 4"))
    scanner, part = flat[len(arm)], flat[len(arm) + 1]
    lines.append(_line(np.array([scanner, part]), _SCANNER, 1.2, "2 3"))
    if eye_to_hand:
        lines.append(_line(np.array([flat[len(arm) - 1], part]), "var(--bar)", 4.0))
    else:
        lines.append(_line(np.array([flat[len(arm) - 1], scanner]), "var(--bar)", 4.0))
    said = " and ".join(errs)
    at_scanner, at_part, at_base = (name in said for name in ("scanner", "part", "base"))
    right = bool(scanner[0] > part[0])
    name = "mount" if "mount" in said else "scanner"
    if at_base:
        lines.append(_box(flat[0], 14, _MARK, "base?" if suspected else "base", True))
    lines.append(_box(scanner, 16, _MARK if at_scanner else _SCANNER, name, right))
    lines.append(_box(part, 22, _MARK if at_part else _PART, "part", not right))
    axes = link_frames(robot, q)[:-1] @ robot.before
    places = _projection(axes[:, :3, 3], arm, every)
    marked = range(len(places)) if "the arm" in errs else joints_marked
    for k in sorted(range(len(places)), key=lambda k: k in marked):
        x, y = places[k]
        fill, size = (_MARK, 11.0) if k in marked else ("var(--line)", 5.0)
        lines.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size}" fill="{fill}" stroke="var(--soft)"/>')
        if k in marked:
            text = f'x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle"'
            lines.append(f'<text {text} class="machine-number">{k + 1}{"?" if suspected else ""}</text>')
    marks = f"; {'suspected' if suspected else 'marked'}: {said}" if errs else ""
    return (
        f'<svg class="plot-svg" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" '
        f'aria-label="Arm, scanner and part{marks}">{"".join(lines)}</svg>'
    )


def _magnified(run: RunData, q: Array, joint: int, arm: Array) -> Array | None:
    """Return (m, 3) the arm beyond a joint that is turned so far that it shows."""
    robot = run.session.robot
    assert robot is not None
    if joint >= robot.n_joints:
        return None
    axis = (link_frames(robot, q)[joint] @ robot.before[joint])[:3, 3]
    lever = max(float(np.linalg.norm(arm[-1] - axis)), 0.05 * float(np.ptp(arm, axis=0).max()))
    turned = q.copy()
    turned[joint] += min(_SHOWN * float(np.ptp(arm, axis=0).max()) / lever, 0.6)
    return np.vstack([axis, link_frames(robot, turned)[joint + 1 :, :3, 3]])


def _projection(points: Array, arm: Array, extent: Array | None = None) -> Array:
    """Return (N, 2) pixels of points (N, 3), base frame, seen from the side on which the arm reaches farthest."""
    reach = arm[np.argmax(np.linalg.norm(arm[:, :2] - arm[0, :2], axis=1)), :2] - arm[0, :2]
    along = reach / max(float(np.linalg.norm(reach)), 1e-12) if np.linalg.norm(reach) > 0 else np.array([1.0, 0.0])

    def side(p: Array) -> Array:
        return np.column_stack([p[:, :2] @ along, p[:, 2]])

    whole = side(points if extent is None else extent)
    low, size = whole.min(axis=0), np.maximum(np.ptp(whole, axis=0), 1e-9)
    scale = float(min((_WIDTH - 2 * _EDGE) / size[0], (_HEIGHT - 2 * _EDGE) / size[1]))
    shift = np.array([_WIDTH, _HEIGHT]) / 2 - scale * size / 2
    at = shift + (side(points) - low) * scale
    return np.column_stack([at[:, 0], _HEIGHT - at[:, 1]])


def _line(points: Array, colour: str, width: float, dashes: str = "") -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return (
        f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}" stroke-linejoin="round" '
        f'stroke-linecap="round"{dashed}/>'
    )


def _box(at: Array, size: float, colour: str, name: str, rightwards: bool) -> str:
    x, y = at
    away = size / 2 + 4
    beside, anchor = (x + away, "start") if rightwards else (x - away, "end")
    return (
        f'<rect x="{x - size / 2:.1f}" y="{y - size / 2:.1f}" width="{size}" height="{size}" rx="3" fill="{colour}"/>'
        f'<text x="{beside:.1f}" y="{y + 4:.1f}" text-anchor="{anchor}">{name}</text>'
    )
