"""A host that has another address since its nodes started."""

from diagnostic_msgs.msg import DiagnosticArray
import pytest

from hmsa.interfaces import topics
from hmsa_ros import middleware
from hmsa_ros.middleware import addresses, AddressWatch
from hmsa_ros.nodes.planner import PlannerNode

HOME, CAFE, BRIDGE = '192.168.1.7', '10.0.0.9', '172.17.0.1'


@pytest.fixture
def moves(monkeypatch):
    """Return a function that changes the addresses of this host."""
    def move(*now):
        monkeypatch.setattr(middleware, 'addresses', lambda: frozenset(now))
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    return move


@pytest.mark.parametrize(('before', 'now', 'said'), [
    ((HOME,), (CAFE,), f'was {HOME} when this node started, and is {CAFE} now'),
    ((HOME, BRIDGE), (CAFE, BRIDGE), f'was {HOME} when this node started, and is {CAFE} now'),
    ((), (CAFE,), f'was none when this node started, and is {CAFE} now'),
    ((HOME,), (HOME,), ''), ((HOME,), (), ''), ((HOME,), (HOME, CAFE), ''), ((), (), '')])
def test_a_host_with_another_address_says_what_to_restart(moves, before, now, said):
    moves(*before)
    watch = AddressWatch()
    assert watch.words == ''
    moves(*now)
    assert said in watch.words
    assert bool(watch.words) is bool(said)
    assert ('restart the nodes on this host' in watch.words) is bool(said)


def test_nodes_that_no_other_host_finds_do_not_mind(moves, monkeypatch):
    moves(HOME)
    watch = AddressWatch()
    moves(CAFE)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    assert watch.words == ''


def test_the_addresses_of_this_host_are_those_of_others():
    assert not any(x.startswith('127.') for x in addresses())


@pytest.mark.ros
def test_another_address_is_in_the_diagnostics_of_a_node(ros, serve, moves):
    moves(HOME)
    serve(PlannerNode)
    found = ros.collect(DiagnosticArray, '/diagnostics', topics.DIAGNOSTICS.qos)

    def hosts():
        return [x for array in found for x in array.status if x.name == 'planner: host']

    ros.spin_until(lambda: found, 'diagnostics')
    assert not hosts()
    moves(CAFE)
    ros.spin_until(hosts, 'the address')
    assert f'is {CAFE} now' in hosts()[0].message
