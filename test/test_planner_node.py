"""The planner node over ROS: requests in; command stream, plan and verdicts out."""

from collections.abc import Callable
from dataclasses import replace
import math
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from plants import set_options
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from scipy.special import chdtri
from sensor_msgs.msg import JointState, MagneticField
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hmsa.identification.files import errors_from
from hmsa.interfaces import topics
from hmsa.model.parameters import paper_actuator
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Options, Planner
from hmsa.planning.shapers.request import SmoothLimits
from hmsa.planning.timeline import PlannedLevel
from hmsa_ros.nodes.capture import Taken
from hmsa_ros.nodes.cdr import JointStateReader
from hmsa_ros.nodes.conversions import from_command, from_time, to_time, to_trajectory
from hmsa_ros.nodes.planner import PlannerNode

pytestmark = pytest.mark.ros

MS = 1_000_000
START = 1000 * MS
LEAD = 50 * MS
# The paper's sequence: a spell of ten units of time is 43.6 ms for this block.
SPELL = 44 * MS
SEQUENCE = ((1.1, SPELL), (1.2, 2 * SPELL), (1.4, 3 * SPELL))
END = START + LEAD + 3 * SPELL
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def trajectory(
        *points: tuple[float, int], joint: str = 'actuator', stamp: int = 0,
        **fields: Any) -> JointTrajectory:
    """Return a request, with other fields of its first point or of the message."""
    message = to_trajectory(points, joint, stamp=stamp)
    for name, value in fields.items():
        setattr(message.points[0] if hasattr(message.points[0], name) else message, name, value)
    return message


class Bench:
    """A planner node, simulated time set by the test, and the core planner for comparison."""

    def __init__(
            self, ros: Any, clock: Any, prefix: str, remapped: dict[str, str]) -> None:
        self.ros = ros
        self.clock = clock
        self.prefix = prefix
        self.remapped = remapped
        self.core = Planner(
            paper_actuator(),
            Options(flux_density_min=-0.5, flux_density_max=0.5, lead_time=LEAD))
        self.now = 0
        self.expected: list[PlannedLevel] = []
        self.commands = self.collect(topics.FLUX_DENSITY_COMMAND)
        self.plans = self.collect(topics.PLAN)
        self.statuses = self.collect(topics.STATUS)
        self.trajectories = self.publisher(topics.JOINT_TRAJECTORY)
        self.setpoints = self.publisher(topics.SETPOINT)
        # Who carries commands out reports on them; this one is silent.
        self.publisher(topics.FLUX_DENSITY_APPLIED)
        self.requests = 0

    def name(self, entry: Any) -> str:
        """Return the full name of a topic or service."""
        if entry.name in self.remapped:
            return self.remapped[entry.name]
        namespace, _, node = self.prefix.rpartition('/')
        name = topics.from_outside(entry.name, node)
        return name if name.startswith('/') else f'{namespace}/{name}'

    def collect(self, topic: Any) -> list[Any]:
        """Return the list of messages of a topic, once its publisher is discovered."""
        messages: list[Any] = self.ros.collect(topic.type, self.name(topic), topic.qos)
        self.ros.spin_until(
            lambda: self.ros.node.count_publishers(self.name(topic)), self.name(topic))
        return messages

    def publisher(self, topic: Any) -> Any:
        """Return a publisher to the planner."""
        return self.ros.publisher(topic.type, self.name(topic), topic.qos)

    def at(self, now: int) -> None:
        """Set the time, and take the commands of the core planner."""
        self.clock.set(now)
        self.now = now
        self.take()

    def take(self) -> None:
        """Wait for the commands that the core planner gives now."""
        self.expected += self.core.due(self.now)
        self.ros.spin_until(
            lambda: len(self.commands) >= len(self.expected),
            f'{len(self.expected)} commands')

    def run(self, end: int = END, step: int = 10 * MS) -> None:
        """Advance time to an end."""
        while self.now < end:
            self.at(min(self.now + step, end))

    def diagnosed(self, arrays: list[Any], **changed: str) -> Any:
        """Wait for diagnostics with counts, by default those of the sequence; return them."""
        counts = {
            'sent': '6', 'late': '0', 'refused': '0', 'replanned': '0', 'heartbeats': '0',
            'largest_lateness_ms': '0.000', 'clock_jumps': '0', **changed}
        self.ros.spin_until(lambda: arrays and counts == {
            x.key: x.value for x in arrays[-1].status[0].values}, 'diagnostics')
        return arrays[-1]

    def values(self) -> dict[str, str]:
        """Return the newest status' values."""
        return {x.key: x.value for x in self.statuses[-1].values}

    def verdict(self, code: str, **values: Any) -> DiagnosticStatus:
        """Wait for a status with a code and values, and return it."""
        expected = {'code': code, **{key: str(value) for key, value in values.items()}}

        def seen() -> bool:
            return bool(self.statuses) and expected.items() <= self.values().items()

        self.ros.spin_until(seen, f'a status with {expected}')
        return self.statuses[-1]

    def send(self, message: JointTrajectory, code: str = 'accepted') -> DiagnosticStatus:
        """Send a trajectory and wait for its verdict."""
        self.requests += 1
        message.header.frame_id = f'request {self.requests}'
        self.trajectories.publish(message)
        return self.verdict(code, request=message.header.frame_id)

    def request(self, *points: tuple[float, int], stamp: int | None = None) -> None:
        """Send a trajectory to the node and to the core planner."""
        self.core.request(points, stamp, self.now)
        self.send(trajectory(*points, stamp=stamp or 0))
        self.take()

    def setpoint(self, stretch: float, code: str = 'accepted') -> None:
        """Send a setpoint to the node and to the core planner."""
        self.core.setpoint(stretch, self.now)
        self.setpoints.publish(Float64(data=stretch))
        self.verdict(code, request='', plan=self.core.plan.number)
        self.take()

    def check(self, *, sequence: bool = False) -> None:
        """
        Compare the command stream with the core planner's, perhaps after the whole sequence.

        A last setpoint follows on the same topic, so that an excess message would precede its
        commands.
        """
        if sequence:
            self.run()
        self.at(self.now + 1000 * MS)
        self.setpoint(1.01)
        self.at(self.now + 1000 * MS)
        assert [from_command(x) for x in self.commands] == [
            (x.stamp, x.flux_density) for x in self.expected]


@pytest.fixture
def bench(ros: Any, serve: Any, make_clock: Any) -> Callable[..., Bench]:
    """Return a factory of a bench with node arguments."""
    def make(
            *arguments: str, prefix: str = '/planner', now: int = START,
            **remapped: str) -> Bench:
        # What the core planner does not do is asked for where it is tested: signs of life, and
        # new plans where these tests let time jump.
        served = serve(
            PlannerNode, '-p', 'use_sim_time:=true', '-p', 'heartbeat_period:=0.0',
            '-p', 'replan_late:=false', *arguments)
        made = Bench(ros, make_clock(ros, served), prefix, remapped)
        # Known to the graph is not matched yet, and what is sent before that is lost.
        ros.spin_until(
            lambda: all(
                x.get_subscription_count() for x in served.nodes[0].publishers
                if x.msg_type is MagneticField), 'the match of the commands')
        if now:
            made.at(now)
        return made
    return make


def test_sequence_comes_out_as_the_command_stream_of_the_core_plan(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    planner.run()
    assert len(planner.commands) == 6
    planner.check()
    assert {x.header.frame_id for x in planner.commands} == {'coil'}
    assert {(x.magnetic_field.x, x.magnetic_field.y) for x in planner.commands} == {(0.0, 0.0)}
    assert not any(
        any(x.magnetic_field_covariance) for x in planner.commands)


@pytest.mark.parametrize(('arguments', 'options'), [
    ('lead_time:=0.2', {'lead_time': 200 * MS}),
    ('command_mode:=sampled command_period:=0.0005', {'period': MS // 2}),
    ('slew_limit:=100.0', {'slew_limit': 100.0}),
    ('coil_time_constant:=0.0005', {'coil_time_constant': 5e-4}),
    ('shaper:=robust robust_order:=3', {'shaper': 'robust', 'order': 3}),
    ('shaper:=minimax minimax_errors:=[0.05,0.1,0.0]',
     {'shaper': 'minimax', 'errors': (0.05, 0.1, 0.0)}),
    ('shaper:=smooth smooth_periods:=0.5 stretch_rate_max:=40.0',
     {'shaper': 'smooth', 'pace': SmoothLimits(0.5, 40.0)}),
    ('flux_density_max:=0.2 shaper:=minimum_time',
     {'flux_density_max': 0.2, 'shaper': 'minimum_time'})])
def test_options_of_the_parameters_are_those_of_the_core_plan(bench, arguments, options):
    planner = bench(*(x for y in arguments.split() for x in ('-p', y)))
    set_options(planner.core, replace(planner.core.options, **options))
    planner.request(*SEQUENCE)
    planner.check(sequence=True)
    assert planner.expected[0].stamp == START + planner.core.options.lead_time
    if 'period' in options:
        assert not any(x.stamp % options['period'] for x in planner.expected)


def test_minimax_takes_the_ellipsoid_of_an_identification_and_refuses_a_file_without(
        bench, tmp_path):
    path, block = tmp_path / 'block.yaml', paper_actuator()
    covariance = np.array([[1.6e5, 4.0], [4.0, 4e-4]])
    known = ('    identification.names: [shear_modulus, damping_coefficient]\n'
             f'    identification.covariance: {covariance.ravel().tolist()}\n')
    text = ('/**:\n  ros__parameters:\n    actuator.shear_modulus: 10000.0\n'
            f'    actuator.damping_coefficient: {block.damping_coefficient}\n')
    path.write_text(text + known)
    planner = bench('-p', 'shaper:=minimax', '-p', f'minimax_file:={path}')
    errors = errors_from(str(path), (0.1, 0.1, 0.1))
    # Its outline in G and damping is that of the covariance, where 95 % are.
    axes, values = np.array(errors.axes), [1e4, block.damping_coefficient]
    assert (axes.T @ axes)[:2, :2] == pytest.approx(
        chdtri(2, 0.05) * covariance / np.outer(values, values), rel=1e-3)
    set_options(planner.core, replace(planner.core.options, shaper='minimax', errors=errors))
    planner.request(*SEQUENCE)
    planner.check(sequence=True)
    path.write_text(text)
    result, = planner.ros.set_parameters('planner', [Parameter('minimax_file', value=str(path))])
    assert not result.successful
    assert 'no covariance of shear_modulus' in result.reason


def test_future_stamp_keeps_the_running_plan_until_then(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    planner.request((1.3, SPELL), stamp=START + LEAD + SPELL + 20 * MS)
    planner.check(sequence=True)
    # Two levels of the first setpoint, one that is cut off, two of the new one, two of the check.
    assert len(planner.commands) >= 6


def test_velocities_are_followed_in_mode_path_which_can_be_set_while_it_runs(bench):
    planner = bench()
    s = np.linspace(0.0, 1.0, 11)
    rates = 0.3 / 0.1 * 30.0 * (s * (1.0 - s)) ** 2
    stretches = 1.0 + 0.3 * s ** 3 * (10.0 - 15.0 * s + 6.0 * s ** 2)
    times = [round(x * 100) * MS for x in s.tolist()]
    message = trajectory(*zip(stretches.tolist(), times, strict=True))
    for point, rate in zip(message.points, rates.tolist(), strict=True):
        point.velocities = [rate]
    assert 'trajectory_mode set to path' in planner.send(message, 'bad_input').message
    results = planner.ros.set_parameters('planner', [Parameter('trajectory_mode', value='path')])
    assert [(x.successful, x.reason) for x in results] == [(True, '')]
    points = [((*x, math.nan), y) for *x, y in zip(
        stretches.tolist(), rates.tolist(), times, strict=True)]
    planner.core.take(planner.core.draft_path(points, None, planner.now), planner.now)
    planner.send(message)
    planner.take()
    planner.run(START + LEAD + 150 * MS)
    assert len(planner.commands) > 300
    assert planner.core.plan.segments[-1].reason == ''
    assert planner.values()['setpoints'] == '1'
    # Without velocities, its points are rests.
    planner.request((1.2, SPELL), (1.1, 2 * SPELL))
    planner.check()


def test_late_joiner_gets_plan_and_status(bench, make_ros):
    planner = bench()
    planner.request(*SEQUENCE)
    late = make_ros()
    plans = late.collect(topics.PLAN, planner.name(topics.PLAN))
    statuses = late.collect(topics.STATUS, planner.name(topics.STATUS))
    late.spin_until(lambda: plans and statuses, 'plan and status')
    assert plans == planner.plans[-1:]
    assert statuses == planner.statuses[-1:]
    levels = [x for x in planner.core.plan.levels if x.stamp > 0]
    start = from_time(plans[0].header.stamp)
    assert plans[0].joint_names == ['actuator']
    assert [
        (start + from_time(x.time_from_start), x.positions[0], x.velocities[0], x.effort[0])
        for x in plans[0].points] == [
        (x.stamp, x.stretch, x.rate, x.flux_density) for x in levels]


def test_status_tells_the_progress_until_at_rest(bench):
    planner = bench()
    assert planner.verdict('none', state='idle', setpoints=0).level == OK
    planner.request(*SEQUENCE)
    planner.verdict('accepted', state='waiting', setpoint=0, setpoints=3)
    begin, arrival = (
        planner.core.plan.segments[1].begin, planner.core.plan.segments[1].arrival)
    for now, state, setpoint, stretch in (
            (START + LEAD - 1, 'waiting', 0, ''),
            (START + LEAD, 'moving', 1, '1.1'),
            (begin - 1, 'holding', 1, '1.1'),
            (begin, 'moving', 2, '1.2'),
            (arrival - 1, 'moving', 2, '1.2'),
            (arrival, 'holding', 2, '1.2'),
            (END, 'at_rest', 3, '1.4')):
        planner.at(now)
        status = planner.verdict(
            'unobserved' if state == 'at_rest' else 'accepted', state=state, setpoint=setpoint,
            setpoints=3, stretch=stretch, request='request 1', plan=1)
        assert status.level == OK
        assert status.hardware_id == 'actuator'


def test_the_file_of_an_identification_is_a_parameter_file(bench, tmp_path):
    file = tmp_path / 'found.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    actuator.shear_modulus: 12000.0\n'
        '    stretch_bias: 0.002\n    feedback: adapt\n'
        '    identification.verdict: identified\n    identification.noise_std: 0.001\n'
        '    identification.names: [shear_modulus, stretch_bias]\n'
        '    identification.values: [12000.0, 0.002]\n'
        '    identification.covariance: [144.0, 0.0, 0.0, 1.0e-10]\n')
    planner = bench('--params-file', str(file))
    answer = planner.ros.call(Trigger, planner.name(topics.SAVE_ESTIMATE))
    assert not answer.success
    assert 'feedback_file is empty' in answer.message


def test_stop_comes_to_rest_without_vibration(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    # The middle of the first move lies lead_time ahead of this.
    planner.at(START + 3 * MS)
    planner.core.stop(planner.now)
    answer = planner.ros.call(Trigger, planner.name(topics.STOP))
    assert answer.success
    assert answer.message.startswith('stopping: ')
    planner.take()
    # The first move is cut off by two levels: one that brakes, one that holds.
    assert len([x for x in planner.core.plan.levels if x.stamp > START]) == 3
    rest = planner.core.state(END + 1000 * MS)
    assert abs(rest.rate) < 1e-12
    assert 1.0 < rest.stretch < 1.1
    planner.run()
    # Nobody has acknowledged it.
    planner.verdict('accepted', state='at_rest', worst='unobserved')
    planner.check()


@pytest.mark.parametrize('joints', [(), ('actuator',)])
def test_trajectory_without_points_is_a_stop(bench, joints):
    planner = bench()
    planner.request(*SEQUENCE)
    planner.at(START + 3 * MS)
    planner.core.stop(planner.now)
    status = planner.send(JointTrajectory(joint_names=joints))
    assert (status.level, status.message[:10]) == (OK, 'stopping: ')
    planner.check(sequence=True)


BAD = (
    (trajectory((math.nan, SPELL)), 'bad_input', 'stretch is nan: expected a finite number'),
    (JointTrajectory(joint_names=['knee']), 'unknown_joint',
     "joint_names has 'knee': expected names among actuator"),
    (trajectory((1.1, SPELL), positions=[]), 'bad_input', 'point 0 has 0 positions'),
    (trajectory((1.1, SPELL), velocities=[0.5]), 'bad_input', 'point 0 has velocities [0.5]'),
    (trajectory((1.1, SPELL), joint='knee'), 'unknown_joint',
     "joint_names is ['knee']: expected ['actuator']"),
    (trajectory((1.1, SPELL), joint_names=[]), 'unknown_joint', 'joint_names is []'),
    (trajectory((1.1, SPELL), joint_names=['actuator'] * 2), 'unknown_joint',
     "['actuator', 'actuator']"),
    (trajectory((1.1, SPELL), stamp=START // 2), 'in_the_past', 'use_sim_time'),
    (trajectory((1.1, SPELL), stamp=-START), 'in_the_past', 'use_sim_time'),
    (trajectory((1.3, 0), (1.4, SPELL)), 'spell_too_short', 'at time_from_start 0'),
)


def test_bad_trajectories_are_refused_with_a_reason_and_the_running_plan_goes_on(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    planner.at(START + 20 * MS)
    plan = planner.plans[-1]
    for message, code, fragment in BAD:
        status = planner.send(message, code)
        assert status.level == ERROR, fragment
        assert fragment in status.message
        assert '\n' not in status.message
        assert planner.values()['setpoints'] == '3', fragment
    planner.run()
    planner.verdict(code, state='at_rest', setpoint=3, plan=1)
    assert planner.plans == [plan]
    planner.check()


def test_bad_setpoints_are_refused_with_a_reason_and_the_running_plan_goes_on(bench):
    planner = bench()
    planner.setpoint(1.2)
    planner.at(START + 2 * MS)
    for stretch, code, fragment in (
            (-math.inf, 'bad_input', 'stretch is -inf: expected a finite number'),
            (3.0, 'out_of_range', 'stretch is 3: expected a stretch between'),
            (2.2, 'flux_limit', 'needs a flux density of'),
            (math.nan, 'bad_input', 'stretch is nan: expected a finite number')):
        planner.setpoints.publish(Float64(data=stretch))
        status = planner.verdict(code, plan=1)
        assert status.level == ERROR
        assert fragment in status.message
    planner.check()


def test_nothing_is_accepted_before_simulated_time_has_started(bench):
    planner = bench(now=0)
    status = planner.send(trajectory(*SEQUENCE), 'no_time')
    assert status.level == ERROR
    assert 'expected messages on /clock' in status.message
    planner.setpoints.publish(Float64(data=1.1))
    planner.verdict('no_time', request='')
    answer = planner.ros.call(Trigger, planner.name(topics.STOP))
    assert not answer.success
    assert '/clock' in answer.message
    planner.at(START)
    planner.request(*SEQUENCE)
    planner.check(sequence=True)


def test_target_that_is_only_crept_up_to_is_accepted_with_a_warning(bench):
    planner = bench('-p', 'actuator.damping_coefficient:=10.0')
    planner.setpoints.publish(Float64(data=1.1))
    status = planner.verdict('too_damped', plan=1, state='waiting')
    assert status.level == WARN
    assert status.message
    planner.clock.set(START + LEAD)
    planner.verdict('too_damped', state='settling')


def test_changed_shaper_and_limits_are_taken_from_the_next_request_on(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    results = planner.ros.set_parameters('planner', [
        Parameter('shaper', value='step'), Parameter('flux_density_max', value=0.2)])
    assert [(x.successful, x.reason) for x in results] == [(True, ''), (True, '')]
    set_options(
        planner.core, replace(planner.core.options, shaper='step', flux_density_max=0.2))
    planner.run()
    assert len(planner.commands) == 6
    planner.request((1.1, SPELL))
    assert len(planner.core.plan.ahead(planner.now)) == 2
    assert 'expected -0.5 T to 0.2 T' in planner.send(
        trajectory((1.8, SPELL)), 'flux_limit').message
    planner.check()


REFUSED = (
    ('shaper', 'zigzag', "shaper is 'zigzag': expected one of two_step"),
    ('shaper', 3, 'Wrong parameter type'),
    ('short_spell', 'ignore', 'expected one of refuse, continue'),
    ('flux_density_max', -0.6, 'expected less than flux_density_max, which is -0.6 T'),
    ('flux_density_min', 0.5, 'flux_density_min is 0.5 T: expected less'),
    ('flux_density_max', 1e6, 'flux_density_max'),
    ('flux_density_max', math.nan, 'flux_density_max'),
    ('lead_time', -0.1, 'lead_time'),
    ('actuator.density', -1.0, 'actuator.density'),
    ('joint', 'knee', 'read-only'),
    ('initial_stretch', 1.2, 'read-only'),
    ('frame_id', 'magnet', 'read-only'),
    ('robust_order', 17, 'robust_order'),
    ('law', 'yeoh', 'parameter law has been renamed: expected law.name'),
    ('lead_tine', 0.1,
     'parameter lead_tine does not exist: expected one of the planner, such as lead_time'),
    ('lead_tine' * 10**5, 0.1, 'lead_tine'),
)


def test_refused_parameters_have_a_reason_and_change_nothing(bench):
    planner = bench()
    for name, value, fragment in REFUSED:
        result, = planner.ros.set_parameters('planner', [Parameter(name, value=value)])
        assert not result.successful, fragment
        assert fragment in result.reason
        assert len(result.reason) < 500
    planner.request(*SEQUENCE)
    planner.check(sequence=True)


def test_names_move_with_the_namespace(bench):
    planner = bench('-r', '__ns:=/left', prefix='/left/planner')
    planner.request(*SEQUENCE)
    planner.check(sequence=True)


def test_topics_can_be_remapped(bench):
    planner = bench(
        '-r', 'flux_density_command:=coil/field', '-r', '~/setpoint:=target',
        **{'flux_density_command': '/coil/field', '~/setpoint': '/target'})
    planner.setpoint(1.1)
    planner.check()


def test_joint_has_the_name_of_the_parameter(bench):
    planner = bench('-p', 'joint:=knee')
    assert planner.verdict('none').hardware_id == 'knee'
    planner.send(trajectory(*SEQUENCE, joint='knee'))
    planner.ros.spin_until(lambda: planner.plans, 'the plan')
    assert planner.plans[-1].joint_names == ['knee']
    planner.send(trajectory(*SEQUENCE), 'unknown_joint')


@pytest.mark.parametrize('data', [
    b'', b'\0\1', b'\0\1\0\0' + b'\xff' * 20,
    serialize_message(JointState(name=['actuator'], position=[1.1]))[:-9]], ids=len)
def test_a_sample_that_cannot_be_read_is_ignored(serve, monkeypatch, data):
    node = serve(PlannerNode).nodes[0]
    monkeypatch.setattr(node._runtime, 'looks_at', lambda stamp: True)
    seen = []
    monkeypatch.setattr(node._runtime, 'observed', lambda *samples: seen.append(samples))
    whole = serialize_message(JointState(name=['actuator'], position=[1.1]))
    node._take_samples([Taken(0, 0, 0, b'', x) for x in (whole, data, whole)], 0)
    (name, samples), = seen
    assert name == 'actuator'
    assert samples.stretch == (1.1, 1.1)


def test_samples_that_wait_to_be_read_came_before_and_not_before_they_were_made(
        ros, serve, monkeypatch):
    node = serve(PlannerNode, '-p', 'feedback:=observe').nodes[0]
    runtime, seen = node._runtime, []

    def take_long(name, samples):
        seen.extend((*x, node.now()) for x in zip(samples.stamps, samples.came, strict=True))
        threading.Event().wait(5e-3 * len(samples.stamps))
    monkeypatch.setattr(runtime, 'looks_at', lambda stamp: True)
    monkeypatch.setattr(runtime, 'observed', take_long)
    publisher = ros.publisher(topics.JOINT_STATES.type, 'joint_states', topics.SAMPLES)

    def is_seen():
        for _ in range(20):
            message = JointState(name=['actuator'], position=[1.1])
            message.header.stamp = ros.node.get_clock().now().to_msg()
            publisher.publish(message)
        return len(seen) > 100
    ros.spin_until(is_seen, 'samples')
    stamp, came, read = np.array(seen).T
    assert np.all((stamp <= came) & (came <= read))
    assert np.max(read - came) > 50e6


def test_diagnostics_count_what_was_sent_and_refused(bench):
    planner = bench()
    arrays = planner.collect(topics.DIAGNOSTICS)
    planner.request(*SEQUENCE)
    planner.run()
    planner.send(trajectory((math.nan, SPELL)), 'bad_input')
    diagnostics = planner.diagnosed(arrays, refused='1')
    assert diagnostics.header.stamp == to_time(END)
    assert (diagnostics.status[0].name, diagnostics.status[0].level) == ('planner: commands', OK)


def test_command_sent_after_its_time_is_counted_as_late(bench):
    planner = bench()
    arrays = planner.collect(topics.DIAGNOSTICS)
    planner.request(*SEQUENCE)
    planner.at(END)
    # The second level of the first move came latest.
    latest = END - planner.core.plan.levels[2].stamp
    diagnostics = planner.diagnosed(arrays, late='5', largest_lateness_ms=f'{latest / 1e6:.3f}')
    assert diagnostics.status[0].level == WARN
    planner.check()


def test_backward_jump_of_the_clock_drops_the_plan_and_says_so(bench):
    planner = bench()
    planner.request(*SEQUENCE)
    planner.run(START + LEAD + 2 * MS)
    # In the middle of the first move.
    planner.clock.set(START // 2)
    status = planner.verdict('clock_jumped', state='idle', setpoints=0, stretch='')
    assert status.level == WARN
    assert 'the clock jumped back by 0.552 s' in status.message
    known = len(planner.commands)
    planner.clock.set(START + LEAD)
    planner.send(trajectory((1.3, SPELL)))
    planner.ros.spin_until(lambda: len(planner.plans) == 2, 'the plan')
    planner.ros.spin_until(lambda: len(planner.commands) > known, 'a command')
    # No command of the dropped plan came in between, and the new one starts from rest where
    # the actuator was before the first request.
    assert from_command(planner.commands[known])[0] == START + 2 * LEAD
    first = planner.plans[-1].points[0]
    assert (first.positions[0], first.velocities[0]) == (1.0, 0.0)


@pytest.mark.parametrize('sizes', [(3, 3, 3), (3, 0, 2), (0, 0, 0)])
def test_samples_are_read_as_rclpy_reads_them_whatever_their_names(sizes):
    reader = JointStateReader()
    for number in range(6):
        names = [f'joint_{k + number // 2}' for k in range(3)]
        position, velocity, effort = ([0.5 * number + x for x in range(n)] for n in sizes)
        message = JointState(name=names, position=position, velocity=velocity, effort=effort)
        message.header.frame_id = 'base' * (number % 2)
        message.header.stamp.sec, message.header.stamp.nanosec = number, 7
        joints, stamp, measured = reader.read(serialize_message(message))
        assert joints == tuple(names)
        assert stamp == number * NANOSECONDS + 7
        for field, values in zip((position, velocity, effort), measured, strict=True):
            assert np.array_equal(
                values, field + [math.nan] * (3 - len(field)), equal_nan=True)
