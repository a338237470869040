"""The driver node: hardware in place of the plant, alone and with a planner in one process."""

from pathlib import Path
import sys

import pytest

from hmsa.cli import main
from hmsa.interfaces import topics
from hmsa_ros.nodes.conversions import from_time, to_command

TUTORIALS = Path(__file__).resolve().parent.parent / 'docs' / 'tutorials'
BENCH = ('--ros-args', '-p', 'hardware:=hardware:Bench')
SECOND = 1_000_000_000

# Writes down what it is asked, and breaks when it is read for the hundredth time.
BROKEN = """\
class Coil:
    def __init__(self, joint):
        self.log = open(joint, 'a', buffering=1)
        self.reads = 0

    def write(self, level, now):
        self.log.write(f'{level}\\n')
        return now

    def read(self, now):
        self.reads += 1
        if self.reads == 100:
            raise OSError('the cable is out')
        return 1.0, 0.0


def nothing(joint):
    return object()
"""


def field(ros):
    """Return a list that receives the levels that took effect."""
    topic = topics.FLUX_DENSITY_APPLIED
    return ros.collect(topic.type, topic.name, topic.qos)


@pytest.mark.ros
def test_driver_of_the_tutorial_keeps_the_contract_of_a_driver(start, ros):
    applied = field(ros)
    states = ros.collect(topics.JOINT_STATES.type, topics.JOINT_STATES.name)
    # Long enough for a busy machine to hear all commands before the first one applies.
    driver = start.hmsa(
        'driver', *BENCH, '-p', 'command_timeout:=3.0', PYTHONPATH=str(TUTORIALS))
    command = ros.publisher(topics.FLUX_DENSITY_COMMAND)
    ros.spin_until(lambda: applied and states, 'the level at the start')
    assert applied[0].magnetic_field.z == 0.0
    driver.wait_for_output(
        'Bench for joint actuator: limit 0.5 T, resolution not given, slew not given, read at '
        '1000 Hz, zero after 3 s without a command; hardware.timeout 1 s')

    now = ros.node.get_clock().now().nanoseconds
    stamps = [now + SECOND * 2, now + SECOND * 25 // 10]
    command.publish(to_command(stamps[0], 0.01, 'coil'))
    # Taken back by the one after it, which is stamped before it.
    command.publish(to_command(now + SECOND * 29 // 10, 0.5, 'coil'))
    command.publish(to_command(stamps[1], 0.02, 'coil'))
    for bad in (float('nan'), 0.51):
        command.publish(to_command(stamps[1] + 1, bad, 'coil'))
    # No word follows: the watchdog switches off.
    ros.spin_until(lambda: len(applied) == 4, 'two levels, and the coil switched off')
    assert [x.magnetic_field.z for x in applied] == [0.0, 0.01, 0.02, 0.0]
    assert all(from_time(x.header.stamp) >= stamp
               for x, stamp in zip(applied[1:], [*stamps, now + 3 * SECOND], strict=False))
    assert states[-1].name == ['actuator']
    assert driver.stop() == 0
    assert 'command refused, the previous one stays in force: flux density command (0, 0, nan)' \
        in driver.stderr
    assert 'no command and no heartbeat for 3 s: the field goes to zero' in driver.stderr


@pytest.mark.ros
@pytest.mark.parametrize('node', [('plant',), ('driver', *BENCH)])
def test_receipts_tell_commands_that_came_too_late_from_those_that_apply(start, ros, node):
    receipts = ros.collect(topics.FLUX_DENSITY_RECEIVED)
    device = start.hmsa(*node, PYTHONPATH=str(TUTORIALS))
    command = ros.publisher(topics.FLUX_DENSITY_COMMAND)
    ros.spin_until(lambda: receipts and command.get_subscription_count(), 'the first receipt')
    for ahead, said in ((0.0, ''), (-1.0, 'late'), (0.5, '')):
        stamp = ros.node.get_clock().now().nanoseconds + round(ahead * SECOND)
        command.publish(to_command(stamp, 0.01, 'coil'))
        ros.spin_until(
            lambda stamp=stamp: from_time(receipts[-1].time_ref) == stamp, 'its receipt')
        assert receipts[-1].header.frame_id == said
    assert device.stop() == 0


@pytest.mark.ros
def test_hardware_that_breaks_ends_the_driver_with_all_coils_switched_off(start, ros, tmp_path):
    (tmp_path / 'lab.py').write_text(BROKEN)
    applied = field(ros)
    driver = start(
        'sh', '-c', 'cd "$0" && exec "$@"', tmp_path, sys.executable, '-m', 'hmsa_ros',
        'driver', '--ros-args', '-p', 'hardware:=lab:Coil', '-p', 'publish_rate:=20.0')
    command = ros.publisher(topics.FLUX_DENSITY_COMMAND)
    ros.spin_until(lambda: applied, 'the level at the start')
    command.publish(to_command(0, 0.25, 'coil'))
    assert driver.wait() == 1
    assert driver.stderr.splitlines()[-1] == (
        "hmsa: error: Coil.read of joint actuator raised OSError: 'the cable is out': the coil is "
        'switched off; correct it, then start the driver again')
    written = (tmp_path / 'actuator').read_text().split()
    assert (written[:2], written[-1]) == (['0.0', '0.25'], '0.0')


@pytest.mark.ros
@pytest.mark.parametrize(('arguments', 'expected'), [
    ((), "hardware is '': expected MODULE:NAME"),
    (('hardware:=nowhere:Coil',), "hardware 'nowhere:Coil' cannot be loaded "
                                  '(ModuleNotFoundError'),
    (('hardware:=hardware:Coil',), "hardware 'hardware:Coil' cannot be loaded (AttributeError"),
    (('hardware:=math:sqrt',), "hardware 'math:sqrt' of joint actuator does not start"),
    (('hardware:=builtins:str',), 'expected something with the methods write and read'),
    (('hardware.name:=hardware:Bench', 'hardware.prot:=/dev/x'),
     "does not start (TypeError: \"Bench.__init__() got an unexpected keyword argument 'prot'\""),
    (('hardware:=hardware:Bench', 'use_sim_time:=true'), 'use_sim_time is true: expected false')])
def test_hardware_that_cannot_be_had_refuses_the_start(
        ros_env, handlers, monkeypatch, capfd, arguments, expected):
    monkeypatch.syspath_prepend(TUTORIALS)
    given = [x for argument in arguments for x in ('-p', argument)]
    assert main(['driver', '--ros-args', *given]) == 2
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith('hmsa: error: ')
    assert expected in line


@pytest.mark.ros
def test_a_controller_with_hardware_moves_it_and_says_what_it_measured(start, ros):
    applied = field(ros)
    # A busy machine writes levels late, whatever that leaves.
    controller = start.hmsa(
        'controller', *BENCH, '-p', 'vibration_tolerance:=3.0', PYTHONPATH=str(TUTORIALS))
    # It also leaves levels out: then the sequence is sent again.
    for _ in range(4):
        send = start.hmsa('send', '1.1:0.3', '1.0:0.3', '--wait', '--timeout', '60')
        status = send.wait()
        ros.spin_until(
            lambda: any(x.magnetic_field.z for x in applied)
            and not applied[-1].magnetic_field.z, 'the last level')
        if status == 0 and len(applied) >= 5:
            break
    assert status == 0, send.output
    assert 'measured' in send.output

    def names():
        return {x for x, _ in ros.node.get_node_names_and_namespaces()}

    ros.spin_until(lambda: {'planner', 'driver'} <= names(), 'both nodes of the controller')
    assert 'plant' not in names()
    # The level at the start, and two for each move.
    ros.spin_until(lambda: len(applied) >= 5, 'the levels of two moves')
    assert controller.stop() == 0, controller.output
