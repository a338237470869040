"""The plant node over ROS: timestamped commands in, samples of the simulated actuator out."""

from collections.abc import Callable, Sequence
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger

from hmsa.interfaces import topics
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import residual_vibration, simulate
from hmsa.planning.planner import Options, Planner
from hmsa_ros.nodes.conversions import from_time, to_clock, to_command
from hmsa_ros.nodes.plant import PlantNode

pytestmark = pytest.mark.ros

MS = 1_000_000
START = 1000 * MS
SPELL = 44 * MS
# Difference to the core's simulation of the same commands, of stretches of order 1.
SAME = 1e-10
# Residual vibration after arrival, as a share of the step.
NO_VIBRATION = 1e-6
ACTUATOR = paper_actuator()
LEADING = ('-p', 'publish_clock:=true', '-p', 'start_paused:=true')
# Keeps every sample of a batch, however late it is looked at.
EVERY = QoSProfile(depth=200_000)
# Off every grid of samples, and one that lies nearer to its predecessor than a sample.
COMMANDS = (
    (START + 20_345_679, 0.05), (START + 25_123_457, 0.08), (START + 40_000_000, 0.12),
    (START + 40_000_500, -0.03), (START + 63_999_999, 0.02))
END = START + 100 * MS


def response(
        commands: Sequence[tuple[int, float]], stamps: Sequence[int], *, start: int = START,
        stretch: float = 1.0, flux_density: float = 0.0) -> tuple[Any, Any]:
    """Return stretch and rate in 1/s from the core's simulation of commands from rest."""
    unit = ACTUATOR.time_unit
    switches = [0.0, *((x - start) / 1e9 / unit for x, _ in commands)]
    loads = [x / ACTUATOR.flux_density_unit for x in (flux_density, *(y for _, y in commands))]
    stretches, rates = simulate(
        switches, loads, [(x - start) / 1e9 / unit for x in stamps], ACTUATOR.nondimensional,
        stretch=stretch)
    return stretches, rates / unit


def levels(commands: Sequence[tuple[int, float]], stamps: Sequence[int]) -> list[float]:
    """Return the flux density in force at each timestamp."""
    return [next((y for x, y in reversed(commands) if x <= t), 0.0) for t in stamps]


class Bench:
    """A plant node, its samples, and a publisher of commands."""

    def __init__(self, ros: Any, served: Any) -> None:
        self.ros = ros
        self.served = served
        self.samples = self.collect(topics.JOINT_STATES, EVERY)
        command = topics.FLUX_DENSITY_COMMAND
        self.publisher = ros.publisher(command.type, command.name, command.qos)

    def collect(self, topic: topics.Topic, qos: QoSProfile | None = None) -> list[Any]:
        """Return the list of messages of a topic, once its publisher is discovered."""
        messages: list[Any] = self.ros.collect(topic.type, topic.name, qos or topic.qos)
        self.ros.spin_until(lambda: self.ros.node.count_publishers(topic.name), topic.name)
        return messages

    def send(self, *commands: tuple[int, float]) -> None:
        """Send commands, and return when the plant has received them."""
        for stamp, flux_density in commands:
            self.publisher.publish(to_command(stamp, flux_density, 'coil'))
        self.delivered()

    def delivered(self) -> None:
        """Return when the plant has received all messages."""
        assert self.publisher.wait_for_all_acked(Duration(seconds=60))

    def pause(self, paused: bool = True) -> None:
        """Pause or resume the plant."""
        answer = self.ros.call(
            SetBool, topics.from_outside(topics.SET_PAUSED.name, 'plant'),
            SetBool.Request(data=paused))
        assert (answer.success, answer.message) == (True, 'paused' if paused else 'running')

    def trigger(self, service: topics.Service) -> Any:
        """Call a service."""
        return self.ros.call(Trigger, topics.from_outside(service.name, 'plant'))

    def step(self) -> int:
        """Make one step, and return the resulting time in ns."""
        known = len(self.samples)
        answer = self.trigger(topics.STEP)
        assert answer.success
        self.ros.spin_until(
            lambda: len(self.samples) > known
            and answer.message == f'at {self.stamps()[-1] / 1e9:.9f} s', answer.message)
        return self.stamps()[-1]

    def stamps(self) -> list[int]:
        """Return the samples' timestamps in ns."""
        return [from_time(x.header.stamp) for x in self.samples]

    def wait(self, stamp: int) -> None:
        """Wait for a sample with a timestamp, or a later one."""
        self.ros.spin_until(
            lambda: self.samples and from_time(self.samples[-1].header.stamp) >= stamp,
            f'the sample at {stamp} ns')

    def run(self, end: int) -> None:
        """Run the plant at least until an end, and pause it."""
        self.pause(False)
        self.wait(end)
        self.pause()

    def check(self, commands: Sequence[tuple[int, float]], **start: Any) -> None:
        """Compare the samples with the core's simulation of commands."""
        stamps = self.stamps()
        stretches, rates = response(commands, stamps, **start)
        np.testing.assert_allclose(
            [x.position[0] for x in self.samples], stretches, rtol=0.0, atol=SAME)
        np.testing.assert_allclose(
            [x.velocity[0] for x in self.samples], rates, rtol=0.0,
            atol=SAME / ACTUATOR.time_unit)
        if not start:
            assert [x.effort[0] for x in self.samples] == levels(commands, stamps)

    def diagnostics(self, **values: Any) -> DiagnosticStatus:
        """Wait for diagnostics with values, and return them."""
        arrays = self.collect(topics.DIAGNOSTICS)
        expected = {key: str(value) for key, value in values.items()}

        def seen() -> bool:
            return bool(arrays) and expected.items() <= {
                x.key: x.value for x in arrays[-1].status[0].values}.items()

        self.ros.spin_until(seen, f'diagnostics with {expected}')
        return arrays[-1].status[0]


@pytest.fixture
def bench(ros: Any, serve: Any) -> Callable[..., Bench]:
    """Return a factory of a bench with node arguments."""
    def make(*arguments: str) -> Bench:
        return Bench(ros, serve(PlantNode, *arguments))
    return make


@pytest.fixture
def leading(bench: Callable[..., Bench]) -> Bench:
    """Return a plant that publishes simulated time, paused at its start."""
    return bench(*LEADING)


@pytest.fixture
def following(bench: Callable[..., Bench], make_clock: Any) -> tuple[Bench, Any]:
    """Return a plant that follows /clock, and the clock."""
    plant = bench('-p', 'use_sim_time:=true')
    return plant, make_clock(plant.ros, plant.served)


# -- commands ----------------------------------------------------------------------------------

def test_commands_apply_exactly_at_their_stamps_inside_the_step(leading):
    leading.send(*COMMANDS)
    leading.run(END)
    assert np.ptp([x.position[0] for x in leading.samples]) > 0.1
    leading.check(COMMANDS)


def test_late_command_applies_at_once_and_is_counted(leading):
    leading.send((START - 23_456_789, 0.05), (START - 2 * MS, 0.06))
    leading.run(END)
    leading.check([(START, 0.06)])
    status = leading.diagnostics(
        received=2, late=2, refused=0, largest_lateness_ms='23.457', paused=True)
    assert status.level == DiagnosticStatus.WARN
    assert status.message == '2 commands late, 0 refused'
    assert status.name == 'plant: commands'
    assert status.hardware_id == 'actuator'


BAD = {
    'nan_x': (math.nan, 0.0, 0.0, 1),
    'nan_z': (0.0, 0.0, math.nan, 1),
    'infinite': (0.0, 0.0, math.inf, 1),
    'minus_infinite': (0.0, 0.0, -math.inf, 1),
    'along_x': (1e-9, 0.0, 0.1, 1),
    'along_y': (0.0, -0.1, 0.1, 1),
    'negative_stamp': (0.0, 0.0, 0.1, -1),
    'absurd': (0.0, 0.0, 1e300, 1),
}


def bad_command(name: str) -> Any:
    """Return a bad command, which would replace all others."""
    x, y, z, sign = BAD[name]
    message = to_command(sign * START, z, 'coil')
    message.magnetic_field.x, message.magnetic_field.y = x, y
    return message


def test_bad_commands_are_refused_and_counted_and_the_run_goes_on(leading):
    for name in BAD:
        leading.publisher.publish(bad_command(name))
    leading.send(*COMMANDS)
    leading.run(END)
    leading.check(COMMANDS)
    status = leading.diagnostics(received=len(BAD) + len(COMMANDS), refused=len(BAD), late=0)
    assert status.level == DiagnosticStatus.WARN
    assert status.message == f'0 commands late, {len(BAD)} refused'


# -- samples -----------------------------------------------------------------------------------

def test_sample_has_stretch_rate_and_flux_density_of_the_joint(bench):
    plant = bench(*LEADING, '-p', 'joint:=knee', '-p', 'initial_stretch:=1.2')
    stretches = plant.collect(topics.STRETCH, EVERY)
    rates = plant.collect(topics.STRETCH_RATE, EVERY)
    plant.send((START + 3 * MS, 0.05))
    plant.run(START + 20 * MS)
    plant.ros.spin_until(
        lambda: len(stretches) == len(rates) == len(plant.samples), 'all three topics')
    assert [x.data for x in stretches] == [x.position[0] for x in plant.samples]
    assert [x.data for x in rates] == [x.velocity[0] for x in plant.samples]
    assert {tuple(x.name) for x in plant.samples} == {('knee',)}
    first = plant.samples[0]
    assert (first.position[0], first.velocity[0]) == (1.2, 0.0)
    # At rest before the first command: held by its flux density.
    plant.check([(START + 3 * MS, 0.05)], stretch=1.2, flux_density=first.effort[0])
    assert np.ptp([x.data for x in stretches[:4]]) < SAME


# -- time --------------------------------------------------------------------------------------

def test_clock_and_samples_have_the_same_time_and_it_keeps_to_the_real_time_factor(bench):
    plant = bench(*LEADING, '-p', 'real_time_factor:=0.1', '-p', 'start_time:=5.0')
    clocks = plant.collect(topics.CLOCK_TOPIC, QoSProfile(
        depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT))
    begin = time.monotonic_ns()
    plant.run(5 * 10**9 + 30 * MS)
    taken = time.monotonic_ns() - begin
    stamps = plant.stamps()
    assert stamps[0] == 5 * 10**9
    # An upper bound that no load can break: a slow machine only falls behind.
    assert stamps[-1] - stamps[0] <= taken / 10
    times = [from_time(x.clock) for x in clocks]
    assert times == sorted(times)
    assert set(times) <= {5 * 10**9, *stamps}


def test_batch_runs_commands_that_were_queued_while_paused_without_residual_vibration(bench):
    plant = bench(*LEADING, '-p', 'real_time_factor:=0.0')
    planner = Planner(ACTUATOR, Options())
    targets = (1.1, 1.2, 1.4)
    plan = planner.request(
        [(x, (k + 1) * SPELL) for k, x in enumerate(targets)], START + 60 * MS, START)
    commands = [(x.stamp, x.flux_density) for x in plan.levels if x.stamp > 0]
    assert len(commands) == 6
    plant.send(*commands)
    end = START + 60 * MS + 3 * SPELL
    plant.run(end)
    stamps = np.array(plant.stamps())
    stretches = [x.position[0] for x in plant.samples]
    np.testing.assert_array_equal(np.diff(stamps), MS)
    previous = 1.0
    for segment, until in zip(
            plan.segments, [*(x.begin for x in plan.segments[1:]), end], strict=True):
        assert residual_vibration(
            stamps, stretches, arrival=segment.arrival, end=until,
            step=segment.stretch - previous) <= NO_VIBRATION
        assert np.interp(until, stamps, stretches) == pytest.approx(segment.stretch, abs=1e-8)
        previous = segment.stretch


def test_paused_plant_stands_still_and_repeats_its_time(leading):
    clocks = leading.collect(topics.CLOCK_TOPIC)
    leading.ros.spin_until(lambda: len(clocks) >= 3, 'the time while paused')
    assert {from_time(x.clock) for x in clocks} == {START}
    assert leading.samples == []


def test_each_step_advances_a_paused_plant_and_the_clock_by_one_sample(leading):
    clocks = leading.collect(topics.CLOCK_TOPIC, QoSProfile(
        depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT))
    leading.send((START + MS // 2, 0.05))
    assert [leading.step() for _ in range(3)] == [START + k * MS for k in (1, 2, 3)]
    leading.ros.spin_until(
        lambda: clocks and from_time(clocks[-1].clock) == START + 3 * MS, 'the clock')
    # The start itself is a sample too.
    assert leading.stamps() == [START + k * MS for k in range(4)]
    leading.run(END)
    assert leading.stamps()[:5] == [START + k * MS for k in range(5)]
    leading.check([(START + MS // 2, 0.05)])


def test_step_is_refused_while_the_plant_runs(leading):
    leading.pause(False)
    answer = leading.trigger(topics.STEP)
    assert not answer.success
    assert 'expected it paused' in answer.message


def test_following_plant_samples_up_to_the_time_on_clock_and_no_further(following):
    plant, clock = following
    clock.set(START)
    plant.wait(START)
    plant.send(*COMMANDS)
    for now in (START + 30 * MS, START + 30 * MS + 1, START + 55 * MS - 1, END):
        clock.set(now)
        plant.wait(now // MS * MS)
        assert plant.stamps() == list(range(START, now + 1, MS))
    plant.check(COMMANDS)


def test_following_plant_starts_again_when_the_clock_jumps_back(following):
    plant, clock = following
    clock.set(START)
    plant.wait(START)
    plant.send((START, 0.1), (START + 20 * MS, 0.2))
    clock.set(START + 10 * MS)
    plant.wait(START + 10 * MS)
    assert plant.samples[-1].position[0] > 1.01
    clock.set(START // 2)
    plant.ros.spin_until(lambda: plant.stamps()[-1] == START // 2, 'the sample after the jump')
    known = len(plant.samples) - 1
    for now in range(START // 2, START + 50 * MS, 100 * MS):
        clock.set(now)
        plant.wait(now)
    # At rest, and what was commanded for the old time does not come back.
    assert {(x.position[0], x.effort[0]) for x in plant.samples[known:]} == {(1.0, 0.0)}
    plant.send((START, 0.05))
    clock.set(END)
    plant.wait(END)
    assert plant.samples[-1].effort[0] == 0.05


def test_following_plant_tells_of_two_clocks_and_of_one_again(following, make_ros):
    plant, clock = following
    arrays = plant.collect(topics.DIAGNOSTICS)

    def told() -> str:
        return str(arrays[-1].status[1].message) if arrays else ''

    clock.set(START)
    plant.wait(START)
    other = make_ros()
    second = other.publisher(topics.CLOCK_TOPIC)
    plant.ros.spin_until(lambda: '2 publishers of /clock' in told(), 'two clocks')
    # Far behind: the simulation starts again, and goes on with whoever comes next.

    def behind() -> bool:
        second.publish(to_clock(START // 2))
        return plant.stamps()[-1] <= START // 2

    plant.ros.spin_until(behind, 'the time of the second')
    other.node.destroy_publisher(second)
    plant.ros.spin_until(lambda: told().startswith('time runs'), 'one clock')
    clock.set(START + 10 * MS)
    plant.wait(START + 10 * MS)
    assert plant.samples[-1].position[0] == 1.0


def test_following_plant_can_be_paused(following):
    plant, clock = following
    clock.set(START)
    plant.wait(START)
    plant.send((START + 40 * MS, 0.1))
    plant.pause()
    clock.set(START + 50 * MS)
    answer = plant.trigger(topics.STEP)
    assert not answer.success
    assert 'expected publish_clock true' in answer.message
    plant.diagnostics(time=f'{(START + 50 * MS) / 1e9:.9f}')
    assert plant.stamps() == [START]
    plant.pause(False)
    clock.set(START + 60 * MS)
    plant.wait(START + 60 * MS)
    # What fell due in the pause applies when it is over.
    del plant.samples[0]
    assert plant.stamps() == [START + k * MS for k in range(50, 61)]
    plant.check([(START + 50 * MS, 0.1)], start=START + 50 * MS)


def test_plant_on_the_wall_clock_samples_the_present(bench):
    begin = time.time_ns()
    plant = bench()
    plant.ros.spin_until(lambda: len(plant.samples) > 100, 'samples')
    first = plant.stamps()[-1]
    plant.send((0, 0.05))
    plant.ros.spin_until(lambda: plant.samples[-1].effort[0] == 0.05, 'the command')
    plant.wait(first + 50 * MS)
    stamps = plant.stamps()
    assert begin <= stamps[0]
    assert stamps[-1] <= time.time_ns()
    assert stamps == list(range(stamps[0], stamps[-1] + 1, MS))
    efforts = [x.effort[0] for x in plant.samples]
    applied = efforts.index(0.05)
    assert set(efforts[applied:]) == {0.05}
    # Stamp 0 means at once: at the sample that the plant had reached.
    plant.check([(stamps[applied - 1], 0.05)], start=stamps[0])


def test_a_plant_that_falls_behind_the_clock_says_so_once_in_its_diagnostics(bench, monkeypatch):
    plant = bench()
    arrays = plant.collect(topics.DIAGNOSTICS)
    plant.ros.spin_until(lambda: len(plant.samples) > 100, 'samples')
    device = plant.served.nodes[0].device
    follow, jumps = device.follow, [2 * 10**9]
    monkeypatch.setattr(
        device, 'follow', lambda *x, **y: follow(*x, **y) or (jumps.pop() if jumps else 0))
    said = 'the plant fell 2.000 s behind the clock: lower publish_rate'

    def words() -> list[str]:
        return [y.message for x in arrays for y in x.status if y.name == 'plant: time']

    plant.ros.spin_until(lambda: said in words() and words()[-1] != said, said)
    (warning,) = (y for x in arrays for y in x.status if y.message == said)
    assert warning.level == DiagnosticStatus.WARN


def test_plant_keeps_to_its_namespace(ros, serve):
    serve(PlantNode, *LEADING, '-r', '__ns:=/left')
    expected = {
        '/left/joint_states', '/left/stretch', '/left/stretch_rate',
        '/left/flux_density_command', '/clock', '/diagnostics'}
    ros.spin_until(
        lambda: expected <= {x for x, _ in ros.node.get_topic_names_and_types()}, 'the topics')
    assert ros.call(SetBool, '/left/plant/set_paused', SetBool.Request(data=True)).success
