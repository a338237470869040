"""A driver in the place of the plant: applies flux density commands at their stamps."""

import math
import signal
import threading

from builtin_interfaces.msg import Time
from hardware import Hardware
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState, MagneticField

from hmsa_ros.middleware import prepare_middleware

SECOND = 1_000_000_000
COMMAND_TIMEOUT = 1 * SECOND  # without a word from the planner the coil is switched off
COIL_LIMIT = 0.5  # T


class CoilDriver(Node):
    """Keeps the schedule of commands, and carries it out in a thread of its own."""

    def __init__(self) -> None:
        super().__init__('driver')
        self.hardware = Hardware(self.now())
        self.schedule: list[tuple[int, float]] = []
        self.last_word = 0  # when the last command came; 0 until there is one
        self.changed = threading.Condition()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.applied = self.create_publisher(MagneticField, 'flux_density_applied', latched)
        self.states = self.create_publisher(JointState, 'joint_states', 1000)
        self.create_subscription(
            MagneticField, 'flux_density_command', self.on_command, 1000)
        self.create_timer(0.002, self.on_sample)
        self.level = math.nan
        self.apply(0.0)
        self.ending = False
        self.thread = threading.Thread(target=self.work)
        self.thread.start()

    def now(self) -> int:
        """Return the time in ns."""
        return self.get_clock().now().nanoseconds

    def on_command(self, command: MagneticField) -> None:
        """Put a command into the schedule."""
        level = command.magnetic_field.z
        if not abs(level) <= COIL_LIMIT:  # not a number is refused, too
            self.get_logger().error(f'{level} T refused: expected at most {COIL_LIMIT} T')
            return
        stamp = command.header.stamp.sec * SECOND + command.header.stamp.nanosec
        with self.changed:
            # A command supersedes all that are stamped at or after it.
            self.schedule = [x for x in self.schedule if x[0] < stamp] + [(stamp, level)]
            self.last_word = self.now()
            self.changed.notify()

    def work(self) -> None:
        """Apply what is due, sleep until the next; the watchdog is here, too."""
        while not self.ending:
            with self.changed:
                now = self.now()
                due = [level for stamp, level in self.schedule if stamp <= now]
                self.schedule = [x for x in self.schedule if x[0] > now]
                if self.last_word and now > self.last_word + COMMAND_TIMEOUT:
                    self.get_logger().error('no command for 1 s: the coil is switched off')
                    self.schedule, self.last_word, due = [], 0, [0.0]
                if not due:
                    soonest = min([now + SECOND // 10, *(x[0] for x in self.schedule)])
                    self.changed.wait((soonest - now) / SECOND)
                    continue
            self.apply(due[-1])

    def apply(self, level: float) -> None:
        """Set the coil, and tell what took effect when."""
        if level != self.level:  # the planner repeats itself as a sign of life
            self.level = level
            self.applied.publish(self.field(self.hardware.write(level, self.now()), level))

    def on_sample(self) -> None:
        """Publish what the sensor sees."""
        stamp = self.now()
        stretch, rate = self.hardware.read(stamp)
        message = JointState(name=['actuator'], position=[stretch], velocity=[rate])
        message.effort = [self.level]
        message.header.stamp = self.time(stamp)
        self.states.publish(message)

    def field(self, stamp: int, level: float) -> MagneticField:
        """Return a flux density along z as a message."""
        message = MagneticField()
        message.header.stamp = self.time(stamp)
        message.header.frame_id = 'coil'
        message.magnetic_field.z = level
        return message

    def time(self, stamp: int) -> Time:
        """Return a time in ns as a message."""
        return Time(sec=stamp // SECOND, nanosec=stamp % SECOND)


def main() -> None:
    """Run the driver until it is told to end."""
    # A signal is only noted: the coil is switched off below, whatever was under way.
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    prepare_middleware()  # what gets lost is sent again at once
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = CoilDriver()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not ended.is_set():
            executor.spin_once(0.1)
    finally:
        node.ending = True
        node.thread.join()
        node.hardware.write(0.0, node.now())


if __name__ == '__main__':
    main()
