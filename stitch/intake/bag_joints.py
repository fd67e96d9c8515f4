"""Joint angles of a bag in the order of the arm, by the URDF that it recorded."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np

from stitch.frames import Array
from stitch.intake.bag_frames import BagFrames
from stitch.intake.bag_messages import BagContents
from stitch.intake.guesses import Guess
from stitch.intake.transform_tree import TransformTree
from stitch.intake.urdf_links import arm_link_pairs
from stitch.measurement.robot import forward
from stitch.reading.urdf import robot_from_urdf

_TURNING = ("revolute", "continuous")
_MAX_JOINT_AGE = 0.5
_GRAVITY = np.array([0.0, 0.0, -9.81])


def recorded_urdf(
    contents: BagContents, bag_frames: BagFrames, times: Array, folder: Path
) -> tuple[dict[str, str], Array | None, Guess]:
    """The table [robot] with the URDF written beside it, joint angles (V, n) in rad, and why.

    Without a URDF the order of the joints is not known, and they are left out.
    """
    if not contents.joints or contents.urdf is None:
        lacking = "joint states" if not contents.joints else "robot_description"
        return {}, None, Guess("joints", "left out", f"the bag has no {lacking}", True, "session.toml")
    names = chain_joints(contents.urdf, bag_frames.base, bag_frames.flange)
    angles = interpolated_joints(contents, names, times) if names else None
    if angles is None:
        reason = f"its URDF has no chain from {bag_frames.base} to {bag_frames.flange} of the joints recorded"
        return {}, None, Guess("joints", "left out", reason, True, "--frames")
    (folder / "robot.urdf").write_text(contents.urdf, encoding="utf-8")
    robot = {"urdf": "robot.urdf", "base_link": bag_frames.base, "flange_link": bag_frames.flange}
    return robot, angles, Guess("joints", ", ".join(names), "the order of the URDF in the bag", True, "session.toml")


def recorded_tree(contents: BagContents) -> TransformTree:
    """What tf recorded; where it recorded no motion of the arm, the motion of the joints by their URDF."""
    tree = TransformTree(contents.edges)
    if not tree.still or not contents.joints or contents.urdf is None:
        return tree
    for base, flange in _link_pairs(contents.urdf):
        names = chain_joints(contents.urdf, base, flange)
        rows = [(time, [q[name] for name in names]) for time, q in contents.joints if all(name in q for name in names)]
        if names and rows:
            T = _flange_poses(contents.urdf, base, flange, np.array([q for _, q in rows]))
            moved = [(time, base, flange, pose, False) for (time, _), pose in zip(rows, T, strict=True)]
            # Links between them, published as fixed, would hold the flange elsewhere.
            return TransformTree([edge for edge in contents.edges if edge[2] != flange] + moved)
    return tree


def _link_pairs(urdf: str) -> list[tuple[str, str]]:
    with _temporary_urdf(urdf) as file:
        return arm_link_pairs(file)


def _flange_poses(urdf: str, base: str, flange: str, joints: Array) -> Array:
    """T_base_flange (M, 4, 4), m, of joint angles (M, n), rad."""
    with _temporary_urdf(urdf) as file:
        return np.asarray(forward(robot_from_urdf(file, base, flange, "m", _GRAVITY), joints))


@contextmanager
def _temporary_urdf(urdf: str) -> Iterator[Path]:
    """The text of a bag as the file that robots are read from."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "robot.urdf"
        file.write_text(urdf, encoding="utf-8")
        yield file


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


def interpolated_joints(contents: BagContents, names: list[str], times: Array) -> Array | None:
    """(V, n) rad, interpolated; None where a joint or a time was not recorded."""
    rows = [(time, angles) for time, angles in contents.joints if all(name in angles for name in names)]
    if not rows:
        return None
    known = np.array([time for time, _ in rows])
    if np.abs(known[:, None] - times[None]).min(axis=0).max() > _MAX_JOINT_AGE:
        return None
    values = np.unwrap(np.array([[angles[name] for name in names] for _, angles in rows]), axis=0)
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)
