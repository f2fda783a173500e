"""A node that writes a row whenever a point is measured while the arm stands.

ros2 run minimax_cal_ros2 record --ros-args -p targets:="[smr1,smr2]" -p path:=poses.csv

Topics: /joint_states (sensor_msgs/JointState) and /measured/TARGET (geometry_msgs/PointStamped, in
the tracker's frame, metres), one for each target.  A row is finished when the arm moves on.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from minimax_cal_ros2.sheet import Rest, header, row


def main() -> None:
    """Record until Ctrl-C."""
    import rclpy
    from geometry_msgs.msg import PointStamped
    from rclpy.node import Node
    from sensor_msgs.msg import JointState

    class Record(Node):  # type: ignore[misc]
        """Joint states and points to a file."""

        def __init__(self) -> None:
            super().__init__("minimax_cal_record")
            names = self.declare_parameter("joints", [f"joint_{i}" for i in range(1, 7)]).value
            slides = set(self.declare_parameter("slides", [""]).value)
            self.targets = list(self.declare_parameter("targets", ["smr1"]).value)
            self.path = Path(self.declare_parameter("path", "poses.csv").value)
            if self.path.exists():
                raise FileExistsError(f"{self.path} is there already; give another path")
            self.rest, self.points, self.pose = Rest(names), {}, 0
            self.path.write_text(header([n in slides for n in names], self.targets) + "\n")
            self.create_subscription(JointState, "/joint_states", self.stood, 50)
            for target in self.targets:
                topic = f"/measured/{target}"
                self.create_subscription(PointStamped, topic, partial(self.measured, target), 10)

        def stood(self, state: JointState) -> None:
            """A joint state; a pose ends where the arm moves on."""
            stamp = state.header.stamp
            before = self.rest.joints()
            self.rest.hear(stamp.sec + 1e-9 * stamp.nanosec, state.name, state.position)
            if before is not None and self.rest.joints() is None and self.points:
                self.pose += 1
                with self.path.open("a") as stream:
                    stream.write(row(self.pose, before, self.points, self.targets) + "\n")
                self.get_logger().info(f"pose {self.pose}: {', '.join(self.points)}")
                self.points = {}

        def measured(self, target: str, point: PointStamped) -> None:
            """A point; while the arm moves it is none."""
            if self.rest.joints() is None:
                self.get_logger().warning(f"{target} was measured while the arm moved; left out")
                return
            self.points[target] = (point.point.x, point.point.y, point.point.z)

    rclpy.init()
    rclpy.spin(Record())
