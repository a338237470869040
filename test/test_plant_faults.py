"""The plant under faults: silence, unknown publishers, clocks, delays, noise, disturbances."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from hmsa.interfaces import topics
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import from_time, to_clock, to_command, to_time
from hmsa_ros.nodes.plant import PlantNode
from hmsa_ros.nodes.ros_entities import interface_class

pytestmark = pytest.mark.ros

MS = 1_000_000
START = 1000 * MS
LEADING = ('-p', 'publish_clock:=true', '-p', 'start_paused:=true')
EVERY = QoSProfile(depth=200_000)


class Stand:
    """A plant that publishes time and advances by steps, and its reports."""

    def __init__(self, ros: Any, *, node: str = 'plant', subscribers: int = 1) -> None:
        self.ros = ros
        self.node = node
        self.samples = ros.collect(topics.JOINT_STATES.type, topics.JOINT_STATES.name, EVERY)
        applied = topics.FLUX_DENSITY_APPLIED
        self.applied = ros.collect(applied.type, applied.name, applied.qos)
        self.reports = ros.collect(topics.DIAGNOSTICS)
        command = topics.FLUX_DENSITY_COMMAND
        self.publisher = ros.publisher(command.type, command.name, command.qos, subscribers)
        ros.spin_until(lambda: self.applied, 'the level at the start')

    def send(self, *commands: tuple[int, float], publisher: Any = None) -> None:
        """Send commands, and return when the plant has received them."""
        from rclpy.duration import Duration
        publisher = publisher or self.publisher
        for stamp, flux_density in commands:
            publisher.publish(to_command(stamp, flux_density, ''))
        assert publisher.wait_for_all_acked(Duration(seconds=60))

    def call(self, service: topics.Service, **request: Any) -> Any:
        """Call a service."""
        kind = interface_class(service.type)
        return self.ros.call(
            kind, topics.from_outside(service.name, self.node), kind.Request(**request))

    def step(self, count: int) -> int:
        """Advance by samples and return the time in ns."""
        results = self.ros.set_parameters(self.node, [Parameter('step_count', value=count)])
        assert results[0].successful, results[0].reason
        answer = self.call(topics.STEP)
        assert answer.success, answer.message
        now = round(float(answer.message.split()[1]) * 1e9)
        self.ros.spin_until(
            lambda: self.samples and from_time(self.samples[-1].header.stamp) >= now
            - self.delay, answer.message)
        return now

    delay = 0

    def told(self) -> list[tuple[float, float]]:
        """Return what took effect: time after the start in ms, and level."""
        return [((from_time(x.header.stamp) - START) / MS, x.magnetic_field.z)
                for x in self.applied]

    def report(self, kind: str, **values: Any) -> DiagnosticStatus:
        """Wait for diagnostics with values."""
        del self.reports[:]
        wanted = {key: str(value) for key, value in values.items()}

        def found() -> Any:
            for array in self.reports:
                for status in array.status:
                    if status.name == f'plant: {kind}' and wanted.items() <= {
                            x.key: x.value for x in status.values}.items():
                        return status
            return None

        return self.ros.spin_until(found, f'diagnostics with {wanted}')


@pytest.fixture
def stand(ros: Any, serve: Any) -> Callable[..., Stand]:
    """Return a factory of a stand with node arguments."""
    def make(*arguments: str) -> Stand:
        serve(PlantNode, *LEADING, *arguments)
        return Stand(ros)
    return make


# -- what took effect, and silence -------------------------------------------------------------


def test_silence_leads_to_the_safe_flux_and_is_reported(stand):
    plant = stand('-p', 'command_timeout:=0.1', '-p', 'safe_flux:=zero')
    plant.send((START + 5 * MS, 0.05))
    plant.step(130)
    plant.ros.spin_until(lambda: len(plant.applied) == 3, 'the changes')
    assert plant.told() == [(0.0, 0.0), (5.0, 0.05), (101.0, 0.0)]
    status = plant.report('commands', silent=1, timeouts=1)
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == 'no command and no heartbeat for actuator'


def test_the_parameters_describe_coil_sensor_delays_and_another_actuator(stand):
    plant = stand(
        '-p', 'mismatch.shear_modulus:=1.1', '-p', 'coil_time_constant:=0.002', '-p',
        'stretch_bias:=0.01', '-p', 'stretch_gain:=1.5', '-p', 'command_delay:=0.001', '-p',
        'measurement_delay:=0.003')
    Stand.delay, before = 3 * MS, Stand.delay
    try:
        plant.send((START + 1_234_567, 0.05))
        plant.step(30)
    finally:
        Stand.delay = before
    simulation = ActuatorSimulation(
        replace(paper_actuator(), shear_modulus=1.1 * paper_actuator().shear_modulus),
        time=START, coil_time_constant=0.002)
    simulation.command(START + 1_234_567, 0.05)
    for sample in plant.samples:
        simulation.advance(from_time(sample.header.stamp))
        assert (sample.position[0], sample.velocity[0], sample.effort[0]) == pytest.approx(
            (0.01 + 1.5 * simulation.stretch, 1.5 * simulation.rate, simulation.flux_density),
            rel=1e-12)
    assert 0.0 < plant.samples[2].effort[0] < 0.05


# -- strangers ---------------------------------------------------------------------------------


def test_a_second_publisher_is_told_and_obeyed_by_default(stand):
    plant = stand()
    topic = topics.FLUX_DENSITY_COMMAND
    second = plant.ros.publisher(topic.type, topic.name, topic.qos)
    plant.send((0, 0.05))
    plant.send((0, 0.03), publisher=second)
    plant.step(2)
    assert plant.samples[-1].effort[0] == 0.03
    status = plant.report('commands', refused_source=0)
    assert status.level == DiagnosticStatus.WARN
    assert status.message == 'several publishers command actuator'
    plant.ros.node.destroy_publisher(second)
    plant.ros.spin_until(
        lambda: plant.report('commands').level == DiagnosticStatus.OK, 'one publisher again')


def test_only_the_first_publisher_is_obeyed_until_it_is_gone(stand):
    plant = stand('-p', 'command_source:=first')
    topic = topics.FLUX_DENSITY_COMMAND
    second = plant.ros.publisher(topic.type, topic.name, topic.qos)
    plant.send((0, 0.05))
    plant.step(2)
    for _ in range(3):
        plant.send((0, 0.03), publisher=second)
        plant.step(2)
    assert plant.samples[-1].effort[0] == 0.05
    plant.send((0, 0.06))
    plant.step(2)
    assert plant.samples[-1].effort[0] == 0.06
    status = plant.report('commands', refused_source=3, received=2)
    assert status.level == DiagnosticStatus.WARN
    plant.ros.node.destroy_publisher(plant.publisher)

    def takes_over() -> bool:
        plant.send((0, 0.03), publisher=second)
        plant.step(2)
        return plant.samples[-1].effort[0] == 0.03

    plant.ros.spin_until(takes_over, 'the second publisher to be obeyed')


# -- conveniences ------------------------------------------------------------------------------


def test_a_reset_leads_to_the_state_of_its_parameters(stand):
    plant = stand()
    plant.send((0, 0.1))
    plant.step(10)
    results = plant.ros.set_parameters('plant', [
        Parameter('reset_stretch', value=1.2), Parameter('reset_rate', value=2.5)])
    assert all(x.successful for x in results)
    answer = plant.call(topics.RESET)
    assert (answer.success, answer.message) == (True, 'at rate 2.5/s at stretch 1.2')
    plant.step(1)
    simulation = ActuatorSimulation(paper_actuator(), stretch=1.2, time=START + 10 * MS)
    simulation.set_state(1.2, 2.5, simulation.flux_density)
    simulation.advance(START + 11 * MS)
    assert plant.samples[-1].position[0] == simulation.stretch
    refused = plant.ros.set_parameters('plant', [Parameter('reset_stretch', value=9.0)])[0]
    assert not refused.successful
    assert 'expected a stretch between the limits' in refused.reason


def test_a_disturbing_force_acts_from_its_stamp_on(stand):
    plant = stand()
    topic = topics.DISTURBANCE_FORCE
    publisher = plant.ros.publisher(topic.type, topic.name, topic.qos)
    message = WrenchStamped()
    message.header.stamp = to_time(START + 2_345_678)
    message.wrench.force.z = 0.5
    publisher.publish(message)
    # Across the field it is refused.
    other = WrenchStamped()
    other.wrench.force.x = 1.0
    publisher.publish(other)
    simulation = ActuatorSimulation(paper_actuator(), time=START)
    simulation.force(START + 2_345_678, 0.5)
    plant.ros.spin_until(lambda: plant.report('commands'), 'the force to arrive')
    plant.step(20)
    for sample in plant.samples:
        simulation.advance(from_time(sample.header.stamp))
        assert sample.position[0] == simulation.stretch
    assert simulation.stretch > 1.01


# -- lock-step, as processes -------------------------------------------------------------------


# -- clocks and states -------------------------------------------------------------------------


def test_another_clock_beside_the_authority_is_told(stand):
    plant = stand('-p', 'real_time_factor:=2.0')
    assert plant.report('time', clock_publishers=1).level == DiagnosticStatus.OK
    other = ros_entities.publisher(plant.ros.node, topics.CLOCK_TOPIC)
    other.publish(to_clock(START))
    status = plant.report('time', clock_publishers=2)
    assert status.level == DiagnosticStatus.WARN
    assert 'this plant, which is the authority' in status.message


def test_the_achieved_real_time_factor_is_told_and_can_be_changed(stand):
    plant = stand()
    assert plant.ros.set_parameters(
        'plant', [Parameter('real_time_factor', value=0.25)])[0].successful
    assert plant.call(topics.SET_PAUSED, data=False).success
    plant.report('time', real_time_factor='0.25')

    def achieved() -> float:
        values = {x.key: x.value for x in plant.report('time', real_time_factor='0.25').values}
        return float(values['real_time_factor_achieved'])

    # It may fall behind on a busy machine, but never run ahead for long.
    plant.ros.spin_until(lambda: 0.0 < achieved() <= 0.26, 'a factor')


@pytest.mark.slow
def test_an_inactive_plant_holds_time_and_takes_no_commands(ros, serve):
    serve(PlantNode, '-p', 'publish_clock:=true', '-p', 'autostart:=false')

    assert ros.change('plant', 'configure')
    plant = Stand(ros)
    plant.send((0, 0.05))
    assert not plant.call(topics.STEP).success
    plant.report('time', state='inactive')
    assert plant.samples == []
    assert ros.change('plant', 'activate')
    ros.spin_until(lambda: len(plant.samples) > 10, 'samples')
    assert {x.effort[0] for x in plant.samples} == {0.0}
    assert ros.change('plant', 'deactivate')
    plant.report('time', state='inactive')
    plant.report('time', state='inactive')
    count = len(plant.samples)
    plant.report('time', state='inactive')
    assert len(plant.samples) == count
    assert ros.change('plant', 'activate')
    ros.spin_until(lambda: len(plant.samples) > count, 'more samples')
    stamps = [from_time(x.header.stamp) for x in plant.samples]
    assert stamps == list(range(stamps[0], stamps[-1] + 1, MS))
    assert ros.change('plant', 'deactivate', 'cleanup')
    ros.spin_until(lambda: not ros.node.count_publishers('joint_states'), 'the topic to go')
    assert ros.change('plant', 'configure', 'activate')
    known = len(plant.samples)
    ros.spin_until(lambda: len(plant.samples) > known, 'samples of the new start')
    assert ros.call(SetBool, 'plant/set_paused', SetBool.Request(data=True)).success
