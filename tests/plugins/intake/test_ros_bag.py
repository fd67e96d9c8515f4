"""Bags written by rosbags, ROS 1, ROS 2 and MCAP: the arm stops four times, the scanner streams."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stitch.errors import InputError
from stitch.numerics import frames
from stitch.plugins.intake.detection.range_image import read_range_image
from stitch.plugins.intake.ros_bag import TransformTree, find_bag, write_bag_session
from stitch.session.reading.session_folder import load_session
from tests.command_line import ended

rosbag1, rosbag2 = pytest.importorskip("rosbags.rosbag1"), pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

URDF = """<robot name="r"><link name="base_link"/><link name="link1"/><link name="link2"/><link name="tool0"/>
<joint name="elbow" type="revolute"><parent link="link1"/><child link="link2"/><origin xyz="0.4 0 0" rpy="0 0 0"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="shoulder" type="revolute"><parent link="base_link"/><child link="link1"/><origin xyz="0 0 0.3" rpy="0 0 0"/>
<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="flange" type="fixed"><parent link="link2"/><child link="tool0"/><origin xyz="0.3 0 0" rpy="0 0 0"/></joint>
</robot>"""
# tool0 in link2, the camera in tool0, m.
T_LINK2_TOOL0 = frames.make(np.eye(3), np.array([0.3, 0, 0]))
T_TOOL0_CAMERA = frames.make(Rotation.from_euler("x", 0.3).as_matrix(), np.array([0.0, 0.05, 0.1]))
STOPS = np.array([[0.0, 0.0], [0.5, 0.2], [-0.4, 0.5], [0.9, -0.3]])
STAND, MOVE, RATE = 1.0, 1.0, 5


def turned(joints):
    """T_base_link1 and T_link1_link2."""
    shoulder = frames.make(Rotation.from_euler("z", joints[0]).as_matrix(), np.array([0, 0, 0.3]))
    return shoulder, frames.make(Rotation.from_euler("y", joints[1]).as_matrix(), np.array([0.4, 0, 0]))


def flange(joints):
    first, second = turned(joints)
    return first @ second @ T_LINK2_TOOL0


def joints_at(time):
    """Stands for a second, moves for a second."""
    leg, rest = int(time // (STAND + MOVE)), time % (STAND + MOVE)
    a, b = STOPS[min(leg, 3)], STOPS[min(leg + 1, 3)]
    return a + (b - a) * max(rest - STAND, 0) / MOVE


class Messages:
    """The messages of one version of ROS."""

    def __init__(self, ros1):
        store = typesys.Stores.ROS1_NOETIC if ros1 else typesys.Stores.ROS2_HUMBLE
        self.store, self.ros1 = typesys.get_typestore(store), ros1
        if ros1:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(typesys.get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))

    def make(self, kind, /, **values):
        return self.store.types[kind](**values)

    def header(self, time, frame):
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(time), nanosec=round((time % 1) * 1e9))
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def tf(self, time, *edges):
        moves = []
        for parent, child, T in edges:
            q = frames.to_quaternion(T[None])[0]
            shift = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
            turn = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True)))
            moved = self.make("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
            head = self.header(time, parent)
            moves.append(
                self.make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
            )
        return self.make("tf2_msgs/msg/TFMessage", transforms=moves)

    def joints(self, time, joints):
        nothing = np.zeros(0)
        # Sorted by name, as drivers do.
        return self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(time, ""),
            name=["elbow", "shoulder"],
            position=joints[::-1].copy(),
            velocity=nothing,
            effort=nothing,
        )

    def cloud(self, time, points, organised):
        """Points (H, W, 3) with intensity 7, after a padding of four bytes."""
        kind = self.store.types["sensor_msgs/msg/PointField"]
        fields = [
            kind(name=n, offset=o, datatype=7, count=1) for n, o in (("x", 0), ("y", 4), ("z", 8), ("intensity", 16))
        ]
        table = np.zeros((*points.shape[:2], 5), np.float32)
        table[..., :3], table[..., 4] = points, 7
        H, W = points.shape[:2] if organised else (1, points.shape[0] * points.shape[1])
        data = np.frombuffer(table.tobytes(), np.uint8)
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(time, "camera"),
            height=H,
            width=W,
            fields=fields,
            is_bigendian=False,
            point_step=20,
            row_step=20 * W,
            data=data,
            is_dense=False,
        )

    def depth(self, time, depth):
        data = np.frombuffer(depth.astype("<u2").tobytes(), np.uint8)
        H, W = depth.shape
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time, "camera"),
            height=H,
            width=W,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * W,
            data=data,
        )

    def camera(self, time):
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        K, R, P = (np.array(m, float).ravel() for m in ([[100, 0, 7], [0, 100, 5], [0, 0, 1]], np.eye(3), np.eye(3, 4)))
        names = {"D": np.zeros(5), "K": K, "R": R, "P": P}
        named = names if self.ros1 else {name.lower(): value for name, value in names.items()}
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(time, "camera"),
            height=12,
            width=16,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **named,
        )


def surface(time):
    """(12, 16, 3) m; its height says when it was seen."""
    v, u = np.mgrid[:12, :16] / 100
    points = np.dstack([u, v, 0 * u + 0.5 + time / 100])
    points[0, 0] = np.nan
    return points


def write(path, kind, organised=True, urdf=True, camera_fixed=False, depth=False, moving_tf=True):
    """A bag with tf at 25 Hz, joint states at half of it and clouds at 5 Hz, 100 s after the epoch."""
    ros1 = kind == "ros1"
    messages, start = Messages(ros1), 100.0
    if ros1:
        writer = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    kinds = {
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/joint_states": "sensor_msgs/msg/JointState",
    }
    kinds |= (
        {"/cam/depth": "sensor_msgs/msg/Image", "/cam/camera_info": "sensor_msgs/msg/CameraInfo"}
        if depth
        else {"/cam/points": "sensor_msgs/msg/PointCloud2"}
    )
    kinds |= {"/robot_description": "std_msgs/msg/String"} if urdf else {}
    with writer:
        topics = {topic: writer.add_connection(topic, name, typestore=messages.store) for topic, name in kinds.items()}

        def put(topic, time, message):
            serialise = messages.store.serialize_ros1 if ros1 else messages.store.serialize_cdr
            writer.write(topics[topic], round(time * 1e9), serialise(message, kinds[topic]))

        carrier = "base_link" if camera_fixed else "tool0"
        put(
            "/tf_static",
            start,
            messages.tf(
                start,
                ("link2", "tool0", T_LINK2_TOOL0),
                (carrier, "camera", T_TOOL0_CAMERA),
                ("world", "base_link", np.eye(4)),
            ),
        )
        if urdf:
            put("/robot_description", start, messages.make("std_msgs/msg/String", data=URDF))
        for tick in range(int(25 * (4 * STAND + 3 * MOVE))):
            time = tick / 25
            joints = joints_at(time)
            first, second = turned(joints)
            if moving_tf:
                put(
                    "/tf",
                    start + time,
                    messages.tf(start + time, ("base_link", "link1", first), ("link1", "link2", second)),
                )
            if tick % 2 == 0:
                put("/joint_states", start + time, messages.joints(start + time, joints))
            if tick % (25 // RATE) == 0:
                if depth:
                    image = np.full((12, 16), 600, np.uint16)
                    image[0, 0] = 0
                    put("/cam/camera_info", start + time, messages.camera(start + time))
                    put("/cam/depth", start + time, messages.depth(start + time, image))
                else:
                    put("/cam/points", start + time, messages.cloud(start + time, surface(time), organised))
    return path if ros1 or kind == "ros2" else next(path.glob("*.mcap"))


@pytest.mark.parametrize(("kind", "organised"), [("ros1", True), ("ros2", False), ("mcap", True)])
def test_a_view_for_each_stop_with_pose_joints_and_hand_eye(tmp_path, kind, organised):
    bag = write(tmp_path / ("b.bag" if kind == "ros1" else "b"), kind, organised)
    made = write_bag_session(bag, tmp_path / "s")
    session = load_session(tmp_path / "s")
    assert made.views == len(session.views) == 4 and session.mount == "eye_in_hand"
    for view, joints in zip(session.views, STOPS, strict=True):
        T = flange(joints)
        assert view.T_base_flange[:3, 3] == pytest.approx(1000 * T[:3, 3], abs=1e-4)
        assert frames.angle_between(view.T_base_flange[None], T[None])[0] < 1e-6
        assert view.joints == pytest.approx(joints, abs=1e-6)
        # All but the empty pixel, and the one cloud that was taken then.
        assert len(view.cloud.points) == 12 * 16 - 1
        assert np.ptp(view.cloud.points[:, 2]) == 0
        seen_at = (view.cloud.points[0, 2] - 500) / 10
        assert joints_at(seen_at) == pytest.approx(joints)
    T = T_TOOL0_CAMERA.copy()
    T[:3, 3] *= 1000
    assert np.allclose(session.scanner.T_mount, T, atol=1e-6)
    assert session.robot.n_joints == 2
    image = read_range_image(tmp_path / "s/clouds/v000.npy")
    assert (image is None) != organised


def test_a_camera_that_stands_in_the_cell(tmp_path):
    bag = write(tmp_path / "b", "ros2", urdf=False, camera_fixed=True)
    told = ended("init", bag)
    assert "mount: eye_to_hand" in told.out
    session = load_session(tmp_path / "b-session")
    assert session.mount == "eye_to_hand" and session.joints is None
    assert session.views[1].T_base_flange[:3, 3] == pytest.approx(1000 * flange(STOPS[1])[:3, 3], abs=1e-4)


def test_joint_states_and_urdf_where_tf_of_the_arm_was_not_recorded(tmp_path):
    write_bag_session(write(tmp_path / "b.bag", "ros1", moving_tf=False), tmp_path / "s")
    session = load_session(tmp_path / "s")
    assert session.mount == "eye_in_hand" and len(session.views) == 4
    for view, joints in zip(session.views, STOPS, strict=True):
        assert view.T_base_flange[:3, 3] == pytest.approx(1000 * flange(joints)[:3, 3], abs=1e-4)


def test_depth_images_of_a_bag(tmp_path):
    write_bag_session(write(tmp_path / "b.bag", "ros1", depth=True), tmp_path / "s")
    points = load_session(tmp_path / "s").views[2].cloud.points
    assert len(points) == 191 and np.allclose(points[:, 2], 600)
    # Row 11, column 15 of K = (100, 100, 7, 5).
    assert np.allclose(points[-1], [8 * 6, 6 * 6, 600])


def test_frames_are_chained_and_interpolated():
    half = frames.make(Rotation.from_euler("z", 0.5).as_matrix(), np.array([0.5, 0, 0]))
    whole = frames.make(Rotation.from_euler("z", 1.0).as_matrix(), np.array([1.0, 0, 0]))
    up = frames.make(np.eye(3), np.array([0, 0, 2.0]))
    tree = TransformTree(
        [
            (1.0, "a", "b", whole, False),
            (0.0, "a", "b", np.eye(4), False),
            (0.0, "b", "c", up, True),
            (0.0, "a", "d", up, True),
        ]
    )
    assert np.allclose(tree.pose("a", "c", np.array([0.5]))[0], half @ up)
    assert np.allclose(tree.pose("d", "c", np.array([1.0]))[0], frames.inverse(up) @ whole @ up)
    assert np.isnan(tree.pose("a", "b", np.array([3.0]))).all()
    with pytest.raises(InputError, match="no chain leads from a to e"):
        tree.pose("a", "e", np.array([0.0]))


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("bag") / "b.bag", "ros1")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--topic", "/nothing"), "use /cam/points"),
        (("--frames", "base_link"), "name base and flange"),
        (("--frames", "base_link,tool9"), "tf has no tool9"),
    ],
)
def test_what_a_bag_does_not_have_is_refused_in_one_line(bag, tmp_path, arguments, told):
    printed = ended("init", bag, "-o", tmp_path / "s", *arguments, code=2)
    assert told in printed.err and len(printed.err.strip().splitlines()) == 1
    assert not (tmp_path / "s").exists()


def test_broken_bags_end_in_one_line(tmp_path):
    (tmp_path / "b.bag").write_bytes(b"#ROSBAG V2.0\nnothing")
    (tmp_path / "b.mcap").write_bytes(b"nothing")
    for name in ("b.bag", "b.mcap"):
        told = ended("init", tmp_path / name, code=2).err
        assert "cannot be read as a bag" in told and len(told.strip().splitlines()) == 1


def test_a_bag_alone_in_a_folder_is_found_and_one_of_two_is_not(tmp_path):
    (tmp_path / "drive").mkdir()
    for name in ("metadata.yaml", "drive.db3"):
        (tmp_path / "drive" / name).touch()
    assert find_bag(tmp_path) == find_bag(tmp_path / "drive") == tmp_path / "drive"
    (tmp_path / "later.mcap").touch()
    assert find_bag(tmp_path) is None
