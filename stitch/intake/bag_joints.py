"""Joint angles of a bag in the order of the arm, by the URDF that it recorded."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from stitch.frames import Array
from stitch.intake.bag_frames import BagFrames
from stitch.intake.bag_messages import Recorded
from stitch.intake.guesses import Guess

_TURNING = ("revolute", "continuous")
_STALE = 0.5


def recorded_urdf(
    found: Recorded, told: BagFrames, times: Array, folder: Path
) -> tuple[dict[str, str], Array | None, Guess]:
    """The table [robot] with the URDF written beside it, joint angles (V, n) in rad, and why.

    Without a URDF the order of the joints is not known, and they are left out.
    """
    if not found.joints or found.urdf is None:
        lacking = "joint states" if not found.joints else "robot_description"
        return {}, None, Guess("joints", "left out", f"the bag has no {lacking}", True, "session.toml")
    names = chain_joints(found.urdf, told.base, told.flange)
    angles = joints_at(found, names, times) if names else None
    if angles is None:
        reason = f"its URDF has no chain from {told.base} to {told.flange} of the joints recorded"
        return {}, None, Guess("joints", "left out", reason, True, "--frames")
    (folder / "robot.urdf").write_text(found.urdf, encoding="utf-8")
    robot = {"urdf": "robot.urdf", "base_link": told.base, "flange_link": told.flange}
    return robot, angles, Guess("joints", ", ".join(names), "the order of the URDF in the bag", True, "session.toml")


def chain_joints(urdf: str, base: str, flange: str) -> list[str]:
    """Names of the turning joints from base to flange; empty where there is no such chain."""
    try:
        root = ElementTree.fromstring(urdf)
    except ElementTree.ParseError:
        return []
    above = {}
    for joint in root.findall("joint"):
        child, parent = joint.find("child"), joint.find("parent")
        if child is not None and parent is not None:
            above[child.get("link")] = (joint.get("name") or "", joint.get("type"), parent.get("link"))
    names: list[str] = []
    link: str | None = flange
    for _ in range(len(above) + 1):
        if link == base:
            return names[::-1]
        if link not in above:
            return []
        name, kind, link = above[link]
        names += [name] if kind in _TURNING else []
    return []


def joints_at(found: Recorded, names: list[str], times: Array) -> Array | None:
    """(V, n) rad, interpolated; None where a joint or a time was not recorded."""
    rows = [(time, angles) for time, angles in found.joints if all(name in angles for name in names)]
    if not rows:
        return None
    known = np.array([time for time, _ in rows])
    if np.abs(known[:, None] - times[None]).min(axis=0).max() > _STALE:
        return None
    values = np.unwrap(np.array([[angles[name] for name in names] for _, angles in rows]), axis=0)
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)
