"""The example for ros2_control over topics: its files, its bridge, and its accuracy."""

import importlib.util
from pathlib import Path
import runpy
from xml.etree import ElementTree

import numpy as np
import pytest
from sensor_msgs.msg import JointState
import yaml

from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Settings, StretchRequest

FOLDER = Path(__file__).resolve().parent.parent / 'examples' / 'ros2_control'
MS = 1_000_000
START = 1000 * MS
LAUNCH = getattr(importlib.util.find_spec('launch'), 'origin', None) is not None


def test_description_and_controllers_name_the_same_joint_and_its_interfaces():
    robot = ElementTree.parse(FOLDER / 'actuator.urdf').getroot()
    system = robot.find('ros2_control')
    assert system.findtext('hardware/plugin') == (
        'joint_state_topic_hardware_interface/JointStateTopicSystem')
    # All that the plugin reads; it ignores any other without a word.
    assert {x.get('name') for x in system.findall('hardware/param')} == {
        'joint_commands_topic', 'joint_states_topic'}
    joint, = system.findall('joint')
    assert joint.get('name') == robot.find('joint').get('name') == 'actuator'
    interfaces = [{x.get('name') for x in joint.findall(f'{kind}_interface')} for kind in (
        'command', 'state')]
    given = yaml.safe_load((FOLDER / 'controllers.yaml').read_text())
    controller = given['joint_trajectory_controller']['ros__parameters']
    assert controller['joints'] == ['actuator']
    assert set(controller['command_interfaces']) <= interfaces[0]
    assert set(controller['state_interfaces']) <= interfaces[1]


@pytest.mark.ros
def test_a_command_of_ros2_control_moves_the_actuator(serve, ros):
    from hmsa_ros.nodes.planner import PlannerNode
    from hmsa_ros.nodes.plant import PlantNode

    bridge = runpy.run_path(str(FOLDER / 'bridge.py'))['Bridge']
    serve(bridge, PlannerNode, PlantNode, '-p', 'lead_time:=0.5')
    setpoints = ros.collect('std_msgs/msg/Float64', '/planner/setpoint', 10)
    samples = ros.collect(JointState, '/joint_states', 10)
    commands = ros.publisher(JointState, '/joint_commands', 10)
    for name, positions in (
            ('stranger', [1.3]), ('actuator', []), ('actuator', [float('nan')]),
            ('actuator', [1.1]), ('actuator', [1.1]), ('actuator', [1.15])):
        commands.publish(JointState(name=[name], position=positions))
    ros.spin_until(
        lambda: samples and abs(samples[-1].position[0] - 1.15) < 1e-6, 'the arrival')
    assert [x.data for x in setpoints] == [1.1, 1.15]


def test_a_stream_of_positions_is_followed_late_and_ends_at_rest():
    # What docs/guides/ros2-control.md says, with a path of 1 s that is sampled at 100 Hz.
    for lead, late in ((5, 13), (50, 58)):
        block = paper_actuator()
        device = SimulatedDevice([SimulatedJoint(Setup(block, 1.0))], period=MS, time=START)
        loop = Loop(
            PlannerGroup({'actuator': Planner(block, Options(
                flux_density_min=-0.5, flux_density_max=0.5, lead_time=lead * MS))}),
            Settings(takeover_timeout=0), device)
        s = np.clip(np.arange(1400) / 1000.0, 0.0, 1.0)
        path = 1.0 + 0.3 * s ** 3 * (10.0 - 15.0 * s + 6.0 * s * s)
        found = []
        for ms, stretch in enumerate(path):
            if ms <= 1000 and ms % 10 == 0:
                loop.runtime.request(StretchRequest('actuator', stretch))
            found.append(device.stretch[0])
            loop.run(START + (ms + 1) * MS)
        found = np.array(found)
        assert np.max(np.abs(found[late:] - path[:-late])) < 0.002
        assert np.ptp(found[-200:]) < 1e-9


@pytest.mark.skipif(not LAUNCH, reason='launch is not installed')
def test_the_launch_file_is_one():
    description = runpy.run_path(str(FOLDER / 'ros2_control.launch.py'))
    assert len(description['generate_launch_description']().entities) == 8
