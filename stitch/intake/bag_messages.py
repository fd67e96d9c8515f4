"""What a bag of ROS 1 or 2, or an MCAP file, recorded of an arm and a scanner (rosbags)."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch import frames
from stitch.errors import InputError
from stitch.intake.transform_tree import Recording
from stitch.reading.extras import import_extra
from stitch.reading.text_file import shortened

CLOUD, IMAGE, CAMERA = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_JOINTS, _TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
_DEPTH = ("16UC1", "32FC1", "mono16")


@dataclass
class BagContents:
    """Everything but the scans themselves; times in s, lengths in m, angles in rad."""

    edges: list[Recording]  # of tf
    scans: dict[str, list[float]]  # by topic the time of every cloud or depth image
    frame_of: dict[str, str]  # by topic the frame of its scans
    joints: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    urdf: str | None = None
    cameras: dict[str, Any] = field(default_factory=dict)  # by topic the last CameraInfo


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
                out.edges += [_transform_recording(t, "static" in topic) for t in message.transforms]
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


def _transform_recording(message: Any, static: bool) -> Recording:
    turn, shift = message.transform.rotation, message.transform.translation
    R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    T = frames.make(R, np.array([shift.x, shift.y, shift.z]))
    parent, child = _frame_name(message.header.frame_id), _frame_name(message.child_frame_id)
    return message_time(message.header, 0), parent, child, T, static


def _frame_name(frame: str) -> str:
    return frame.lstrip("/")
