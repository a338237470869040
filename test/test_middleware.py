"""Middleware settings of the package's processes."""

import os
from pathlib import Path
import signal
from time import monotonic

import pytest

from hmsa_ros.middleware import prepare_middleware, PROFILES, profiles, RANGE

OTHERS = ('ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY')
# More than a reader's queue in shared memory holds, from a writer that keeps all of it.
FLOOD = 2000

READER = f"""
import rclpy
from std_msgs.msg import Empty, String
rclpy.init()
node = rclpy.create_node('reader')
node.create_subscription(Empty, 'flood', lambda _: None, {FLOOD})
node.create_subscription(String, 'rare', lambda x: print('got', x.data, flush=True), 10)
print('reads', flush=True)
rclpy.spin(node)
"""
WRITER = f"""
import signal
import sys
import time
from hmsa_ros.middleware import prepare_middleware
import rclpy
from std_msgs.msg import Empty, String
name = sys.argv[1]
if name == 'ours':
    prepare_middleware()
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
rclpy.init()
node = rclpy.create_node(name)
flood = node.create_publisher(Empty, 'flood', {FLOOD})
rare = node.create_publisher(String, 'rare', 10)
while not (rare.get_subscription_count() and flood.get_subscription_count()):
    time.sleep(0.01)
print('ready', flush=True)
while True:
    signal.sigwait([signal.SIGUSR1])
    for _ in range({FLOOD}):
        flood.publish(Empty())
    rare.publish(String(data=name))
    print('sent', flush=True)
"""


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    for name in (RANGE, *PROFILES, *OTHERS):
        monkeypatch.setenv(name, '')


def test_nodes_stay_on_the_host_where_nothing_else_is_said():
    prepare_middleware()
    assert os.environ[RANGE] == 'LOCALHOST'


def test_who_asks_for_the_subnet_gets_it(monkeypatch):
    monkeypatch.setenv(RANGE, 'SUBNET')
    prepare_middleware()
    assert os.environ[RANGE] == 'SUBNET'


@pytest.mark.parametrize('name', OTHERS)
def test_who_names_others_is_left_alone(monkeypatch, name):
    monkeypatch.setenv(name, '1')
    prepare_middleware()
    assert not os.environ[RANGE]


@pytest.mark.parametrize(('reach', 'waits'), [('LOCALHOST', True), ('SUBNET', False)])
def test_no_send_waits_for_another_host(monkeypatch, reach, waits):
    monkeypatch.setenv(RANGE, reach)
    prepare_middleware()
    selected = Path(''.join(os.environ[x] for x in PROFILES)).read_text()
    assert ('<non_blocking_send>true</non_blocking_send>' in selected) is not waits
    # On one host ROS 2 adds its own transports to any named here.
    assert ('<userTransports>' in selected) is not waits


@pytest.mark.parametrize('name', PROFILES)
def test_who_has_profiles_of_his_own_keeps_them(monkeypatch, name):
    monkeypatch.setenv(name, '/somewhere/else.xml')
    prepare_middleware()
    assert ''.join(os.environ[x] for x in PROFILES) == os.environ[name] == '/somewhere/else.xml'


@pytest.mark.ros
def test_a_node_starts_without_the_parsers_that_generate_messages(start):
    node = start.python('-c', """
from hmsa_ros.middleware import prepare_middleware
prepare_middleware()
import sys
import rclpy
from std_msgs.msg import Empty
rclpy.init()
rclpy.create_node('node').create_subscription(Empty, 'topic', lambda message: None, 1)
print('lark' in sys.modules)
""")
    # Above it, the middleware may print that another process of the host takes a port just now.
    assert (node.wait(), node.stdout.splitlines()[-1:]) == (0, ['False'])


@pytest.mark.parametrize(('distro', 'place'), [('jazzy', 0), ('kilted', 1), ('rolling', 1)])
def test_profiles_are_those_of_the_middleware_of_the_distribution(monkeypatch, distro, place):
    monkeypatch.setenv('ROS_DISTRO', distro)
    prepare_middleware()
    assert [bool(os.environ[x]) for x in PROFILES] == [place == 0, place == 1]


@pytest.mark.parametrize('local', [True, False])
def test_profiles_of_both_versions_differ_in_a_name_only(local):
    old, new = (profiles(x, local=local).read_text().split('<dds>')[1] for x in (2, 3))
    assert old.replace('heartbeatPeriod', 'heartbeat_period') == new != old


@pytest.mark.slow
@pytest.mark.ros
def test_what_a_busy_reader_misses_comes_again_sooner_than_by_default(start, wait_until):
    reader = start.python('-c', READER)
    reader.wait_for_output('reads')
    writers = [
        start.python('-c', WRITER, name, **dict.fromkeys(PROFILES, ''))
        for name in ('default', 'ours')]
    for writer in writers:
        writer.wait_for_output('ready')

    def lost_and_early(number):
        reader.popen.send_signal(signal.SIGSTOP)
        for writer in writers:
            writer.popen.send_signal(signal.SIGUSR1)
            wait_until(lambda x=writer: x.stdout.count('sent') == number, 'the messages')
        reader.popen.send_signal(signal.SIGCONT)
        begin = monotonic()
        wait_until(lambda: reader.stdout.count('default') == number, 'the message by default')
        lost = monotonic() - begin > 1.0
        early = reader.stdout.count('ours') == number
        wait_until(lambda: reader.stdout.count('ours') == number, 'our message')
        return lost, early

    # A full queue loses what came last only now and then. By default it comes again after 3 s:
    # what comes sooner than 1 s was not lost.
    rounds = (lost_and_early(number) for number in range(1, 21))
    assert next((x for x in rounds if x[0]), 'nothing lost in 20 rounds') == (True, True)
    for process in (reader, *writers):
        process.stop(signal.SIGKILL)
