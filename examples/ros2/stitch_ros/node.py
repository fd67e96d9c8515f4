"""ROS 2 node: clouds and tf in; the hand-eye to tf_static, verdicts as diagnostics; `~/finish` runs and saves."""

from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from tf2_ros import StaticTransformBroadcaster

from stitch import StitchError
from stitch_ros.live_cell import LiveCell


class LiveCellNode(Node):
    """Feeds a LiveCell and publishes what it says."""

    def __init__(self) -> None:
        super().__init__("stitch")
        stated = {"base": "base_link", "flange": "tool0", "mount": "eye_in_hand", "cloud": "points", "run": "runs/ros"}
        self.stated = {name: self.declare_parameter(name, value).value for name, value in stated.items()}
        self.cell = LiveCell(self.stated["base"], self.stated["flange"], self.stated["mount"])
        kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(TFMessage, "/tf", self.cell.hear, 100)
        self.create_subscription(TFMessage, "/tf_static", lambda message: self.cell.hear(message, static=True), kept)
        self.create_subscription(PointCloud2, self.stated["cloud"], self.cell.see, 10)
        self.create_service(Trigger, "~/finish", self.finish)
        self.create_timer(0.2, self.judge)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.broadcaster = StaticTransformBroadcaster(self)

    def judge(self) -> None:
        """Publish the verdicts that have come, and the hand-eye so far."""
        try:
            for said in self.cell.judged():
                level = DiagnosticStatus.WARN if said.verdict == "does_not_belong" else DiagnosticStatus.OK
                self.publish(level, str(said))
                self.publish_hand_eye()
        except StitchError as error:
            self.publish(DiagnosticStatus.ERROR, str(error))

    def publish(self, level: Any, text: str) -> None:
        """Publish one line as a diagnostic."""
        status = DiagnosticStatus(level=level, name="stitch", message=text, hardware_id=self.cell.scanner)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(message)

    def publish_hand_eye(self) -> None:
        """Publish the hand-eye so far, where there is one."""
        known = self.cell.hand_eye()
        if known is None:
            return
        message = TransformStamped(child_frame_id=known[1])
        message.header.frame_id, message.header.stamp = known[0], self.get_clock().now().to_msg()
        shift, turn = message.transform.translation, message.transform.rotation
        shift.x, shift.y, shift.z = known[2][:3, 3].tolist()
        turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(known[2][:3, :3]).as_quat().tolist()
        self.broadcaster.sendTransform(message)

    def finish(self, _: Any, answer: Any) -> Any:
        """Run all views and write run and session."""
        try:
            run = self.cell.finish(Path(self.stated["run"]))
            answer.success, answer.message = True, str(run).splitlines()[0]
            self.publish_hand_eye()
        except StitchError as error:
            answer.success, answer.message = False, str(error)
        return answer


def main() -> None:
    """Spin until the process is ended."""
    rclpy.init()
    rclpy.spin(LiveCellNode())
