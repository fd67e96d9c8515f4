"""The ROS 2 example fed with a recorded bag as the node would see it; ROS itself is played by stand-ins."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import stitch
from data_synth.fixtures.blade_cells import measured_blade
from stitch.numerics import frames
from tests.plugins.intake.test_ros_bag import Messages

rosbag2 = pytest.importorskip("rosbags.rosbag2")
ROS2 = Path(__file__).resolve().parents[1] / "examples" / "ros2"
KINDS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "points": "sensor_msgs/msg/PointCloud2",
}
VIEWS, STAND, MOVE, START = 6, 1.0, 1.0, 100.0
MM = 1e-3


@pytest.fixture(scope="module")
def measured():
    return measured_blade(0, views=VIEWS, mount="eye_in_hand", pixels=50)


def in_metres(T):
    return frames.make(T[:3, :3], T[:3, 3] * MM)


def pose_at(measured, time):
    """T_base_flange, m: a second at each view, a second on the way to the next."""
    leg, rest = divmod(time, STAND + MOVE)
    here, there = (in_metres(measured.T_base_flange[min(int(leg) + k, VIEWS - 1)]) for k in (0, 1))
    share = max(rest - STAND, 0.0) / MOVE
    return here @ frames.exp(share * frames.log(frames.inverse(here) @ there))


@pytest.fixture(scope="module")
def bag(measured, tmp_path_factory):
    """A recorded bag: transforms at 20 Hz, a scan twice at each stop and once on each way."""
    messages, path = Messages(ros1=False), tmp_path_factory.mktemp("ros") / "bag"
    with rosbag2.Writer(path, version=9) as writer:
        topics = {name: writer.add_connection(name, kind, typestore=messages.store) for name, kind in KINDS.items()}

        def put(topic, time, message):
            writer.write(topics[topic], round(time * 1e9), messages.store.serialize_cdr(message, KINDS[topic]))

        put("/tf_static", START, messages.tf(START, ("flange", "tool0", np.eye(4))))
        for tick in range(int(20 * VIEWS * (STAND + MOVE))):
            time = tick / 20
            put("/tf", START + time, messages.tf(START + time, ("base_link", "flange", pose_at(measured, time))))
            leg, rest = divmod(time, STAND + MOVE)
            if round(20 * rest) in (8, 12, 30):
                points = measured.clouds[int(leg)].points[:, None] * MM
                put("points", START + time, messages.cloud(START + time, points, organised=False))
    return messages.store, path


def messages_of(bag):
    store, path = bag
    with rosbag2.Reader(path) as reader:
        for connection, _, raw in reader.messages():
            yield connection.topic, store.deserialize_cdr(raw, connection.msgtype)


@pytest.fixture
def ros(monkeypatch):
    """Stand-ins for the packages of ROS that the node imports."""

    class Message(SimpleNamespace):
        """Any message: parts that nobody has set are messages of their own."""

        def __getattr__(self, name):
            if name.startswith("_"):
                raise AttributeError(name)
            setattr(self, name, Message())
            return getattr(self, name)

    class Node:
        def __init__(self, name):
            self.heard, self.timers, self.services, self.published = {}, [], {}, []

        def declare_parameter(self, name, value):
            return SimpleNamespace(value=value)

        def create_subscription(self, kind, topic, call, depth):
            self.heard[topic] = call

        def create_service(self, kind, name, call):
            self.services[name] = call

        def create_timer(self, seconds, call):
            self.timers.append(call)

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

        def get_clock(self):
            return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

    class Broadcaster:
        def __init__(self, node):
            self.sent = []
            self.sendTransform = self.sent.append

    class Status(Message):
        OK, WARN, ERROR = b"\0", b"\1", b"\2"

    modules = {
        "rclpy": {"init": None, "spin": None},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1), "QoSProfile": Message},
        "diagnostic_msgs.msg": {"DiagnosticArray": Message, "DiagnosticStatus": Status},
        "geometry_msgs.msg": {"TransformStamped": Message},
        "sensor_msgs.msg": {"PointCloud2": Message},
        "std_srvs.srv": {"Trigger": Message},
        "tf2_msgs.msg": {"TFMessage": Message},
        "tf2_ros": {"StaticTransformBroadcaster": Broadcaster},
    }
    for name, content in modules.items():
        for module in {name.partition(".")[0], name}:
            monkeypatch.setitem(sys.modules, module, sys.modules.get(module, ModuleType(module)))
        vars(sys.modules[name]).update(content)
    monkeypatch.syspath_prepend(str(ROS2))


def test_a_recorded_cell_becomes_a_view_a_stop_and_its_hand_eye_goes_to_tf(bag, measured, ros, tmp_path, monkeypatch):
    from stitch_ros.node import LiveCellNode

    monkeypatch.chdir(tmp_path)
    node = LiveCellNode()
    for topic, message in messages_of(bag):
        node.heard[topic](message)
        for call in node.timers:
            call()
    said = [message.status[0] for topic, message in node.published if topic == "/diagnostics"]
    assert len(said) == VIEWS and all(status.level == b"\0" for status in said)
    answer = node.services["~/finish"](None, SimpleNamespace())
    assert answer.success, answer.message
    sent = node.broadcaster.sent[-1]
    assert (sent.header.frame_id, sent.child_frame_id) == ("tool0", "camera")

    # Nothing but the digits of a PointCloud2 and the interpolation of tf lies between it and the arrays themselves.
    clouds = [cloud.points * MM for cloud in measured.clouds]
    poses = [in_metres(T) for T in measured.T_base_flange]
    batch = stitch.run(stitch.Session.from_arrays(clouds, poses, mount="eye_in_hand", unit="m"))
    shift = sent.transform.translation
    apart = np.array([shift.x, shift.y, shift.z]) - batch.hand_eye.pose[:3, 3]
    assert np.linalg.norm(apart) < 0.05 * batch.hand_eye.U.mm * MM
    assert {"model.toml", "stitched.ply"} <= {path.name for path in (tmp_path / "runs" / "ros").iterdir()}
    assert stitch.load_session(tmp_path / "runs" / "ros-session").names == batch.session.names


def test_what_cannot_be_used_is_a_diagnostic_and_the_cell_goes_on(bag, ros):
    from stitch_ros.node import LiveCellNode

    node = LiveCellNode()
    for topic, message in messages_of(bag):
        if topic == "points":
            message.fields[0].name = "range"
        node.heard[topic](message)
        node.timers[0]()
    said = [message.status[0] for _, message in node.published]
    assert said and {status.level for status in said} == {b"\2"}
    assert "without x, y, z" in said[0].message
    answer = node.services["~/finish"](None, SimpleNamespace())
    assert not answer.success and answer.message
