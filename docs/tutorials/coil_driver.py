"""A driver in the place of the plant: applies flux density commands at their stamps."""

import signal
import threading

from hardware import Bench
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState, MagneticField

from hmsa_ros.device.hardware import HardwareDevice, HardwareJoint
from hmsa_ros.device.watchdog import Fallback
from hmsa_ros.errors import BadInputError
from hmsa_ros.middleware import prepare_middleware
from hmsa_ros.nodes.conversions import from_command, to_command, to_time

SECOND = 1_000_000_000
PERIOD = SECOND // 500  # of the samples
COIL_LIMIT = 0.5  # T
# Without a word from the planner for a second the coil is switched off.
FALLBACK = Fallback(timeout=1.0, safe_flux='zero')


class CoilDriver(Node):
    """Passes commands to a device, which a thread of its own advances."""

    def __init__(self) -> None:
        super().__init__('driver')
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.applied = self.create_publisher(MagneticField, 'flux_density_applied', latched)
        self.states = self.create_publisher(JointState, 'joint_states', 1000)
        self.device = HardwareDevice(
            [HardwareJoint(Bench(self.now()), COIL_LIMIT, FALLBACK)],
            time=self.now(), period=PERIOD)
        self.changed = threading.Condition()
        self.ending = False
        self.create_subscription(
            MagneticField, 'flux_density_command', self.on_command, 1000)
        self.thread = threading.Thread(target=self.work)
        self.thread.start()

    def now(self) -> int:
        """Return the time in ns."""
        return self.get_clock().now().nanoseconds

    def on_command(self, command: MagneticField) -> None:
        """Pass a command on."""
        try:
            with self.changed:
                self.device.receive(0, *from_command(command))
                self.changed.notify()
        except BadInputError as error:
            self.get_logger().error(f'command refused: {error}')

    def work(self) -> None:
        """Advance the device whenever something is due, and sleep until then."""
        while not self.ending:
            with self.changed:
                self.device.advance(self.now())
                self.publish()
                left = self.device.due - self.now()
                if left > 0:
                    self.changed.wait(left / SECOND)

    def publish(self) -> None:
        """Publish what has come of the device."""
        for change in self.device.changes():
            self.applied.publish(to_command(change.stamp, change.level, 'coil'))
        for sample in self.device.samples():
            message = JointState(name=['actuator'])
            message.header.stamp = to_time(sample.time)
            message.position = sample.stretch.tolist()
            message.velocity = sample.rate.tolist()
            message.effort = sample.flux_density.tolist()
            self.states.publish(message)
        for notice in self.device.notices():
            self.get_logger().error(notice.text)

    def close(self) -> None:
        """End the thread and switch the coil off."""
        self.ending = True
        self.thread.join()
        self.device.switch_off(self.now())


def main() -> None:
    """Run the driver until it is told to end."""
    # A signal is only noted: the coil is switched off below, whatever was under way.
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
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
        node.close()


if __name__ == '__main__':
    main()
