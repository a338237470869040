"""A plant of several joints: topics, parameters and motion of each."""

import math

import pytest
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from std_srvs.srv import SetBool

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa_ros.nodes.conversions import from_time, to_command
from hmsa_ros.nodes.plant import PlantNode

pytestmark = pytest.mark.ros

MS = 1_000_000
START = 1000 * MS
LEADING = ('-p', 'publish_clock:=true', '-p', 'start_paused:=true')


def test_each_joint_has_topics_parameters_and_a_motion_of_its_own(ros, serve):
    serve(PlantNode, *LEADING, '-p', 'joints:=[left, right, middle]', '-p',
          'left.initial_stretch:=1.1', '-p', 'right.slew_limit:=20.0')
    samples = ros.collect(topics.JOINT_STATES, qos=QoSProfile(depth=100_000))
    told = {x: ros.collect(topics.FLUX_DENSITY_APPLIED, f'{x}/flux_density_applied')
            for x in ('left', 'right', 'middle')}
    plants = {
        'left': ActuatorSimulation(paper_actuator(), time=START, stretch=1.1),
        'right': ActuatorSimulation(paper_actuator(), time=START, slew_limit=20.0),
        'middle': ActuatorSimulation(paper_actuator(), time=START, slew_limit=math.inf)}
    for k, joint in enumerate(('left', 'right')):
        topic = topics.FLUX_DENSITY_COMMAND
        publisher = ros.publisher(topic.type, f'{joint}/{topic.name}', topic.qos)
        stamp, level = START + (5 + k) * MS + 123_456, 0.04 + 0.01 * k
        publisher.publish(to_command(stamp, level, ''))
        assert publisher.wait_for_all_acked(Duration(seconds=60))
        plants[joint].command(stamp, level)
    ros.spin_until(lambda: all(told.values()), 'the levels at the start')
    ros.spin_until(lambda: ros.node.count_publishers('joint_states'), 'the samples')
    assert ros.call(SetBool, 'plant/set_paused', SetBool.Request(data=False)).success
    ros.spin_until(lambda: len(samples) > 40, 'samples')
    for sample in samples:
        assert list(sample.name) == ['left', 'right', 'middle']
        for i, name in enumerate(sample.name):
            plants[name].advance(from_time(sample.header.stamp))
            assert (sample.position[i], sample.velocity[i], sample.effort[i]) == (
                plants[name].stretch, plants[name].rate, plants[name].flux_density)
    assert {name: [x.magnetic_field.z for x in found][1:] for name, found in told.items()} == {
        'left': [0.04], 'right': [0.05], 'middle': []}
    names = {x for x, _ in ros.node.get_topic_names_and_types()}
    assert '/right/disturbance_force' in names
    # A topic of numbers for each of many would cost more than it tells.
    assert not [x for x in names if x.endswith('/stretch')]


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (('-p', 'joints:=[a, a]'), "names 'a' 2 times"),
    (('-p', 'joints:=[a, b]', '-p', 'b.initial_stretch:=9.0'), 'joint b: initial stretch is 9'),
    (('-p', 'joints:=[a, b]', '-p', 'b.reset_stretch:=9.0'), 'joint b: reset_stretch is 9'),
    (('-p', 'joints:=[a, b]', '-p', 'b.viscoelastic.ratio:=[0.1]'),
     'joint b: viscoelastic.ratio has 1 values and viscoelastic.time 0')])
def test_a_joint_that_cannot_be_is_refused(serve, arguments, sentence):
    with pytest.raises(BadInputError, match=sentence):
        serve(PlantNode, *arguments)
