"""The planner node with several joints, late commands, and a predecessor and successor."""

from dataclasses import replace
import signal
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from plants import Plant
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from hmsa.interfaces import topics
from hmsa.model.parameters import paper_actuator
from hmsa.planning.planner import Options, Planner
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.conversions import (
    from_command,
    from_time,
    to_clock,
    to_command,
    to_time,
    to_trajectory,
)
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.runtime.runtime import Runtime
from hmsa_ros.timekeeping import StepWatch

pytestmark = pytest.mark.ros

MS = 1_000_000
START = 1000 * MS
LEAD = 50 * MS
SPELL = 44 * MS
SEQUENCE = ((1.1, SPELL), (1.2, 2 * SPELL), (1.4, 3 * SPELL))
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
RESIDUAL = 1e-6
SLENDER = replace(paper_actuator(), damping_coefficient=1e-3)
QUIET = ('-p', 'use_sim_time:=true', '-p', 'heartbeat_period:=0.0')


class Driver:
    """An actuator and its coil controlled by the test, which reports levels that take effect."""

    def __init__(self, ros: Any, joint: str = '', joints: tuple[str, ...] = ('',)) -> None:
        self.plant = Plant(paper_actuator(), time=START)
        self.arrived: list[tuple[int, float]] = []
        self.received = 0
        self.hold_back = False
        self.held: list[Any] = []
        ros_entities.subscribe(
            ros.node, topics.of_joint(topics.FLUX_DENSITY_COMMAND, joint, joints),
            self.on_command)
        self.applied = ros_entities.publisher(
            ros.node, topics.of_joint(topics.FLUX_DENSITY_APPLIED, joint, joints))

    def on_command(self, message: Any) -> None:
        """Accept a command, or keep it in transit."""
        self.received += 1
        if self.hold_back:
            self.held.append(message)
            return
        command = from_command(message)
        self.arrived.append(command)
        self.plant.command(*command)

    def release(self) -> None:
        """Deliver the commands in transit."""
        self.hold_back = False
        for message in self.held:
            self.received -= 1
            self.on_command(message)
        self.held.clear()

    def advance(self, time: int) -> None:
        """Advance the actuator, and report levels that take effect."""
        for change in self.plant.go_on(time):
            self.applied.publish(to_command(*change, 'coil'))

    def sample(self, name: str = 'actuator') -> JointState:
        """Return the actual state."""
        return JointState(
            header=to_command(self.plant.time, 0.0, '').header, name=[name],
            position=[self.plant.stretch], velocity=[self.plant.rate],
            effort=[self.plant.flux_density])


class Rig:
    """A planner in a thread, simulated time set by the test, and drivers of its joints."""

    def __init__(
            self, ros: Any, make_clock: Any, served: Any, joints: tuple[str, ...] = ('',)
    ) -> None:
        self.ros = ros
        self.served = served
        self.planner = served.nodes[0]
        self.drivers = {x: Driver(ros, x, joints) for x in joints}
        self.statuses = ros.collect(topics.STATUS, 'planner/status')
        self.plans = ros.collect(topics.PLAN, 'planner/plan')
        self.trajectories = ros.publisher(topics.JOINT_TRAJECTORY, 'planner/joint_trajectory')
        channels = self.planner._channels.values()
        ros.spin_until(
            lambda: all(x._command.get_subscription_count() for x in channels)
            and all(x.applied.get_subscription_count() for x in self.drivers.values()),
            'the match of commands and news')
        self.clock = make_clock(ros, served)
        self.now = 0
        self.requests = 0
        self.at(START)

    @property
    def runtime(self) -> Runtime:
        """The runtime of the node."""
        runtime: Runtime = self.planner._runtime
        return runtime

    @property
    def driver(self) -> Driver:
        """The only driver."""
        driver, = self.drivers.values()
        return driver

    def at(self, now: int) -> None:
        """Set the time, and have the planner serve."""
        self.clock.set(now)
        self.now = now

    def spin(self, condition: Any, what: str) -> Any:
        """Wait for a condition."""
        return self.ros.spin_until(condition, what)

    def values(self) -> dict[str, str]:
        """Return the newest status' values."""
        return {x.key: x.value for x in self.statuses[-1].values} if self.statuses else {}

    def verdict(self, **values: Any) -> DiagnosticStatus:
        """Wait for a status with values and return it."""
        expected = {x: str(y) for x, y in values.items()}
        self.spin(lambda: expected.items() <= self.values().items(), f'a status of {expected}')
        return self.statuses[-1]

    def send(self, message: JointTrajectory, code: str = 'accepted') -> DiagnosticStatus:
        """Send a trajectory and wait for its verdict."""
        self.requests += 1
        message.header.frame_id = f'request {self.requests}'
        self.trajectories.publish(message)
        return self.verdict(code=code, request=message.header.frame_id)

    def run(self, end: int, step: int = 4 * MS) -> None:
        """Advance time; each command arrives when it is due."""
        while self.now < end:
            self.at(min(self.now + step, end))
            self.spin(
                lambda: all(
                    x.next_stamp is None or x.next_stamp - x.options.lead_time > self.now
                    for x in self.runtime.group.planners.values()),
                'what is due')
            sent = self.runtime.devices.sent + self.runtime.devices.heartbeats
            self.spin(
                lambda sent=sent: sum(
                    x.received for x in self.drivers.values()) >= sent,
                'the commands')
            for driver in self.drivers.values():
                driver.advance(self.now)


@pytest.fixture
def rig(ros: Any, serve: Any, make_clock: Any) -> Any:
    """Return a factory of a rig with node arguments."""
    def make(*arguments: str, joints: tuple[str, ...] = ('',)) -> Rig:
        named = ('-p', f'joints:=[{", ".join(joints)}]') if len(joints) > 1 else ()
        return Rig(ros, make_clock, serve(PlannerNode, *QUIET, *named, *arguments), joints)
    return make


# -- several joints -----------------------------------------------------------------------------

JOINTS = ('left', 'right', 'top')
OTHERS = (
    '-p', 'right.actuator.remanence:=0.15', '-p', 'top.flux_density_max:=0.1',
    '-p', 'top.actuator.density:=4000.0')


def trajectory(names: tuple[str, ...], *points: tuple[float, int]) -> JointTrajectory:
    """Return a request with stretches that differ between joints by 0.01."""
    return to_trajectory(
        [([x + 0.01 * JOINTS.index(name) for name in names], t) for x, t in points], names)


def test_joints_of_one_trajectory_get_what_each_would_alone(rig):
    planner = rig(*OTHERS, joints=JOINTS)
    # The names may come in any order.
    planner.send(trajectory(('top', 'left', 'right'), (1.1, SPELL), (1.2, 2 * SPELL)))
    planner.run(START + LEAD + 2 * SPELL)
    blocks = {
        'left': paper_actuator(), 'right': replace(paper_actuator(), remanence=0.15),
        'top': replace(paper_actuator(), density=4000.0)}
    for k, name in enumerate(JOINTS):
        alone = Planner(blocks[name], Options(
            flux_density_min=-0.5, flux_density_max=0.1 if name == 'top' else 0.5))
        alone.request([(1.1 + 0.01 * k, SPELL), (1.2 + 0.01 * k, 2 * SPELL)], None, START)
        assert planner.drivers[name].arrived == [
            (x.stamp, x.flux_density) for x in alone.due(START + 10**9)]
    planner.verdict(state='at_rest', setpoint=2, setpoints=2, plan=1)
    assert planner.values()['left.stretch'] == '1.2'
    assert planner.values()['top.stretch'] == '1.22'
    assert planner.statuses[-1].hardware_id == 'left, right, top'
    plan, = planner.plans
    assert plan.joint_names == list(JOINTS)
    stamps = {stamp for x in planner.drivers.values() for stamp, _ in x.arrived}
    start = from_time(plan.header.stamp)
    assert [start + from_time(x.time_from_start) for x in plan.points] == sorted(stamps)
    assert all(
        len(x.positions) == len(x.velocities) == len(x.effort) == 3 for x in plan.points)


def test_some_joints_only_by_parameter_and_one_by_its_own_setpoint(rig):
    planner = rig(joints=JOINTS)
    planner.send(trajectory(('left',), (1.1, SPELL)), 'unknown_joint')
    results = planner.ros.set_parameters('planner', [
        Parameter('allow_partial_joints', value=True),
        Parameter('simultaneous_arrival', value=True)])
    assert all(x.successful for x in results)
    planner.send(trajectory(('right', 'top'), (1.1, SPELL)))
    groups = planner.runtime.group.planners
    assert not groups['left'].plan.segments
    assert groups['right'].plan.segments[0].arrival == groups['top'].plan.segments[0].arrival
    setpoints = planner.ros.publisher(topics.SETPOINT, 'planner/left/setpoint')
    setpoints.publish(Float64(data=1.3))
    planner.verdict(code='accepted', request='', plan=2)
    assert groups['left'].plan.segments[0].stretch == 1.3
    answer = planner.ros.call(Trigger, 'planner/stop')
    assert answer.success
    assert all(x.plan.number >= 1 for x in groups.values())


# -- taking over --------------------------------------------------------------------------------


def test_first_request_waits_for_the_state_in_force(rig, ros):
    planner = rig('-p', 'takeover_timeout:=60.0')
    samples = ros_entities.publisher(ros.node, topics.JOINT_STATES)
    ros.spin_until(lambda: planner.planner.count_publishers('joint_states'), 'the publisher')
    driver = planner.driver
    driver.plant.set_state(1.15, 3.0, 0.06)
    planner.trajectories.publish(to_trajectory([(1.3, SPELL)], 'actuator'))
    setpoints = ros.publisher(topics.SETPOINT, 'planner/setpoint')
    # Somebody publishes samples: the planner asks for one, and this request waits its turn.
    ros.spin_until(lambda: samples.get_subscription_count() > 1, 'the subscription')
    setpoints.publish(Float64(data=1.25))
    # One that came after the samples would be planned first.
    planner.spin(lambda: len(planner.runtime.planning.requests) == 2, 'both requests')
    old = driver.sample()
    old.header.stamp = to_time(START - 600 * MS)
    for message in (old, driver.sample('knee')):
        samples.publish(message)
    known = driver.sample()

    def answered() -> bool:
        samples.publish(known)
        return planner.values().get('plan') == '2'

    planner.spin(answered, 'two answers')
    # What is left takes no callback: it is looked at before a request alone.
    ros.spin_until(lambda: samples.get_subscription_count() == 1, 'the end of the subscription')
    planner.spin(
        lambda: planner.plans
        and planner.plans[-1].points[-1].positions[0] == pytest.approx(1.25, abs=1e-9),
        'the second plan')
    point = planner.plans[-1].points
    assert point[0].effort[0] == 0.06
    assert (point[0].positions[0], point[0].velocities[0]) == (1.15, 3.0)
    planner.run(START + 150 * MS)
    assert driver.plant.residual(1.25) < 0.1 * RESIDUAL


@pytest.mark.slow
def test_planner_that_is_killed_is_followed_by_one_that_takes_over(ros, start, make_clock):
    arguments = ('planner', '--ros-args', *QUIET)
    clock = ros.publisher(topics.CLOCK_TOPIC, subscribers=0)
    samples = ros_entities.publisher(ros.node, topics.JOINT_STATES)
    setpoints = ros_entities.publisher(ros.node, topics.SETPOINT, topics.PLANNER)
    statuses = ros.collect(topics.STATUS, 'planner/status')
    driver = Driver(ros)
    now = START

    def matched() -> bool:
        clock.publish(to_clock(now))
        return (
            setpoints.get_subscription_count() and driver.applied.get_subscription_count()
            and clock.get_subscription_count()
            and ros.node.count_publishers('flux_density_command'))

    def let_run(milliseconds: int) -> None:
        nonlocal now
        for _ in range(milliseconds):
            now += MS
            driver.advance(now)
            clock.publish(to_clock(now))
            samples.publish(driver.sample())
            ros.executor.spin_once(0.002)

    first = start.hmsa(*arguments)
    ros.spin_until(matched, 'the first planner')

    def answered() -> bool:
        setpoints.publish(Float64(data=1.3))
        let_run(1)
        return bool(driver.arrived)

    ros.spin_until(answered, 'its first command')
    # Into the middle of its move, whose other half is lost with it.
    driver.hold_back = True
    while driver.plant.time < driver.arrived[0][0] + 3 * MS:
        let_run(1)
    first.popen.send_signal(signal.SIGKILL)
    first.wait()
    sent = len(driver.arrived)
    assert sent == 1
    driver.held.clear()
    driver.hold_back = False
    before = driver.plant.schedule.current
    assert before == driver.arrived[0][1]
    assert abs(driver.plant.rate) > 1.0
    # The dead one stays in the graph for a while: the new one is known by what it says.
    known = len(statuses)
    second = start.hmsa(*arguments)
    ros.spin_until(lambda: len(statuses) > known, 'the second planner')
    # Nothing is sent before it is asked for anything.
    let_run(5)
    assert len(driver.arrived) == sent

    def sent_on() -> bool:
        setpoints.publish(Float64(data=1.2))
        let_run(1)
        return len(driver.arrived) > sent

    ros.spin_until(sent_on, 'its first command')
    assert driver.plant.schedule.current == before
    let_run(150)
    assert driver.plant.residual(1.2) < 0.1 * RESIDUAL
    assert second.stop(signal.SIGINT) == 0


# -- late commands ------------------------------------------------------------------------------


def test_late_command_is_noticed_and_the_rest_planned_anew(rig):
    # A block that vibrates for long: with another, doing nothing leaves as little.
    planner = rig('-p', f'actuator.damping_coefficient:={SLENDER.damping_coefficient}')
    driver = planner.driver
    driver.plant = Plant(SLENDER, time=START)
    hold = 3 * SPELL
    planner.send(to_trajectory(
        [(1.1 + 0.1 * (k % 2), (k + 1) * hold) for k in range(12)], 'actuator'))
    planner.run(START + 9 * hold - 10 * MS)
    # What is sent from here on, of the tenth move, arrives up to 9 ms after its time; most of what
    # was sent before came in time.
    driver.hold_back = True
    planner.run(START + LEAD + 9 * hold + 9 * MS)
    driver.release()
    driver.advance(planner.now)
    status = planner.verdict(code='replanned', replanned=1)
    assert status.level == WARN
    assert 'replanned' in status.message
    assert int(planner.values()['late']) >= 1
    planner.run(START + LEAD + 12 * hold)
    planner.verdict(setpoint=12, setpoints=12, stretch='1.2', plan=1)
    assert driver.plant.residual(1.2) < 0.2 * RESIDUAL


# -- what nobody should send --------------------------------------------------------------------


def test_long_trajectory_leaves_room_for_signs_of_life_and_for_a_stop(rig, ros):
    planner = rig('-p', 'heartbeat_period:=0.02')
    planner.send(to_trajectory([(1.05, SPELL)], 'actuator'))
    # Each spin lets a little simulated time go by, as the planner would not see it otherwise.
    planner.run(START + 200 * MS)
    planner.trajectories.publish(to_trajectory(
        [(1.1 + 0.1 * (k % 2), (k + 1) * SPELL) for k in range(20_000)], 'actuator',
        frame='long'))
    planner.spin(lambda: planner.runtime.wake == 0, 'the planning')
    before = planner.runtime.devices.heartbeats
    planner.run(planner.now + 60 * MS)
    assert planner.runtime.devices.heartbeats > before
    assert ros.call(Trigger, 'planner/stop').message.startswith('stopping: ')
    planner.verdict(code='accepted', request='', plan=2)
    assert planner.runtime.wake != 0


def test_trajectory_that_is_too_long_or_garbage_is_refused(rig):
    planner = rig('-p', 'max_points:=100')
    points = [(1.1, (k + 1) * SPELL) for k in range(101)]
    status = planner.send(to_trajectory(points, 'actuator'), 'too_long')
    assert 'has 101 setpoints: expected at most 100' in status.message
    planner.trajectories.publish(
        serialize_message(to_trajectory(points[:2], 'actuator'))[:60])
    assert 'cannot be decoded' in planner.verdict(code='bad_input', request='').message
    planner.send(to_trajectory(points[:2], 'actuator'))


# -- states and parameters ----------------------------------------------------------------------


def test_deactivated_it_comes_to_rest_and_activated_again_it_takes_over(rig, ros):
    planner = rig('-p', 'heartbeat_period:=0.01')
    driver = planner.driver
    planner.send(to_trajectory(SEQUENCE, 'actuator'))
    planner.at(START + 3 * MS)
    assert ros.change('planner', 'deactivate')
    planner.verdict(code='inactive')
    assert planner.send(to_trajectory(SEQUENCE, 'actuator'), 'inactive').level == ERROR
    sent = planner.runtime.devices.sent + planner.runtime.devices.heartbeats
    planner.spin(lambda: len(driver.arrived) == sent, 'the last commands')
    driver.advance(START + 500 * MS)
    rest = driver.plant.stretch
    assert 1.0 < rest < 1.1
    assert driver.plant.residual(rest) < 0.1 * RESIDUAL
    planner.at(START + 500 * MS)
    samples = ros.publisher(JointState, 'joint_states', 10, subscribers=0)
    ros.spin_until(lambda: planner.planner.count_publishers('joint_states'), 'the publisher')
    assert ros.change('planner', 'activate')
    assert planner.runtime.devices.sent + planner.runtime.devices.heartbeats == sent
    planner.trajectories.publish(to_trajectory([(1.3, SPELL)], 'actuator', frame='again'))

    def answered() -> bool:
        samples.publish(driver.sample())
        return planner.values().get('request') == 'again'

    planner.spin(answered, 'the answer')
    for k in range(30):
        planner.at(START + 500 * MS + k * 5 * MS)
        ros.executor.spin_once(0.005)
        driver.advance(planner.now)
    assert driver.plant.residual(1.3) < 0.3 * RESIDUAL
    assert ros.change('planner', 'deactivate', 'cleanup')
    ros.spin_until(
        lambda: not ros.node.count_publishers('flux_density_command'), 'the end of the topics')
    assert ros.change('planner', 'configure', 'activate')
    ros.spin_until(
        lambda: ros.node.count_publishers('flux_density_command'), 'the topics again')


def test_changed_block_and_lead_time_are_taken_by_the_next_plan(rig):
    planner = rig(joints=('left', 'right'))
    planner.send(to_trajectory(SEQUENCE, 'left'), 'unknown_joint')
    results = planner.ros.set_parameters('planner', [
        Parameter('left.actuator.remanence', value=0.2), Parameter('lead_time', value=0.1),
        Parameter('actuator.damping_coefficient', value=0.3)])
    assert [x.reason for x in results] == [''] * 3
    planner.send(to_trajectory([(1.2, SPELL)], ('left', 'right')))
    for name, remanence in (('left', 0.2), ('right', 0.1)):
        alone = Planner(
            replace(paper_actuator(), remanence=remanence, damping_coefficient=0.3),
            Options(flux_density_min=-0.5, flux_density_max=0.5, lead_time=100 * MS))
        assert [(x.stamp, x.flux_density) for x in (
            planner.runtime.group.planners[name].plan.ahead(START))] == [
            (x.stamp, x.flux_density) for x in alone.setpoint(1.2, START).ahead(START)]
    # 1.2 is held, which a block of so short chains cannot.
    result, = planner.ros.set_parameters('planner', [
        Parameter('right.actuator.chain_limit', value=0.05)])
    assert not result.successful
    assert 'joint right: the stretch that is held is 1.2' in result.reason
    result, = planner.ros.set_parameters('planner', [
        Parameter('left.flux_density_min', value=0.6)])
    assert 'joint left: parameter flux_density_min is 0.6 T' in result.reason


# -- time ---------------------------------------------------------------------------------------


def test_two_clocks_are_told_of_and_their_quarrel_makes_no_storm(rig, make_ros):
    planner = rig()
    arrays = planner.ros.collect(topics.DIAGNOSTICS, '/diagnostics')
    planner.send(to_trajectory(SEQUENCE, 'actuator'))
    other = make_ros()
    clock = other.publisher(topics.CLOCK_TOPIC)
    before = len(planner.statuses)
    for k in range(20):
        jumps = planner.runtime.clock_jumps
        planner.clock.set(START + k * MS)

        def back(k: int = k, jumps: int = jumps) -> bool:
            clock.publish(to_clock(START // 2 + k))
            return planner.runtime.clock_jumps > jumps

        planner.spin(back, 'a jump')
    planner.spin(
        lambda: any('2 publishers on /clock' in x.status[0].message for x in arrays),
        'diagnostics')
    assert planner.runtime.deviations.replanned == 0
    assert sum(
        x.values[0].value == 'clock_jumped' for x in planner.statuses[before:]) < 10


def test_step_of_the_wall_clock_is_noticed():
    steady, offset, pauses = 10**12, 10**18, []

    def reading() -> int:
        nonlocal steady
        steady += pauses.pop() if pauses else 0
        return steady

    watch = StepWatch(lambda: steady + offset, reading)
    assert watch.read() == (steady + offset, 0)
    steady += 10**9
    # It is slewed.
    offset -= 10**5
    assert watch.read() == (steady + offset, 0)
    for by in (-2 * 10**9, 3 * 10**9):
        offset += by
        # The process is interrupted between the readings.
        pauses += [10**9, 0]
        assert watch.read() == (steady + offset, by)
        assert watch.read() == (steady + offset, 0)
    # As often as it is read: the time goes on as if the clock had not been set.
    offset += 10**10
    pauses += [10**9, 0] * 5
    assert watch.read() == (steady + offset - 10**10, 0)
    assert watch.read() == (steady + offset, 10**10)


def test_the_plan_goes_on_when_the_wall_clock_is_set_back(ros, serve):
    served = serve(PlannerNode)
    planner = served.nodes[0]
    statuses = ros.collect(topics.STATUS, 'planner/status')
    setpoints = ros.publisher(topics.SETPOINT, 'planner/setpoint')
    setpoints.publish(Float64(data=1.1))
    ros.spin_until(
        lambda: statuses and statuses[-1].values[0].value == 'accepted', 'the plan')
    # The clock is not really set: levels still to be sent would be late by as much.
    ros.spin_until(
        lambda: not planner._runtime.group.planners['actuator'].pending, 'the last level')
    # As if the last reading had been ten seconds ahead of this one.
    planner._steps._offset += 10**10
    ros.spin_until(
        lambda: statuses and statuses[-1].values[0].value == 'clock_jumped', 'the verdict')
    assert 'the clock of this host was set back by 10.0' in statuses[-1].message
    assert planner._runtime._takeover.engaged
    # Setpoint and level are repeated as before.
    assert planner._runtime.group.planners['actuator'].plan.segments
