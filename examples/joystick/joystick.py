"""
Turns a joystick (sensor_msgs/Joy) into setpoints of the planner.

    ros2 run joy joy_node
    python examples/joystick/joystick.py --ros-args -p center:=1.1 -p amplitude:=0.1

One axis moves the stretch about the center. A second one, as of a throttle, scales the amplitude.
A button stops the actuator; it moves again once the axis is moved.
"""

import math

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Joy
from std_msgs.msg import Float64
from std_srvs.srv import Trigger


class Joystick(Node):
    """From ``joy`` to ``planner/setpoint`` and ``planner/stop``."""

    def __init__(self) -> None:
        super().__init__('joystick')
        self._axis, self._throttle, self._button, self._center, self._amplitude, self._step = (
            self.declare_parameter(name, default).value for name, default in (
                ('axis', 1), ('throttle_axis', -1), ('stop_button', 0),
                ('center', 1.1), ('amplitude', 0.1), ('step', 1e-3)))
        # Smaller changes than a step are noise, and each setpoint is a move.
        self._last = math.nan
        self._pressed = False
        self._setpoint = self.create_publisher(Float64, 'planner/setpoint', 10)
        self._stop = self.create_client(Trigger, 'planner/stop')
        self.create_subscription(Joy, 'joy', self._on_joy, 10)

    def _on_joy(self, message: Joy) -> None:
        pressed = self._button < len(message.buttons) and bool(message.buttons[self._button])
        stretch = self._wanted(message.axes)
        if pressed and not self._pressed:
            self._stop.call_async(Trigger.Request())
            self._last = stretch
        self._pressed = pressed
        if not pressed and not abs(stretch - self._last) < self._step and math.isfinite(stretch):
            self._last = stretch
            self._setpoint.publish(Float64(data=stretch))

    def _wanted(self, axes: list[float]) -> float:
        """Return the stretch that axes ask for; NaN where one is missing."""
        if max(self._axis, self._throttle) >= len(axes):
            self.get_logger().warning(
                f'{len(axes)} axes: expected axis {max(self._axis, self._throttle)} too',
                throttle_duration_sec=5.0)
            return math.nan
        share, throttle = (
            max(-1.0, min(1.0, axes[x])) if math.isfinite(axes[x]) else math.nan
            for x in (self._axis, self._throttle))
        scale = 1.0 if self._throttle < 0 else 0.5 + 0.5 * throttle
        return self._center + self._amplitude * scale * share


def main() -> None:
    """Run until the process is told to end."""
    try:
        rclpy.init()
        rclpy.spin(Joystick())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == '__main__':
    main()
