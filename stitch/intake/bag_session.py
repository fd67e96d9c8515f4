"""A bag of ROS as a session: a view for each stop of the arm, frames and hand-eye as tf has them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from stitch import frames
from stitch.errors import InputError
from stitch.frames import Array
from stitch.intake.bag_frames import BagFrames, identify_frames
from stitch.intake.bag_joints import recorded_tree, recorded_urdf
from stitch.intake.bag_messages import CLOUD, IMAGE, BagContents, open_bag, read_bag
from stitch.intake.bag_scans import cloud_array, depth_array
from stitch.intake.bag_stops import AROUND, middle_of_stops, stationary_scans
from stitch.intake.guesses import Guess
from stitch.intake.transform_tree import TransformTree
from stitch.reading.session_toml import SESSION_FORMAT
from stitch.writing.session_files import pose_columns, whole_folder, write_table

_FEWEST = 3
_MM_PER_METRE = 1e3


@dataclass(frozen=True)
class BagSession:
    """What was made of a bag."""

    views: int
    guesses: tuple[Guess, ...]


@dataclass(frozen=True)
class _ChosenScans:
    """Scans that become views, in the order of time."""

    messages: dict[int, int]  # number of the message of the topic -> number of the view
    times: Array  # (V,) s
    T_base_flange: Array  # (V, 4, 4) m
    guess: Guess


def write_bag_session(bag: Path, out: Path, topic: str | None = None, named: Sequence[str] = ()) -> BagSession:
    """Write a session of a bag into a new folder, whole or not at all; lengths in mm.

    Args:
        topic: of the scans, where there are several.
        named: frames of base, flange and scanner, as a person states them.

    Raises:
        InputError: no bag, no scans, several topics of them, no frame that moves, or fewer than three stops.
    """
    found = read_bag(bag)
    topic, of_topic = _choose_topic(bag, found, topic)
    tree = recorded_tree(found)
    told = identify_frames(tree, found.frame_of[topic], named)
    chosen = _choose_scans(bag, found, topic, tree, told)
    T_mount = _recorded_hand_eye(tree, told, chosen.times)
    guesses = (of_topic, *_frame_guesses(told, T_mount), chosen.guess)
    with whole_folder(out) as scratch:
        (scratch / "clouds").mkdir()
        _write_scans(bag, topic, found, chosen, scratch / "clouds")
        robot, joints, of_joints = recorded_urdf(found, told, chosen.times, scratch)
        guesses = (*guesses, of_joints)
        names = [f"v{i:03d}" for i in range(len(chosen.times))]
        columns: dict[str, Any] = {"view": names, "cloud": [f"clouds/{name}.npy" for name in names]}
        columns["time_s"] = [f"{t:.6f}" for t in chosen.times - chosen.times[0]]
        columns |= {f"j{i + 1}_deg": q for i, q in enumerate(np.degrees(joints).T)} if joints is not None else {}
        T = frames.make(chosen.T_base_flange[:, :3, :3], chosen.T_base_flange[:, :3, 3] * _MM_PER_METRE)
        write_table(scratch / "views.csv", columns | pose_columns(T))
        (scratch / "session.toml").write_text(_session_toml(bag, told, T_mount, robot, guesses), encoding="utf-8")
    return BagSession(len(chosen.times), guesses)


def _choose_topic(bag: Path, contents: BagContents, stated: str | None) -> tuple[str, Guess]:
    topics = sorted(contents.scans)
    if not topics:
        raise InputError(f"{bag}: no PointCloud2 and no depth image in it; to fix: record the scanner's topic too")
    if stated is not None and stated not in topics:
        raise InputError(f"--topic {stated}: {bag} has none of that name; to fix: use {', '.join(topics)}")
    if stated is None and len(topics) > 1:
        raise InputError(f"{bag}: several topics hold scans; to fix: state --topic {' or '.join(topics)}")
    topic = stated or topics[0]
    reason = "stated with --topic" if stated else "the only one with scans"
    return topic, Guess("topic", topic, reason, True, "--topic")


def _choose_scans(
    bag: Path, contents: BagContents, topic: str, tree: TransformTree, bag_frames: BagFrames
) -> _ChosenScans:
    times = np.array(contents.scans[topic])
    order = np.argsort(times, kind="stable")
    ordered = times[order]
    before, at, after = (tree.pose(bag_frames.base, bag_frames.flange, ordered + by) for by in (-AROUND, 0.0, AROUND))
    views = middle_of_stops(at, stationary_scans(before, at, after))
    if len(views) < _FEWEST:
        raise InputError(
            f"{bag}: {len(views)} of {len(times)} scans of {topic} were taken while {bag_frames.flange} stood still in "
            f"{bag_frames.base}; to fix: record at least {_FEWEST} stops with /tf, or name the frames with --frames"
        )
    guess = Guess("views", f"{len(views)} of {len(times)} scans", "one for each stop of the arm", True, "views.csv")
    messages = {int(order[view]): number for number, view in enumerate(views)}
    return _ChosenScans(messages, ordered[views], at[views], guess)


def _recorded_hand_eye(tree: TransformTree, bag_frames: BagFrames, times: Array) -> Array | None:
    """T_mount (4, 4) mm as tf has it; None where tf says nothing, or that both frames are one."""
    if not bag_frames.hand_eye_known:
        return None
    mount = bag_frames.flange if bag_frames.mount == "eye_in_hand" else bag_frames.base
    T = tree.pose(mount, bag_frames.scanner, times[:1])[0]
    if not np.isfinite(T).all() or np.allclose(T, np.eye(4)):
        return None
    return frames.make(T[:3, :3], T[:3, 3] * _MM_PER_METRE)


def _frame_guesses(bag_frames: BagFrames, T_mount: Array | None) -> tuple[Guess, ...]:
    poses = Guess("poses", f"{bag_frames.flange} in {bag_frames.base}", bag_frames.reason, True, "--frames")
    mount = Guess("mount", bag_frames.mount, bag_frames.reason, True, "--frames")
    words = "not known" if T_mount is None else "as tf has it, to begin with"
    return poses, mount, Guess("scanner.pose", words, f"of {bag_frames.scanner}", True, "session.toml")


def _write_scans(bag: Path, topic: str, contents: BagContents, chosen: _ChosenScans, folder: Path) -> None:
    with open_bag(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype in (CLOUD, IMAGE)]
        for number, (connection, _, raw) in enumerate(reader.messages(connections)):
            if number not in chosen.messages:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            where = f"{bag} {topic}"
            if connection.msgtype == CLOUD:
                array = cloud_array(message, where)
            else:
                array = depth_array(message, _camera_info(contents, topic, where))
            array[..., :3] *= _MM_PER_METRE
            np.save(folder / f"v{chosen.messages[number]:03d}.npy", array.astype(np.float32))


def _camera_info(contents: BagContents, topic: str, where: str) -> Any:
    """The CameraInfo beside a topic of images."""
    beside = topic.rsplit("/", 1)[0] + "/camera_info"
    if beside not in contents.cameras:
        raise InputError(f"{where}: a depth image needs {beside}; to fix: record that topic too")
    camera = contents.cameras[beside]
    if np.any(camera.d if hasattr(camera, "d") else camera.D):
        raise InputError(f"{where}: its lens distorts ({beside}); to fix: record the rectified images")
    return camera


def _session_toml(
    bag: Path, bag_frames: BagFrames, T_mount: Array | None, robot: dict[str, str], guesses: Sequence[Guess]
) -> str:
    head = {"format": SESSION_FORMAT, "name": bag.stem, "length_unit": "mm", "mount": bag_frames.mount}
    scanner = {} if T_mount is None else {"scanner": {"pose": T_mount.tolist()}}
    comments = "".join(f"# {guess.line}\n" for guess in guesses)
    return comments + "\n" + tomli_w.dumps({**head, **scanner, **({"robot": robot} if robot else {})})
