"""The interlock of a running driver. Imports little, since a coil must go off at once."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import Bool

from hmsa.errors import HmsaError
from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import decode
from hmsa_ros.nodes.temporary_node import TemporaryNode

_CLOSED = 'closed'


class InterlockLink(TemporaryNode):
    """
    A link to the interlock of a driver; a context manager.

    Parameters
    ----------
    driver, namespace : str
        Name and namespace of the driver.
    timeout : float
        Time in s to wait for the driver, and then for its report.

    """

    def __init__(self, driver: str, namespace: str, timeout: float) -> None:
        super().__init__('interlock', namespace, timeout)
        self._driver = ros_entities.full_name(driver, namespace)
        self._publisher = ros_entities.publisher(self.node, topics.INTERLOCK, driver)
        self._reports = ros_entities.listen(self.node, topics.DIAGNOSTICS)
        #: Last statuses of the driver, by what they are about.
        self._statuses: dict[str, DiagnosticStatus] = {}

    def turn(self, *, closed: bool) -> None:
        """
        Open or close the interlock, and wait until the driver reports that it is.

        Raises
        ------
        HmsaError
            If there is no driver, or it does not report that: what to do.

        """
        off = '' if closed else ': switch the amplifier off'
        self.spin_until(
            self._listened, f'no driver {self._driver}: expected one that runs, with the same '
            f'ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE as here{off}',
            awaited=f'driver {self._driver}')

        def reported() -> bool:
            self._publisher.publish(Bool(data=closed))
            self._read()
            return 'interlock' in self._statuses and (self._said == _CLOSED) == closed

        try:
            self.spin_until(
                reported, f'the interlock of {self._driver} is not reported to be '
                f'{_CLOSED if closed else "open"}', awaited=f'a report of driver {self._driver}')
        except HmsaError as error:
            raise HmsaError(f'{error} (it is {self._said or "not reported"}){off}') from None
        if closed and self._required:
            raise HmsaError(
                f'{self._driver} has interlock_required: it opens again without a publisher that '
                'closes it repeatedly')
        if not closed and self._trouble:
            raise HmsaError(f'the interlock is open, but {self._trouble}{off}')

    def _listened(self) -> bool:
        """Return whether the driver subscribes to its interlock and this publisher reaches it."""
        return ros_entities.matched(self.node, self._publisher, self._driver)

    def _read(self) -> None:
        """Take the reports that have arrived; others have statuses of the same names."""
        names = ros_entities.publishers_of(self.node, topics.DIAGNOSTICS.name)
        for taken in self._reports.take():
            if names.get(taken.publisher) == self._driver:
                for status in decode(taken.data, DiagnosticArray).status:
                    self._statuses[status.name.rpartition(': ')[2]] = status

    @property
    def _said(self) -> str:
        """The state of the interlock according to the driver; empty before its first report."""
        found = self._statuses.get('interlock')
        return '' if found is None else str(found.message)

    @property
    def _required(self) -> bool:
        return any(x.key == 'required' and x.value == 'True'
                   for x in self._statuses['interlock'].values)

    @property
    def _trouble(self) -> str:
        found = self._statuses.get('hardware')
        return '' if found is None or found.level < DiagnosticStatus.ERROR else (
            str(found.message))
