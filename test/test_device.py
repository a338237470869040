"""The simulated plant without ROS: its decisions and reports."""

from collections import deque
from dataclasses import replace
import math

from devices import command, MS, START
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from hmsa.errors import BadInputError
from hmsa.interfaces.actuator import enough_samples, too_few_samples
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.sensor import Delay, Sample, Sensor, SensorErrors
from hmsa.model.simulation import ActuatorSimulation
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.device.watchdog import Fallback, GuardedJoint, judge_commands, Kind

ACTUATOR = paper_actuator()


def plant(*, fallback=None, errors=None, joints=1, **settings):
    """Return a simulated device with samples each millisecond, and its first reports."""
    joint = SimulatedJoint(
        Setup(ACTUATOR), fallback or Fallback(), errors or SensorErrors())
    device = SimulatedDevice([joint] * joints, **{'period': MS, 'time': START, **settings})
    begin = settings.get('time', START)
    assert [(x.stamp, x.level) for x in device.changes()] == [(begin, 0.0)] * joints
    return device


def told(device):
    """Return the changes: time after the start in ms, and level."""
    return [((x.stamp - START) / MS, x.level) for x in device.changes()]


def check(samples, commands, *, begin=START):
    """Compare samples with the core's simulation of commands."""
    simulation = ActuatorSimulation(ACTUATOR, time=begin)
    for stamp, level in commands:
        simulation.command(stamp, level)
    for sample in samples:
        simulation.advance(sample.time)
        assert sample.stretch[0] == pytest.approx(simulation.stretch, abs=1e-12)
        assert sample.rate[0] == pytest.approx(simulation.rate, abs=1e-9)
        assert sample.flux_density[0] == simulation.flux_density


# -- the simulated plant ------------------------------------------------------------------------


def test_commands_take_effect_at_their_stamps_and_are_told_once():
    device = plant()
    commands = [(START + 5_500_000, 0.05), (START + 8 * MS + 1, 0.05), (START + 9 * MS, 0.03)]
    for stamp, level in commands:
        device.receive(0, stamp, level)
    device.advance(START + 20 * MS)
    assert told(device) == [(5.5, 0.05), (9.0, 0.03)]
    assert told(device) == []
    samples = device.samples()
    assert [x.time for x in samples] == list(range(START, START + 20 * MS + 1, MS))
    check(samples, commands)
    assert device.notices() == []


@pytest.mark.parametrize('period', [250_000, MS, 3_333_333])
def test_samples_lie_on_their_grid_and_the_motion_does_not_depend_on_them(period):
    device = plant(period=period)
    device.receive(0, START + 1_234_567, 0.05)
    # Between two samples, too.
    for time in range(START, START + 30 * MS, 1_700_001):
        device.advance(time)
    device.advance(START + 30 * MS)
    samples = device.samples()
    assert [x.time for x in samples] == list(range(START, START + 30 * MS + 1, period))
    check(samples, [(START + 1_234_567, 0.05)])


def test_a_command_for_at_once_is_not_late_and_a_late_one_is_told():
    device = plant()
    device.receive(0, 0, 0.05)
    assert device.notices() == []
    device.advance(START + 5 * MS)
    command(device, (2, 0.02), until=6)
    assert told(device) == [(0.0, 0.05), (5.0, 0.02)]
    (notice,) = device.notices()
    assert (notice.kind, notice.joint, notice.late) == (Kind.LATE, 0, 3 * MS)
    assert '3.000 ms after its timestamp' in notice.text


@pytest.mark.parametrize('value', [math.nan, math.inf, 1e300])
@pytest.mark.parametrize('delay', [0, MS])
def test_a_level_nobody_can_follow_is_refused_and_changes_nothing(value, delay):
    device = plant(command_delay=delay)
    device.receive(0, START + 5 * MS, 0.05)
    with pytest.raises(BadInputError, match='flux density is'):
        device.receive(0, START + 2 * MS, value)
    device.advance(START + 10 * MS)
    assert told(device) == [(5.0, 0.05)]


def test_a_joint_whose_load_is_too_large_starts_again_and_the_others_go_on():
    device = plant(joints=2)
    device.receive(0, START + 5 * MS, 1e8)
    device.receive(1, START + 5 * MS, 0.05)
    device.advance(START + 20 * MS)
    (notice,) = device.notices()
    assert (notice.kind, notice.joint) == (Kind.FAILED, 0)
    assert 'too large to follow; the joint starts again' in notice.text
    assert (device.stretch[0], device.flux_density[0]) == (1.0, 0.0)
    check([x._replace(stretch=x.stretch[1:], rate=x.rate[1:], flux_density=x.flux_density[1:])
           for x in device.samples()], [(START + 5 * MS, 0.05)])


@pytest.mark.parametrize(('safe', 'ends'), [
    ('hold', [(5.0, 0.05)]), ('zero', [(5.0, 0.05), (101.0, 0.0)]),
    ('ramp', [(5.0, 0.05)] + [
        (101.0 + k, pytest.approx(0.05 - 0.01 * k, abs=1e-15)) for k in range(1, 6)])])
def test_silence_leads_to_the_safe_flux_and_a_command_back(safe, ends):
    device = plant(fallback=Fallback(0.1, safe, 10.0))
    # Nobody has commanded it yet: no alarm.
    device.advance(START + 300 * MS)
    begin = device.time
    device.receive(0, begin + 5 * MS, 0.05)
    device.advance(begin + 100 * MS)
    assert (device.silent, device.notices()) == ([], [])
    device.advance(begin + 130 * MS)
    assert [(x - 300, y) for x, y in told(device)] == ends
    assert (device.silent, device.trips) == ([0], 1)
    assert [x.kind for x in device.notices()] == [Kind.SILENT]
    if safe != 'hold':
        device.receive(0, 0, 0.0)
    device.receive(0, 0, 0.04)
    device.advance(begin + 180 * MS)
    assert device.flux_density[0] == 0.04
    assert device.silent == []
    assert [x.kind for x in device.notices()] == [Kind.HEARD]


def test_a_heartbeat_is_a_sign_of_life_and_changes_nothing():
    device = plant(fallback=Fallback(0.1, 'zero'))
    device.receive(0, START + 3_456_789, 0.05)
    for _ in range(4):
        device.advance(device.time + 80 * MS)
        device.receive(0, device.time + 50 * MS, 0.05)
    assert device.trips == 0
    check(device.samples(), [(START + 3_456_789, 0.05)])


def test_delays_hold_back_commands_and_samples_but_not_their_stamps():
    device = plant(command_delay=4 * MS, measurement_delay=3 * MS)
    # In time for 6 ms ahead, 2 ms late for 2 ms ahead.
    command(device, (6, 0.05), until=10)
    command(device, (12, 0.02), until=20)
    assert told(device) == [(6.0, 0.05), (14.0, 0.02)]
    assert [x.late for x in device.notices()] == [2 * MS]
    samples = device.samples()
    assert samples[-1].time == START + 17 * MS
    check(samples, [(START + 6 * MS, 0.05), (START + 14 * MS, 0.02)])
    device.receive(0, START + 30 * MS, 0.1)
    device.drop_commands()
    device.advance(START + 40 * MS)
    assert told(device) == []


def test_a_device_follows_a_clock_that_runs_stands_and_jumps():
    device = plant(time=0)
    # It begins where the clock is, on the grid.
    assert device.follow(START + 1) == 0
    assert device.next_sample == START + MS
    device.advance(START + 10 * MS)
    command(device, (12, 0.1), (500, 0.2))
    # Held for a while: what fell due meanwhile takes effect when time runs again.
    assert device.follow(START + 40 * MS, standing=True) == 0
    device.advance(START + 60 * MS)
    assert [(x.stamp, x.level) for x in device.changes()] == [(START + 40 * MS, 0.1)]
    assert device.samples()[-21].time == START + 40 * MS
    # A large jump ahead is skipped.
    state = float(device.stretch[0])
    ahead = 3600 * START
    assert device.follow(ahead) == ahead - (START + 60 * MS)
    assert (device.time, device.stretch[0]) == (ahead, state)
    # Back in time it starts again, and forgets what was commanded.
    assert device.follow(START) == START - ahead
    device.advance(START + 600 * MS)
    assert {x.stretch[0] for x in device.samples() if x.time < ahead} == {1.0}
    assert device.flux_density[0] == 0.0
    # Less than a sample back is none.
    assert device.follow(device.time - 1) == 0


def test_time_that_was_not_simulated_is_no_silence():
    device = plant(time=0, fallback=Fallback(1.0, 'zero'))
    device.follow(START)
    command(device, (0, 0.05), until=10)
    device.follow(5 * START, standing=True)
    device.advance(5 * START + 900 * MS)
    assert device.trips == 0
    device.advance(5 * START + 1100 * MS)
    assert device.trips == 1


def test_a_restart_leads_to_the_state_asked_for_and_forgets_what_was_ahead():
    device = plant()
    device.receive(0, START + 500 * MS, 0.2)
    device.restart(0, 1.2, 2.5)
    simulation = ActuatorSimulation(ACTUATOR, stretch=1.2, time=START)
    simulation.set_state(1.2, 2.5, simulation.flux_density)
    for time in range(START, START + 600 * MS, 50 * MS):
        device.advance(time)
        simulation.advance(time)
        assert device.stretch[0] == pytest.approx(simulation.stretch, abs=1e-12)


def test_the_same_seed_gives_the_same_run_bit_for_bit():
    runs = []
    for seed in (7, 7, 8):
        device = plant(errors=SensorErrors(1e-3, 0.5), seed=seed)
        device.receive(0, START + 20 * MS + 123, 0.05)
        device.advance(START + 100 * MS)
        runs.append(np.array([(*x.stretch, *x.rate) for x in device.samples()]).tobytes())
    assert runs[0] == runs[1] != runs[2]


# -- the pieces ---------------------------------------------------------------------------------


def measured(sensor, count):
    found = []
    for k in range(count):
        ones = np.ones(2)
        found += sensor.measure(Sample(k * MS, ones, 2.0 * ones, 3.0 * ones))
    return found


def test_noise_has_its_deviation_and_its_seed():
    errors = [SensorErrors(stretch_noise=0.01), SensorErrors(rate_noise=5.0)]
    runs = [measured(Sensor(errors, seed=x), 4000) for x in (1, 1, 2)]
    stretch = np.array([x.stretch for x in runs[0]])
    rate = np.array([x.rate for x in runs[0]])
    assert stretch[:, 0].std() == pytest.approx(0.01, rel=0.05)
    assert stretch[:, 0].mean() == pytest.approx(1.0, abs=1e-3)
    assert rate[:, 1].std() == pytest.approx(5.0, rel=0.05)
    assert set(stretch[:, 1]) == {1.0}
    assert set(rate[:, 0]) == {2.0}
    assert all(np.array_equal(a.stretch, b.stretch) for a, b in zip(*runs[:2], strict=True))
    assert not np.array_equal(runs[0][0].stretch, runs[2][0].stretch)
    assert all(set(x.flux_density) == {3.0} for x in runs[0])


def test_bias_and_gain_are_those_of_the_sensor_alone():
    sensor = Sensor([SensorErrors(stretch_bias=0.05, stretch_gain=1.1), SensorErrors()])
    (sample,) = measured(sensor, 1)
    assert list(sample.stretch) == [0.05 + 1.1, 1.0]
    assert list(sample.rate) == [2.2, 2.0]
    assert list(sample.flux_density) == [3.0, 3.0]


@pytest.mark.parametrize(('make', 'sentence'), [
    (lambda: SensorErrors(stretch_noise=-1.0), 'stretch_noise is -1: expected'),
    (lambda: SensorErrors(stretch_gain=0.0), 'stretch_gain is 0: expected'),
    (lambda: SensorErrors(stretch_bias=math.nan), 'stretch_bias is nan'),
    (lambda: Fallback(-1.0), 'timeout is -1 s'),
    (lambda: Fallback(safe_flux='full'), "'full': expected one of hold, zero, ramp"),
    (lambda: Fallback(ramp_rate=0.0), 'ramp rate is 0 T/s'),
    (lambda: Delay(-1), 'delay is -1 ns')])
def test_settings_out_of_range_are_refused(make, sentence):
    with pytest.raises(BadInputError, match=sentence):
        make()


def test_the_watchdog_waits_for_a_first_command_and_leaves_pauses_out():
    notices = deque()
    dog = GuardedJoint(0, Fallback(1e-8), notices)

    def trips(now):
        before = dog.trips
        assert list(dog.watch(now, now, 0.0)) == []
        return dog.trips > before

    assert not trips(1000)
    dog.feed(1000)
    assert not notices
    assert not trips(1010)
    assert dog.watch_due == 1011
    assert trips(1011)
    assert not trips(1012)
    dog.feed(1020)
    assert [x.kind for x in notices] == [Kind.SILENT, Kind.HEARD]
    dog.pass_over(50)
    assert not trips(1080)
    assert trips(1081)
    dog.stand_by()
    assert not trips(5000)
    dog = GuardedJoint(0, Fallback(0.0), notices)
    dog.feed(0)
    assert not trips(10**18)


@given(st.lists(st.integers(0, 5), max_size=30), st.integers(0, 7))
@settings(deadline=None)
def test_what_is_sent_arrives_once_in_order_and_its_delay_later(waits, delay):
    transport = Delay(delay)
    now, sent, came = 0, [], []
    for wait in waits:
        now += wait
        came += transport.arrived(now)
        transport.put(now, len(sent))
        sent.append((now + delay, len(sent)))
        assert came == [x for x in sent if x[0] <= now and x in came]
    came += transport.arrived(now + delay)
    assert came == sent


def test_a_sample_rate_too_low_for_the_actuator_is_told():
    assert too_few_samples(ACTUATOR, 1000.0) == ''
    small = replace(ACTUATOR, half_length=ACTUATOR.half_length / 8.0,
                    half_thickness=ACTUATOR.half_thickness / 8.0)
    text = too_few_samples(small, 1000.0)
    assert f'a publish_rate of {math.ceil(enough_samples(small))}' in text
    assert too_few_samples(small, enough_samples(small)) == ''


def test_the_verdict_on_commands_names_what_is_wrong():
    assert judge_commands() == (0, 'commands in time')
    assert judge_commands(late=2, refused=1, refused_source=3) == (
        1, '2 commands late, 4 refused')
    assert judge_commands(crowded=[f'joint_{i}' for i in range(6)]) == (
        1, 'several publishers command joint_0, joint_1, joint_2, joint_3 and 2 more')
    assert judge_commands(failed=1, silent=['a']) == (
        2, '1 times started again after a load too large to follow; no command and no '
           'heartbeat for a')
