"""A bag of ROS as a session: a view for each stop of the arm, frames and hand-eye as tf has them."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.output.session_files import pose_columns, whole_folder, write_table
from stitch.plugins.intake.cloud_pairs import Pairing
from stitch.plugins.intake.convention_choice import choose_convention
from stitch.plugins.intake.first_session import capture_of
from stitch.plugins.intake.guesses import Guess
from stitch.plugins.intake.layouts import ColumnLayout
from stitch.plugins.intake.make_session import Made
from stitch.plugins.intake.readings import Reading, arm_link_pairs
from stitch.plugins.intake.session_guesses import score_words
from stitch.plugins.intake.stops import AROUND, middle_of_stops, stationary_scans
from stitch.screening.motions import register_scan_pairs
from stitch.session.reading.clouds import read_cloud
from stitch.session.reading.depth_image import points_of_image
from stitch.session.reading.intrinsics import Intrinsics
from stitch.session.reading.robot_description import moving_joints, poses_of_urdf
from stitch.session.reading.session_toml import SESSION_FORMAT
from stitch.session.reading.text_files import shortened
from stitch.system.packages import import_extra

# An edge moves if it turns (rad) or shifts (m) by more between its recordings.
_STATIC_TURN, _STATIC_SHIFT = 1e-4, 1e-4
# Recordings this long (s) before or after a moment still say where things were.
_MAX_TRANSFORM_AGE = 0.5
_LONGEST = 200
# Time, parent, child, T_parent_child (4, 4), whether published as fixed.
Recording = tuple[float, str, str, Array, bool]
# As REP 199 and drivers of robots name them, the usual first.
_FLANGES = ("tool0", "flange", "ee_link", "link_ee")
_BASES = ("base_link", "base", "link_0", "world")
CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_JOINTS, _TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
_DEPTH = ("16UC1", "32FC1", "mono16")
_MAX_JOINT_AGE = 0.5
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# Depth in whole numbers counts millimetres (REP 118).
_METRES_PER_MM = 1e-3
_FEWEST = 3
_MM_PER_METRE = 1e3


@dataclass
class _TreeEdge:
    parent: str
    times: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)  # T_parent_child, m
    static: bool = False


class TransformTree:
    """Child to parent, with every recording of each edge; lengths in m, times in s."""

    def __init__(self, recordings: Iterable[Recording]) -> None:
        """Sort recordings by edge."""
        self._edges: dict[str, _TreeEdge] = {}
        for time, parent, child, T, static in recordings:
            edge = self._edges.setdefault(child, _TreeEdge(parent))
            # What is published as fixed, or under another parent later, replaces what was said before.
            if static or parent != edge.parent:
                edge = self._edges[child] = _TreeEdge(parent, static=static)
            edge.times.append(time)
            edge.poses.append(T)
        for edge in self._edges.values():
            order = np.argsort(edge.times, kind="stable")
            edge.times = [edge.times[i] for i in order]
            edge.poses = [edge.poses[i] for i in order]

    @property
    def still(self) -> bool:
        """True if no frame moves."""
        return not any(self.moves(child) for child in self._edges)

    @property
    def names(self) -> list[str]:
        """All frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def above(self, frame: str) -> list[str]:
        """A frame, its parent, and so on up to the root.

        Raises:
            InputError: parents that go in a circle.
        """
        out = [frame]
        while out[-1] in self._edges:
            out.append(self._edges[out[-1]].parent)
            if len(out) > _LONGEST:
                raise InputError(f"tf: the parents of {frame} go in a circle; to fix: record it again")
        return out

    def moves(self, child: str) -> bool:
        """Whether a frame moves in its parent."""
        edge = self._edges.get(child)
        if edge is None or edge.static or len(edge.poses) < 2:
            return False
        step = frames.log(frames.inverse(edge.poses[0]) @ np.array(edge.poses))
        turn, shift = (np.linalg.norm(step[:, part], axis=1).max() for part in (slice(0, 3), slice(3, 6)))
        return bool(turn > _STATIC_TURN or shift > _STATIC_SHIFT)

    def pose(self, parent: str, child: str, times: Array) -> Array:
        """T_parent_child (M, 4, 4) at some times; NaN where nothing was recorded near.

        Raises:
            InputError: no chain leads from one to the other.
        """
        up, down = self.above(child), self.above(parent)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            known = ", ".join(self.names[:8])
            raise InputError(
                f"tf: no chain leads from {parent} to {child}; to fix: name others with --frames: {known} …"
            )
        return frames.inverse(self._down(down[: down.index(common)], times)) @ self._down(up[: up.index(common)], times)

    def _down(self, path: list[str], times: Array) -> Array:
        """Product of the edges of a path that ends at its first frame."""
        T = np.tile(np.eye(4), (len(times), 1, 1))
        for child in path[::-1]:
            T = T @ self._at(self._edges[child], times)
        return T

    def _at(self, edge: _TreeEdge, times: Array) -> Array:
        """T_parent_child (M, 4, 4): turned by Slerp (Shoemake 1985), shifted along a line."""
        if edge.static or len(edge.poses) == 1:
            return np.broadcast_to(edge.poses[-1], (len(times), 4, 4))
        known, first = np.unique(edge.times, return_index=True)
        poses = np.array(edge.poses)[first]
        if len(known) == 1:
            return np.broadcast_to(poses[0], (len(times), 4, 4))
        asked = np.clip(times, known[0], known[-1])
        shift = np.stack([np.interp(asked, known, poses[:, i, 3]) for i in range(3)], axis=1)
        T = frames.make(Slerp(known, Rotation.from_matrix(poses[:, :3, :3]))(asked).as_matrix(), shift)
        nearest = np.abs(known[:, None] - np.asarray(times)[None]).min(axis=0)
        T[nearest > _MAX_TRANSFORM_AGE] = np.nan
        return T


@dataclass(frozen=True)
class BagFrames:
    """Names of frames of tf."""

    base: str
    flange: str
    scanner: str
    mount: str | None  # None where tf does not know the scanner's frame
    reason: str
    hand_eye_known: bool  # tf says where the scanner sits


def identify_frames(tree: TransformTree, scanner: str, named: Sequence[str]) -> BagFrames:
    """Tell the frames.

    Args:
        scanner: frame of the scans.
        named: base, flange and, if it is another, scanner, as a person states them.

    Raises:
        InputError: a frame that tf does not know, or nothing that moves.
    """
    scanner = named[2] if len(named) > 2 else scanner
    unknown = next((frame for frame in named[:2] if frame not in tree.names), None)
    if unknown is not None:
        raise InputError(f"--frames: tf has no {unknown}; to fix: use {', '.join(tree.names)}")
    path = tree.above(scanner)[::-1]
    moving = _moving_places(tree, path)
    known = len(path) > 1
    if len(named) > 1:
        base, flange, reason = named[0], named[1], "stated with --frames"
        carried: bool | None = None if scanner not in tree.names else bool(moving) and flange in path
    else:
        chain, carried, reason = path, True, f"the scanner's frame {scanner} moves with it"
        if not moving:
            ends = [f for f in tree.names if tree.moves(f)]
            if not ends:
                raise InputError(
                    "tf: no frame moves, so that nothing says where the arm is; to fix: record /tf of the arm"
                )
            chain = tree.above(max(ends, key=lambda f: len(tree.above(f))))[::-1]
            moving = _moving_places(tree, chain)
            carried, reason = False, f"the scanner's frame {scanner} does not move"
            if scanner not in tree.names:
                carried, reason = None, f"tf has no frame {scanner}"
            known = known and bool(set(path) & set(chain))
        first, last = moving[0], chain[moving[-1]]
        base = _most_usual_name(chain[:first], _BASES) or chain[first - 1]
        # Tools that are fixed to the last link beside the scanner's way count too.
        fixed = [f for f in tree.names if last in tree.above(f) and _is_rigid(tree, f, last)]
        flange = _most_usual_name(fixed, _FLANGES) or last
    mount = None if carried is None else "eye_in_hand" if carried else "eye_to_hand"
    return BagFrames(base, flange, scanner, mount, reason, known)


def _moving_places(tree: TransformTree, chain: Sequence[str]) -> list[int]:
    """Places in a chain, from its root, of frames that move in their parents."""
    return [i for i in range(1, len(chain)) if tree.moves(chain[i])]


def _most_usual_name(frames: Sequence[str], usual_names: Sequence[str]) -> str | None:
    """The frame with the most usual name; names may have a prefix of their robot."""
    for name in usual_names:
        fitting = [frame for frame in frames if frame == name or frame.endswith(f"_{name}")]
        if fitting:
            return fitting[-1]
    return None


def _is_rigid(tree: TransformTree, frame: str, link: str) -> bool:
    """Whether nothing moves between a link and a frame above which it lies."""
    path = tree.above(frame)
    return not any(tree.moves(f) for f in path[: path.index(link)])


@dataclass
class BagContents:
    """Everything but the scans themselves; times in s, lengths in m, angles in rad."""

    edges: list[Recording]  # of tf
    scans: dict[str, list[float]]  # by topic the time of every cloud or depth image
    frame_of: dict[str, str]  # by topic the frame of its scans
    joints: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    urdf: str | None = None
    cameras: dict[str, Any] = field(default_factory=dict)  # by topic the last CameraInfo


def find_bag(path: Path) -> Path | None:
    """Return the bag that a path is, or that lies alone in a folder; None where there is none, or one of several."""
    if is_bag(path):
        return path
    inside = [own for own in path.iterdir() if is_bag(own)] if path.is_dir() else []
    return inside[0] if len(inside) == 1 and len(list(path.iterdir())) == 1 else None


def is_bag(path: Path) -> bool:
    """True for .bag, .mcap and .db3, and for the folder of a rosbag2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(path.glob("*.db3*")) | any(path.glob("*.mcap*"))
    return path.suffix.lower() in (".bag", ".mcap", ".db3")


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """The bag for reading.

    Raises:
        InputError: rosbags is not installed, or the file is no bag; names it.
    """
    highlevel = import_extra("rosbags.highlevel", path, "bags")
    typesys = import_extra("rosbags.typesys", path, "bags")
    try:
        with highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.LATEST)) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:  # whatever the library raises at bytes that are no bag
        reason = shortened(" ".join(str(error).split()) or type(error).__name__)
        raise InputError(f"{path}: cannot be read as a bag ({reason}); to fix: record or convert it again") from None


def read_bag(path: Path) -> BagContents:
    """Read all but the scans' own data."""
    out = BagContents([], {}, {})
    wanted = {*_TF, _JOINTS, _TEXT, CLOUD, IMAGE, CAMERA}
    with open_bag(path) as reader:
        for connection, stamp, raw in reader.messages([c for c in reader.connections if c.msgtype in wanted]):
            message = reader.deserialize(raw, connection.msgtype)
            topic, kind = connection.topic, connection.msgtype
            if kind in _TF:
                out.edges += [transform_recording(t, "static" in topic) for t in message.transforms]
            elif kind == _JOINTS:
                angles = {n: float(q) for n, q in zip(message.name, message.position, strict=False)}
                out.joints.append((message_time(message.header, stamp), angles))
            elif kind == _TEXT:
                out.urdf = message.data if "robot_description" in topic else out.urdf
            elif kind == CAMERA:
                out.cameras[topic] = message
            elif kind == CLOUD or message.encoding in _DEPTH:
                out.scans.setdefault(topic, []).append(message_time(message.header, stamp))
                out.frame_of[topic] = _frame_name(message.header.frame_id)
    out.joints.sort(key=lambda item: item[0])
    return out


def message_time(header: Any, recorded_ns: int) -> float:
    """Of the measurement, s; of the recording where it has none."""
    stamp = float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
    return stamp or 1e-9 * recorded_ns


def transform_recording(message: Any, static: bool) -> Recording:
    """Return what a TransformStamped says: time, parent, child, T_parent_child (4, 4), m, and whether it is fixed."""
    turn, shift = message.transform.rotation, message.transform.translation
    R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T = frames.make(R, np.array([shift.x, shift.y, shift.z]))
    parent, child = _frame_name(message.header.frame_id), _frame_name(message.child_frame_id)
    return message_time(message.header, 0), parent, child, T, static


def _frame_name(frame: str) -> str:
    return frame.lstrip("/")


def recorded_urdf(
    contents: BagContents, bag_frames: BagFrames, times: Array, folder: Path
) -> tuple[dict[str, str], Array | None, Guess]:
    """The table [robot] with the URDF written beside it, joint angles (V, n) in rad, and why.

    Without a URDF the order of the joints is not known, and they are left out.
    """
    if not contents.joints or contents.urdf is None:
        lacking = "joint states" if not contents.joints else "robot_description"
        return {}, None, Guess("joints", "left out", f"the bag has no {lacking}", True, "session.toml")
    joints = moving_joints(contents.urdf, bag_frames.base, bag_frames.flange)
    names = [name for name, kind in joints if kind != "prismatic"]
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
    for base, flange in arm_link_pairs(contents.urdf):
        names = [name for name, _ in moving_joints(contents.urdf, base, flange)]
        rows = [(t, [q[name] for name in names]) for t, q in contents.joints if all(name in q for name in names)]
        if names and rows:
            T = poses_of_urdf(contents.urdf, base, flange, np.array([q for _, q in rows]))
            T = frames.make(T[:, :3, :3], T[:, :3, 3] / _MM_PER_METRE)
            moved = [(time, base, flange, pose, False) for (time, _), pose in zip(rows, T, strict=True)]
            # Links between them, published as fixed, would hold the flange elsewhere.
            return TransformTree([edge for edge in contents.edges if edge[2] != flange] + moved)
    return tree


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


def cloud_array(message: Any, where: str) -> Array:
    """x, y, z, and red, green, blue or intensity behind them; NaN where a pixel measured nothing.

    Raises:
        InputError: no x, y, z, or fewer bytes than announced.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {f.name: f for f in message.fields}
    if not all(axis in fields for axis in "xyz"):
        raise InputError(f"{where}: a PointCloud2 without x, y, z; to fix: name another topic with --topic")
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [order + _KINDS.get(f.datatype, "u1") for f in fields.values()],
            "offsets": [f.offset for f in fields.values()],
            "itemsize": message.point_step,
        }
    )
    data = np.ascontiguousarray(message.data, np.uint8)
    if len(data) < message.row_step * message.height or message.row_step < message.point_step * message.width:
        raise InputError(f"{where}: a PointCloud2 is cut short; to fix: record it again")
    rows = data[: message.row_step * message.height].reshape(message.height, -1)
    points = np.ascontiguousarray(rows[:, : message.point_step * message.width]).view(layout)
    columns = [np.asarray(points[axis], float) for axis in "xyz"] + _brightness(points)
    table: Array = np.stack(columns, axis=-1).reshape(message.height, message.width, len(columns))
    return table if message.height > 1 else _without_empty_points(table[0])


def _brightness(points: NDArray[np.void]) -> list[Array]:
    names = points.dtype.names or ()
    for name in ("rgb", "rgba"):
        if name in names:
            bits = np.ascontiguousarray(points[name]).view(np.uint32)
            return [((bits >> shift) & 255).astype(float) for shift in (16, 8, 0)]
    return [np.asarray(points["intensity"], float)] if "intensity" in names else []


def _without_empty_points(table: Array) -> Array:
    return table[np.isfinite(table[:, :3]).all(axis=1) & table[:, :3].any(axis=1)]


def depth_array(message: Any, camera: Any, where: str) -> Array:
    """Return (H, W, 3) points of a depth image by its CameraInfo, m."""
    order = ">" if message.is_bigendian else "<"
    kind, scale = ("f4", 1.0) if message.encoding == "32FC1" else ("u2", _METRES_PER_MM)
    rows = np.ascontiguousarray(message.data, np.uint8).reshape(message.height, message.step)
    width = message.width * np.dtype(kind).itemsize
    z = np.ascontiguousarray(rows[:, :width]).view(order + kind).astype(float) * scale
    K, d = (getattr(camera, name, getattr(camera, name.upper(), ())) for name in "kd")  # in ROS 2, in ROS 1
    distortion = np.asarray(d, float) if np.any(d) else np.zeros(0)
    fx, cx, fy, cy = (float(K[i]) for i in (0, 2, 4, 5))
    lens = Intrinsics(Path(where), fx, fy, cx, cy, distortion, size=None, units_per_metre=None)
    return points_of_image(where, z, lens)


def write_bag_session(
    bag: Path, out: Path, topic: str | None = None, named: Sequence[str] = (), mount: str | None = None
) -> Made:
    """Write a session of a bag into a new folder, whole or not at all; lengths in mm.

    Args:
        topic: of the scans, where there are several.
        named: frames of base, flange and scanner, as a person states them.
        mount: eye_in_hand or eye_to_hand, likewise.

    Raises:
        InputError: no bag, no scans, several topics of them, no frame that moves, or fewer than three stops.
    """
    found = read_bag(bag)
    topic, of_topic = _choose_topic(bag, found, topic)
    tree = recorded_tree(found)
    told = identify_frames(tree, found.frame_of[topic], named)
    messages, times, T_base_flange, of_views = _choose_scans(bag, found, topic, tree, told)
    T_mount = _recorded_hand_eye(tree, told, times)
    of_poses = Guess("poses", f"{told.flange} in {told.base}", told.reason, True, "--frames")
    words = "not known" if T_mount is None else "as tf has it, to begin with"
    of_scanner = Guess("scanner.pose", words, f"of {told.scanner}", True, "session.toml")
    with whole_folder(out) as scratch:
        (scratch / "clouds").mkdir()
        _write_scans(bag, topic, found, messages, scratch / "clouds")
        robot, joints, of_joints = recorded_urdf(found, told, times, scratch)
        names = [f"v{i:03d}" for i in range(len(times))]
        columns: dict[str, Any] = {"view": names, "cloud": [f"clouds/{name}.npy" for name in names]}
        columns["time_s"] = [f"{t:.6f}" for t in times - times[0]]
        columns |= {f"j{i + 1}_deg": q for i, q in enumerate(np.degrees(joints).T)} if joints is not None else {}
        T = frames.make(T_base_flange[:, :3, :3], T_base_flange[:, :3, 3] * _MM_PER_METRE)
        write_table(scratch / "views.csv", columns | pose_columns(T))
        of_mount = _mount_guess(told, mount, [scratch / cloud for cloud in columns["cloud"]], T)
        guesses = (of_topic, of_poses, of_scanner, of_mount, of_views, of_joints)
        toml = _session_toml(bag, of_mount.value, T_mount, robot, guesses)
        (scratch / "session.toml").write_text(toml, encoding="utf-8")
    return Made(len(times), guesses, "run")


def _mount_guess(bag_frames: BagFrames, stated: str | None, clouds: Sequence[Path], T_base_flange: Array) -> Guess:
    """Return who carries the scanner: as stated, as tf has it, or as the scans move.

    Args:
        T_base_flange: (V, 4, 4) mm.
    """
    if stated is not None:
        return Guess("mount", stated, "stated with --mount", True, "--mount")
    if bag_frames.mount is not None:
        return Guess("mount", bag_frames.mount, bag_frames.reason, True, "--mount")
    nothing = np.zeros((len(clouds), 0))
    reading = Reading(T_base_flange, "matrix", None, ColumnLayout(nothing, nothing, None, "tf", length_unit="mm"), 0)
    capture = capture_of([read_cloud(cloud) for cloud in clouds], 1.0)
    in_order = Pairing(tuple(range(len(clouds))), "a scan a stop", True)
    decided = choose_convention(capture, cache(lambda: register_scan_pairs(capture)), [reading], [in_order], ["mm"])
    value = "eye_in_hand" if decided.best.interpretation.carries else "eye_to_hand"
    reason = f"{bag_frames.reason}, and the scans decide; {score_words(decided.best)}"
    return Guess("mount", value, reason, decided.determined, "--mount")


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
) -> tuple[dict[int, int], Array, Array, Guess]:
    """Return the view of each message that becomes one, times (V,) s, T_base_flange (V, 4, 4) m, and why."""
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
    return messages, ordered[views], at[views], guess


def _recorded_hand_eye(tree: TransformTree, bag_frames: BagFrames, times: Array) -> Array | None:
    """T_mount (4, 4) mm as tf has it; None where tf says nothing, or that both frames are one."""
    if not bag_frames.hand_eye_known:
        return None
    carrier = bag_frames.flange if bag_frames.mount == "eye_in_hand" else bag_frames.base
    T = tree.pose(carrier, bag_frames.scanner, times[:1])[0]
    if not np.isfinite(T).all() or np.allclose(T, np.eye(4)):
        return None
    return frames.make(T[:3, :3], T[:3, 3] * _MM_PER_METRE)


def _write_scans(bag: Path, topic: str, contents: BagContents, messages: dict[int, int], folder: Path) -> None:
    with open_bag(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic and c.msgtype in (CLOUD, IMAGE)]
        for number, (connection, _, raw) in enumerate(reader.messages(connections)):
            if number not in messages:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            where = f"{bag} {topic}"
            if connection.msgtype == CLOUD:
                array = cloud_array(message, where)
            else:
                array = depth_array(message, _camera_info(contents, topic, where), where)
            array[..., :3] *= _MM_PER_METRE
            np.save(folder / f"v{messages[number]:03d}.npy", array.astype(np.float32))


def _camera_info(contents: BagContents, topic: str, where: str) -> Any:
    beside = topic.rsplit("/", 1)[0] + "/camera_info"
    if beside not in contents.cameras:
        raise InputError(f"{where}: a depth image needs {beside}; to fix: record that topic too")
    return contents.cameras[beside]


def _session_toml(bag: Path, mount: str, T_mount: Array | None, robot: dict[str, str], guesses: Sequence[Guess]) -> str:
    head = {"format": SESSION_FORMAT, "name": bag.stem, "length_unit": "mm", "mount": mount}
    scanner = {} if T_mount is None else {"scanner": {"pose": T_mount.tolist()}}
    comments = "".join(f"# {guess.line}\n" for guess in guesses)
    return comments + "\n" + tomli_w.dumps({**head, **scanner, **({"robot": robot} if robot else {})})
