"""Two planners, plants or drivers of one joint are detected, refused and named."""

import json

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from hmsa.cli import main
from hmsa.interfaces import topics
from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa_lab.panel.listener import Listener
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import to_trajectory
from hmsa_ros.nodes.duplicate_nodes import Active
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.plant import PlantNode

pytestmark = pytest.mark.ros

TWO_PLANTS = '2 plants or drivers of joint actuator (/plant and /plant): stop one'
# Few samples, since a process that was killed is waited for.
RARELY = '-p', 'publish_rate:=100.0'
TWO_PLANNERS = '2 planners (/planner and /planner): stop one'


class Asking:
    """Requests a stretch from a planner repeatedly, and reads verdicts and diagnostics."""

    def __init__(self, ros):
        self.verdicts, self.reports = [], {}
        self._ros = ros
        ros_entities.subscribe(
            ros.node, topics.STATUS, lambda x: self.verdicts.append(StatusVerdict.read(x)),
            topics.PLANNER)
        ros_entities.subscribe(ros.node, topics.DIAGNOSTICS, self._on_diagnostics)
        self._setpoint = ros_entities.publisher(ros.node, topics.SETPOINT, topics.PLANNER)
        ros.spin_until(self._setpoint.get_subscription_count, 'the planner')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.reports |= {x.name.partition(': commands')[0]: x for x in message.status}

    def until(self, *, refused: bool) -> StatusVerdict:
        """Repeat the request until it is refused for several planners, or accepted."""
        del self.verdicts[:]
        setpoint = ros_entities.interface_class(topics.SETPOINT.type)(data=1.1)
        again = self._ros.node.create_timer(0.05, lambda: self._setpoint.publish(setpoint))
        self._ros.spin_until(
            lambda: self.verdicts and self.verdicts[-1].code.startswith('several_') == refused,
            f'refused {refused}')
        again.cancel()
        return self.verdicts[-1]


def test_second_plant_of_a_joint_is_refused_until_it_is_gone(ros, serve, start):
    serve(PlannerNode, PlantNode, *RARELY)
    asking = Asking(ros)
    other = ros_entities.publisher(ros.node, topics.JOINT_STATES)
    other.publish(JointState(name=['elbow'], position=[1.0]))
    asking.until(refused=False)
    second = start.hmsa('plant', '--ros-args', *RARELY)
    assert asking.until(refused=True).message == TWO_PLANTS
    ros.spin_until(lambda: all(
        x in asking.reports and asking.reports[x].level == DiagnosticStatus.ERROR
        and asking.reports[x].message.startswith(TWO_PLANTS) for x in ('planner', 'plant')),
        'both say so first')
    with Listener() as listener:
        ros.spin_until(lambda: listener.look().waiting == [TWO_PLANTS], 'the watch says so')
    second.popen.kill()
    second.popen.wait()
    asking.until(refused=False)
    # The middleware believes for some 20 s that it runs.
    assert ros.node.count_publishers(topics.FLUX_DENSITY_APPLIED.name) == 2


def test_a_recorder_of_the_commands_does_not_carry_them_out(ros, serve, start):
    ros.node.create_service(Trigger, '~/split_bagfile', lambda _, response: response)
    ros.collect(topics.FLUX_DENSITY_COMMAND.type, topics.FLUX_DENSITY_COMMAND.name)
    states = ros_entities.publisher(ros.node, topics.JOINT_STATES)
    serve(PlannerNode)
    asking = Asking(ros)
    states.publish(JointState(name=['actuator'], position=[1.0]))
    asking.until(refused=False)
    status = ros.collect(topics.STATUS, '/planner/status')
    ros.spin_until(lambda: status and any(
        x.value.startswith('no node subscribes to /flux_density_command')
        for x in status[-1].values if x.key == 'unheard'), 'the planner says so')
    start.hmsa('plant')
    ros.spin_until(lambda: not any(
        x.key == 'unheard' for x in status[-1].values), 'the plant carries them out')


@pytest.mark.parametrize(('messages', 'active'), [
    # One source after the other, at the same time, and after a pause.
    ({'a': (0, 1, 2), 'b': (2.5, 3)}, {'b'}), ({'a': (0, 1, 2, 3), 'b': (2.5, 3)}, {'a', 'b'}),
    ({'a': (0, 1), 'b': (0.5, 1.5)}, {'a', 'b'}), ({'a': (0, 3), 'b': (1, 2)}, {'a'}),
    ({'a': (0,), 'b': (1,)}, {'b'}), ({'a': (3,)}, {'a'}), ({'a': (0,)}, set())])
def test_a_source_that_ended_before_another_began_was_replaced(messages, active):
    found = Active()
    for source, times in messages.items():
        for time in times:
            found.note(source, round(time * 1e9))
    assert found.among(messages, round(3.1e9)) == active


def test_second_planner_is_named_before_anything_is_sent(ros, serve, start, capfd):
    serve(PlannerNode, PlantNode)
    asking = Asking(ros)
    second = start.hmsa('planner')
    ros.spin_until(lambda: 'planner' in asking.reports and (
        asking.reports['planner'].message == TWO_PLANNERS), 'the planner says so')
    assert main(['send', '1.1:0.1']) in (1, 2)
    out, err = capfd.readouterr()
    assert out == ''
    # It has seen both itself, or the planner that it asks has.
    sentence = err.splitlines()[-1]
    assert sentence.startswith('hmsa: error: ')
    assert sentence.endswith(TWO_PLANNERS)
    # Who sends without looking is refused by the planners.
    assert asking.until(refused=True).message == TWO_PLANNERS
    second.popen.kill()
    second.popen.wait()
    asking.until(refused=False)
    assert main(['send', '1.1:0.1']) == 0
    assert ros.node.count_publishers('planner/status') == 2


@pytest.mark.parametrize(('change', 'sentence'), [
    ((), 'the planner is not configured and takes no requests'),
    (('configure',), 'the planner refused: the planner is inactive')])
def test_planner_that_is_not_active_yet_is_named_by_who_sends(serve, capfd, change, sentence):
    served = serve(PlannerNode, PlantNode, '-p', 'autostart:=false')
    for name in change:
        getattr(served.nodes[0], f'trigger_{name}')()
    assert main(['send', '1.1:0.1']) in (1, 2)
    assert f'hmsa: error: {sentence}' in capfd.readouterr().err


def test_who_waits_for_a_sequence_hears_that_a_cut_off_has_ended_it(serve, capfd):
    # Without heartbeats the watchdog trips.
    serve(PlannerNode, PlantNode, *(x for name, value in (
        ('heartbeat_period', 0.0), ('command_timeout', 0.3), ('safe_flux', 'zero'),
        ('publish_rate', 200.0)) for x in ('-p', f'{name}:={value}')))
    assert main(['send', '1.1:600', '--wait']) == 1
    assert 'hmsa: error: the coil of joint actuator was cut off' in capfd.readouterr().err


@pytest.mark.slow
def test_a_request_that_no_planner_took_is_named_by_those_who_read_the_bag(
        start, ros, tmp_path, capsys):
    folder = tmp_path / 'run'
    start.hmsa('planner', '--ros-args', '-p', 'autostart:=false')
    start.hmsa('plant', '--ros-args', '-p', 'publish_rate:=1000.0', '-p', 'stretch_noise:=1e-4')
    recorder = start.hmsa('recorder', '--ros-args', '-p', f'storage.uri:={folder}')
    asked = ros_entities.publisher(ros.node, topics.JOINT_TRAJECTORY, topics.PLANNER)
    ros.spin_until(asked.get_subscription_count, 'the recorder')
    asked.publish(to_trajectory([(1.1, 500_000_000)], 'actuator', frame='mine'))
    states = ros.collect(JointState, 'joint_states', topics.JOINT_STATES.qos)
    ros.spin_until(lambda: len(states) > 2000, 'samples')
    assert recorder.stop() == 0, recorder.output
    assert main(['bag', 'info', str(folder)]) == 0
    assert 'note: 1 request on /planner/joint_trajectory has no verdict' in capsys.readouterr().out
    assert main(['bag', 'info', str(folder), '--json']) == 0
    assert 'the planner was not active' in json.loads(capsys.readouterr().out)['notes'][0]
    page = tmp_path / 'x.html'
    assert main(['report', str(folder), '--json', '--out', str(page)]) == 0
    # No plan came of it.
    assert json.loads(capsys.readouterr().out)['runs'][0]['setpoints'] == []
    assert 'has no verdict' in page.read_text()


@pytest.mark.slow
def test_samples_that_cease_are_a_state_of_their_own(ros, serve):
    serve(PlannerNode)
    asking = Asking(ros)
    statuses = ros.collect(topics.STATUS.type, '/planner/status')
    samples = ros_entities.publisher(ros.node, topics.JOINT_STATES)

    def report() -> tuple[int, bool, bool]:
        """Return the severity in diagnostics, and whether these and the status name samples."""
        found, text = asking.reports.get('planner'), 'no sample of joint actuator'
        return (
            found.level[0] if found else -1, bool(found) and text in found.message,
            bool(statuses) and text in statuses[-1].message)

    def sampled() -> tuple[int, bool, bool]:
        message = JointState(name=['actuator'], position=[1.0])
        message.header.stamp = ros.node.get_clock().now().to_msg()
        samples.publish(message)
        return report()

    ros.spin_until(samples.get_subscription_count, 'the planner')
    for _ in range(2):
        # A report is of samples that have come before the one before it.
        asking.reports.clear()
        ros.spin_until(lambda: sampled() == (0, False, False), 'samples')
    ros.spin_until(lambda: report() == (1, True, True), 'that they have ceased')
    ros.spin_until(lambda: sampled() == (0, False, False), 'that they come again')
