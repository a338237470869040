"""Passes the stretches that ros2_control commands on to the planner, as setpoints."""

import math

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64


class Bridge(Node):
    """From ``joint_commands`` to ``planner/setpoint``, what changes anything."""

    def __init__(self) -> None:
        super().__init__('bridge')
        self._joint = self.declare_parameter('joint', 'actuator').value
        self._last = math.nan
        self._setpoint = self.create_publisher(Float64, 'planner/setpoint', 10)
        self.create_subscription(JointState, 'joint_commands', self._on_command, 10)

    def _on_command(self, message: JointState) -> None:
        positions = dict(zip(message.name, message.position, strict=False))
        stretch = positions.get(self._joint, math.nan)
        if math.isfinite(stretch) and stretch != self._last:
            self._last = stretch
            self._setpoint.publish(Float64(data=stretch))


def main() -> None:
    """Run until the process is told to end."""
    try:
        rclpy.init()
        rclpy.spin(Bridge())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == '__main__':
    main()
