"""What all nodes have that pass commands to a device and publish what comes of it."""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from hmsa_ros.contract.parameters import ParameterSpec
from hmsa_ros.device.health import judge_commands
from hmsa_ros.device.protocol import Change, Sample
from hmsa_ros.nodes import conversions
from hmsa_ros.nodes.device_joint import DeviceJoint
from hmsa_ros.nodes.guard import COMMAND_SOURCES
from hmsa_ros.nodes.joints import JointParameters
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.samples import SamplePublisher

COMMAND_SOURCE = ParameterSpec(
    'command_source', 'any',
    'Publishers whose commands are obeyed: any, or only the first until it disappears.',
    choices=COMMAND_SOURCES)
PUBLISH_SCALARS = ParameterSpec(
    'publish_scalars', 'auto',
    'Whether to publish stretch and stretch_rate besides joint_states; auto: only for a '
    'single joint.', choices=('auto', 'always', 'never'))

#: How often the time is looked at.
TICK_SECONDS = 0.001


class DeviceNode(ManagedNode):
    """
    Publishes what comes of a device in ``on_tick``; ``_go_on`` of a subclass lets it go on.

    A planner in the same process may give its commands directly; ``companion`` is its name then,
    and whoever links the two does what ``on_tick`` does.
    """

    companion = ''
    _values: JointParameters
    _device: Any
    _joints: Sequence[DeviceJoint] = ()

    def on_tick(self) -> None:
        """Take in the commands that have come, do what is due, and publish what comes of it."""
        self._hear()
        self._go_on()
        self._publish_news()

    def _hear(self) -> None:
        for joint in self._joints:
            joint.commands.poll()

    @abstractmethod
    def _go_on(self) -> None:
        """Let the device go on to the present time."""

    @property
    def leading_time(self) -> int | None:
        """Time in ns, if this device is the authority on it."""
        return None

    def _open(self, joint: type[DeviceJoint]) -> None:
        """Create the topics of samples and joints, and look at the time from now on."""
        scalars, names = self._values[PUBLISH_SCALARS.name], self._values.names
        self._samples = SamplePublisher(self, names, scalars=scalars == 'always' or (
            scalars == 'auto' and len(names) == 1))
        self._joints = [
            joint(self, self._device, i, names, self._values.of(x), self.companion)
            for i, x in enumerate(names)]
        self._publish_news()
        if not self.companion:
            self.every(TICK_SECONDS, self.on_tick)
        self.diagnose(self._report)

    def _report(self) -> Iterable[DiagnosticStatus]:
        yield self._status_of_commands()

    def cleanup(self) -> None:
        """Close the inputs that no executor serves."""
        for joint in self._joints:
            joint.commands.close()
        self._joints = ()

    def close(self) -> None:
        """End with the process."""
        self.cleanup()

    # -- what is published ---------------------------------------------------------------------

    def _publish_news(self) -> None:
        """Publish what has come of the device since the last time."""
        for notice in self._device.notices():
            self._joints[notice.joint].log(notice)
        for change in self._device.changes():
            self._publish_change(change)
        for sample in self._device.samples():
            self._publish_sample(sample)

    def _publish_change(self, change: Change) -> None:
        self._joints[change.joint].publish_applied(change)

    def _publish_sample(self, sample: Sample) -> None:
        self._samples.publish(sample)

    def _status_of_commands(self, **values: object) -> DiagnosticStatus:
        """Return how commands fare, with more values."""
        joints = self._joints
        counts = {
            'late': sum(x.late for x in joints),
            'refused': sum(x.refused + x.commands.unreadable for x in joints),
            'refused_source': sum(x.commands.refused for x in joints),
            'failed': sum(x.failed for x in joints)}
        silent = [joints[i].name for i in self._device.silent]
        level, message = judge_commands(
            **counts, silent=silent, crowded=[x.name for x in joints if x.crowded()])
        return conversions.to_status(
            f'{self.get_name()}: commands', ', '.join(x.name for x in joints),
            level, message,
            {'received': sum(x.received for x in joints), **counts,
             'largest_lateness_ms': f'{max(x.latest for x in joints) / 1e6:.3f}',
             'timeouts': self._device.trips, 'silent': len(silent),
             'time': f'{self._device.time / 1e9:.9f}', **values})
