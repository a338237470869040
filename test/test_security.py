"""
Permissions: the policies of config/security against their schema and the nodes' real graph.

The schema is that of SROS 2's policies, version 0.2.0. The graph is read from running nodes: their
publishers, subscriptions, services and clients must be permitted, and nothing else.
"""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
import re
import time
from typing import Any
from xml.etree import ElementTree

from conftest import RosSide
import pytest
from std_msgs.msg import Float64

from hmsa.interfaces import topics
from hmsa_ros.nodes import ros_entities

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / 'config' / 'security' / 'policies.xml'
POLICY = ElementTree.parse(FILE).getroot()
VERSION = '0.2.0'
# Lists of an element of a policy: what they contain and what they may say.
LISTS = {
    'topics': ('topic', {'publish', 'subscribe'}),
    'services': ('service', {'request', 'reply'}),
    'actions': ('action', {'call', 'execute'})}
# (permission, name in full), as in ('publish', '/joint_states').
Grant = tuple[str, str]
COMMAND = '/flux_density_command'
# Where control_msgs is installed.
FOLLOW = {('execute', '/planner/follow_joint_trajectory'),
          ('publish', '/planner/controller_state')}
# Of a plant whose coil warms the block; others subscribe.
WARMS = {('publish', '/temperature')}
# So that the temperature matters.
WARM = ('-p', 'thermal.remanence:=-0.001')
RUNNING = ('planner', 'plant', 'recorder')
# Ways into a node that are no requests to move: none but operators may use them.
PARAMETERS = ('set_parameters', 'set_parameters_atomically', 'change_state')


def children(element: ElementTree.Element, tag: str) -> list[ElementTree.Element]:
    """Return the children, of which there must be at least one, all with a tag."""
    found = list(element)
    assert found, f'{element.tag} is empty'
    assert {x.tag for x in found} == {tag}
    return found


def full_name(name: str, namespace: str, node: str) -> str:
    """Return a name as SROS 2 completes it."""
    root = namespace if namespace.endswith('/') else f'{namespace}/'
    if name.startswith('/'):
        return name
    return f'{root}{node}{name[1:]}' if name.startswith('~') else f'{root}{name}'


def grants(policy: ElementTree.Element) -> dict[str, set[Grant]]:
    """Return the permissions of each enclave, and check the schema."""
    assert policy.tag == 'policy'
    assert policy.attrib == {'version': VERSION}
    (enclaves,) = children(policy, 'enclaves')
    found: dict[str, set[Grant]] = {}
    for enclave in children(enclaves, 'enclave'):
        assert set(enclave.attrib) == {'path'}
        assert enclave.attrib['path'].startswith('/')
        assert enclave.attrib['path'] not in found
        granted = found.setdefault(enclave.attrib['path'], set())
        for profiles in children(enclave, 'profiles'):
            for profile in children(profiles, 'profile'):
                assert set(profile.attrib) == {'ns', 'node'}
                for entry in profile:
                    granted |= set(_granted(entry, profile.attrib['ns'], profile.attrib['node']))
    return found


def _granted(entry: ElementTree.Element, namespace: str, node: str) -> Iterator[Grant]:
    item, permissions = LISTS[entry.tag]
    assert entry.attrib
    assert set(entry.attrib) <= permissions
    assert set(entry.attrib.values()) <= {'ALLOW', 'DENY'}
    for permission, answer in entry.attrib.items():
        # Everything that is not granted is denied.
        assert answer == 'ALLOW'
        for element in children(entry, item):
            assert element.text
            assert element.text == element.text.strip()
            yield permission, full_name(element.text, namespace, node)


GRANTS = grants(POLICY)


def used(side: RosSide, node: str) -> set[Grant]:
    """Return the entities used by a running node."""
    found: set[Grant] = set()
    for permission, look in (
            ('publish', side.node.get_publisher_names_and_types_by_node),
            ('subscribe', side.node.get_subscriber_names_and_types_by_node),
            ('reply', side.node.get_service_names_and_types_by_node),
            ('request', side.node.get_client_names_and_types_by_node)):
        found |= {(permission, name) for name, _ in look(node, '/')}
    return found


def watch(
        side: RosSide, nodes: Iterable[str], seen: dict[str, set[Grant]],
        complete: Callable[[], Any], what: str) -> None:
    """Collect the entities used by nodes until a condition is true."""
    def gathered() -> bool:
        running = {name for name, namespace in side.node.get_node_names_and_namespaces()}
        for node in nodes:
            if node in running:
                seen.setdefault(node, set()).update(used(side, node))
        return bool(complete())

    try:
        side.spin_until(gathered, what)
    finally:
        # Shown if it fails.
        for node in nodes:
            granted = enclave_of('replay' if node == 'player' else node)
            print(node, 'granted, not used:', sorted(granted - seen.get(node, set())))
            print(node, 'used, not granted:', sorted(seen.get(node, set()) - granted))


def enclave_of(node: str) -> set[Grant]:
    """Return the permissions of a node of this package."""
    return GRANTS[f'/hmsa/{node}'] - FOLLOW - (WARMS if node == 'plant' else set())


def test_policies_follow_the_schema_and_name_an_enclave_for_every_node_and_person():
    assert set(GRANTS) == {f'/hmsa/{x}' for x in (
        *topics.NODES, 'replay', 'operator', 'viewer')}


def test_names_are_written_out_but_for_users_whose_own_names_end_in_a_number():
    for path, granted in GRANTS.items():
        for permission, name in granted:
            if set(name) & set('*?[]'):
                assert path in ('/hmsa/operator', '/hmsa/viewer')
                assert permission == 'reply'
                assert re.fullmatch(r'/(client|watch)_\*/[a-z_]+', name)


def test_schema_refuses_what_it_should():
    for text, what in (
            ('<policy version="0.1.0"><enclaves/></policy>', '0.1.0'),
            (f'<policy version="{VERSION}"><contexts/></policy>', 'contexts'),
            (f'<policy version="{VERSION}"><enclaves/></policy>', 'empty')):
        with pytest.raises(AssertionError, match=what):
            grants(ElementTree.fromstring(text))


def test_only_the_planner_and_a_replay_may_send_commands():
    assert {path for path, granted in GRANTS.items() if ('publish', COMMAND) in granted} == {
        '/hmsa/planner', '/hmsa/replay'}


def test_only_an_operator_may_send_setpoints_and_stop_the_planner():
    requests = {('publish', '/planner/joint_trajectory'), ('publish', '/planner/setpoint'),
                ('call', '/planner/follow_joint_trajectory'),
                *(('request', f'/planner/{x}') for x in (
                    'reset_estimate', 'save_estimate', 'stop'))}
    for path, granted in GRANTS.items():
        assert granted & requests == (requests if path == '/hmsa/operator' else set())


def test_nobody_but_an_operator_may_change_parameters_or_states():
    for path, granted in GRANTS.items():
        changes = {(permission, name) for permission, name in granted
                   if permission == 'request' and name.rpartition('/')[2] in PARAMETERS}
        assert bool(changes) == (path == '/hmsa/operator')


def test_a_viewer_may_only_listen():
    assert {permission for permission, _ in GRANTS['/hmsa/viewer']} <= {
        'subscribe', 'publish', 'reply'}
    # What every node of ROS has of its own.
    assert {name for permission, name in GRANTS['/hmsa/viewer']
            if permission == 'publish'} == {'/rosout', '/parameter_events'}
    assert all(name.startswith(('/viewer/', '/watch_*/'))
               for permission, name in GRANTS['/hmsa/viewer'] if permission == 'reply')


def test_only_plant_player_and_replay_may_be_the_authority_on_time():
    assert {path for path, granted in GRANTS.items() if ('publish', '/clock') in granted} == {
        '/hmsa/plant', '/hmsa/player', '/hmsa/replay'}


def test_a_player_may_send_commands_and_forces_in_a_replay_alone():
    assert GRANTS['/hmsa/replay'] - GRANTS['/hmsa/player'] == {
        ('publish', COMMAND), ('publish', '/disturbance_force'), ('subscribe', '/joint_states')}
    assert GRANTS['/hmsa/player'] < GRANTS['/hmsa/replay']


@pytest.mark.slow
@pytest.mark.ros
def test_policies_grant_exactly_what_the_nodes_do(tmp_path, start, ros):
    seen: dict[str, set[Grant]] = {}
    bag = tmp_path / 'bag'
    simulated = ('-p', 'use_sim_time:=true')

    def nothing_left(*names: str, without: Iterable[Grant] = ()) -> Callable[[], bool]:
        return lambda: all(
            enclave_of(name) - set(without) <= seen.get(name, set()) for name in names)

    # A run under simulated time, led by a plant that stands still at first, so that the planner
    # waits for a sample of it.
    recorder = start.hmsa('recorder', '--ros-args', '-p', f'storage.uri:={bag}', *simulated)
    plant = start.hmsa(
        'plant', '--ros-args', '-p', 'publish_clock:=true', '-p', 'start_paused:=true', *WARM)
    planner = start.hmsa(
        'planner', '--ros-args', *simulated, '-p', 'takeover_timeout:=60.0', *WARM)
    # There to be recorded, without a coil.
    driver = start.hmsa('driver', '--ros-args', '-p', 'autostart:=false')
    outside = [ros_entities.publisher(ros.node, x) for x in (
        topics.DISTURBANCE_FORCE, topics.TEMPERATURE)]
    for topic in (topics.JOINT_TRAJECTORY, topics.SETPOINT):
        ros.publisher(topic.type, f'/planner/{topic.name[2:]}', topic.qos, subscribers=2)
    requests = ros.publisher(topics.SETPOINT, '/planner/setpoint', subscribers=2)
    sent = [0.0]

    def looks_for_the_state() -> bool:
        if time.monotonic() > sent[0] + 1.0:
            # Said again, in case simulated time had not reached the planner yet.
            sent[0] = time.monotonic()
            requests.publish(Float64(data=1.1))
        return ('subscribe', '/joint_states') in seen.get('planner', set())

    watch(ros, RUNNING, seen, looks_for_the_state, 'the planner to look for the state in force')
    ros.call(topics.SET_PAUSED.type, '/plant/set_paused')
    # The plant follows a clock, and there is a player to be recorded, below.
    later = {('subscribe', '/clock'), ('subscribe', '/player/transition_event')}
    watch(ros, RUNNING, seen, nothing_left('planner', 'plant', without=later),
          'all that planner and plant may do')
    # Clients of a single request may be gone before anybody sees them: its answer is in the bag.
    asked = {('request', f'/{node}/{service}') for node in ('planner', 'plant')
             for service in ('get_parameters', 'get_parameter_types')}
    later = asked | {('subscribe', '/player/transition_event')}
    watch(ros, RUNNING, seen, nothing_left('recorder', without=later),
          'all that the recorder may do')
    ros.spin_until(
        lambda: {'planner.lead_time', 'plant.mismatch.density'} <= set(
            re.findall(r'[\w.]+', (bag / 'metadata.yaml').read_text())),
        'the parameters in the bag')
    seen['recorder'] |= asked
    for process in (planner, plant, recorder, driver):
        assert process.stop() == 0, process.output
    for publisher in outside:
        ros.node.destroy_publisher(publisher)

    # A replay: the player leads, the plant follows.
    again = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "again"}', *simulated)
    plant = start.hmsa('plant', '--ros-args', *simulated, *WARM)
    player = start.hmsa(
        'player', '--ros-args', '-p', f'storage.uri:={bag}', '-p', 'play.rate:=0.001',
        '-p', 'play.clock_publish_frequency:=100.0',
        '-p', f'play.topics_to_filter:=[{COMMAND}]', '-p', 'play.regex_to_filter:=.*',
        '-p', f'play.wait_for_samples:=[{topics.JOINT_STATES.name}]')
    watch(ros, ('player', 'plant', 'recorder'), seen,
          lambda: nothing_left('plant', 'recorder')()
          and enclave_of('replay') <= seen.get('player', set()),
          'all that player, plant and recorder may do')
    for process in (player, plant, again):
        assert process.stop() == 0, process.output

    for name in RUNNING:
        assert seen[name] == enclave_of(name)
    assert seen['player'] == enclave_of('replay')


@pytest.mark.ros
def test_policies_grant_exactly_what_a_driver_does(start, ros):
    seen: dict[str, set[Grant]] = {}
    start.hmsa('driver', '--ros-args', '-p', 'hardware:=hardware:Bench',
               PYTHONPATH=str(ROOT / 'docs' / 'tutorials'))
    watch(ros, ['driver'], seen, lambda: seen.get('driver', set()) >= enclave_of('driver'),
          'all that a driver may do')
    assert seen['driver'] == enclave_of('driver')


@pytest.mark.ros
def test_policies_grant_exactly_what_a_sensor_does_beside_its_topic(start, ros):
    seen: dict[str, set[Grant]] = {}
    start.hmsa('sense', '--ros-args', '-p', 'topic:=pose', '-p',
               'type:=geometry_msgs/msg/PoseStamped')
    granted = GRANTS['/hmsa/sense'] | {('subscribe', '/pose')}
    watch(ros, ['sense'], seen, lambda: seen.get('sense', set()) >= granted, 'all it may do')
    assert seen['sense'] == granted


@pytest.mark.ros
@pytest.mark.parametrize(('command', 'name', 'enclave'), [
    (('send', '1.1:1', '--timeout', '60'), 'client', 'operator'), (('watch',), 'watch', 'viewer'),
    *(pytest.param(('panel',), x, 'operator', marks=pytest.mark.slow)
      for x in ('client', 'watch'))])
def test_commands_do_nothing_that_their_enclave_may_not(start, ros, command, name, enclave):
    process = start.hmsa(*command)
    found: set[Grant] = set()

    def gathered() -> bool:
        for node in ros.node.get_node_names():
            if node.startswith(f'{name}_'):
                found.update((permission, topic.replace(node, f'{name}_*'))
                             for permission, topic in used(ros, node))
        return ('subscribe', '/planner/status') in found and (
            name == 'watch' or ('publish', '/planner/joint_trajectory') in found)

    ros.spin_until(gathered, f'what {command[0]} does')
    assert found <= GRANTS[f'/hmsa/{enclave}']
    process.stop()
