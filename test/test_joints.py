"""Joints of one node: names, common and separate parameters, topics."""

import re

import pytest
from rclpy.parameter import Parameter

from hmsa.errors import BadInputError
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import ACTUATOR, INITIAL_STRETCH, JOINT, ParameterSpec
from hmsa_ros.nodes.parameters import checked, declare_joints, joint_names, JOINTS

OWN = (*ACTUATOR, INITIAL_STRETCH)
SPECS = (*OWN, JOINT, JOINTS, ParameterSpec('other', 1, 'Not for one joint.', '', 0, 9))


def declared(make_ros, *arguments):
    given = [x for y in arguments for x in ('-p', y)]
    side = make_ros(cli_args=['--ros-args', *given] if given else [])
    return side.node, declare_joints(side.node, SPECS, OWN)


@pytest.mark.parametrize(('joints', 'expected'), [
    ([], ('knee',)), (['left'], ('left',)), (['b', 'a', 'c_3'], ('b', 'a', 'c_3'))])
def test_joints_come_in_the_order_given_or_are_the_one(joints, expected):
    assert joint_names({'joint': 'knee', 'joints': joints}) == expected


@pytest.mark.parametrize(('joints', 'text'), [
    (['a', 'b', 'a'], "names 'a' 2 times: expected each joint once"),
    (['a', ''], "names '': expected letters"), (['3a'], "'3a'"), (['a/b'], "'a/b'"),
    (['a.b'], "'a.b'"), (['a__b'], "'a__b'"), (['~'], "'~'"), (['ä'], "'ä'"), (['a\n'], r"'a\n'")])
def test_name_that_is_no_token_or_there_twice_is_refused(joints, text):
    with pytest.raises(BadInputError, match=re.escape(text)):
        joint_names({'joint': 'knee', 'joints': joints})


@pytest.mark.ros
def test_joint_has_its_own_value_or_that_of_all(make_ros):
    node, values = declared(
        make_ros, 'joints:=[left, right]', 'left.actuator.remanence:=0.2',
        'initial_stretch:=1.1')
    left, right = values.of('left'), values.of('right')
    assert list(left) == list(right) == [x.name for x in SPECS]
    assert (left['actuator.remanence'], right['actuator.remanence']) == (0.2, 0.1)
    assert left['initial_stretch'] == right['initial_stretch'] == values['initial_stretch'] == 1.1
    changed = values.changed(checked(node, [
        Parameter('actuator.remanence', value=0.3), Parameter('right.initial_stretch', value=0.9),
        Parameter('use_sim_time', value=True)]))
    assert (changed.of('left')['actuator.remanence'], changed.of('left')['initial_stretch']) == (
        0.2, 1.1)
    assert (changed.of('right')['actuator.remanence'], changed.of('right')['initial_stretch']) == (
        0.3, 0.9)
    assert values.of('right') == right
    with pytest.raises(BadInputError, match='parameter left.actuator.remanence is -1'):
        checked(node, [Parameter('left.actuator.remanence', value=-1.0)])


@pytest.mark.ros
def test_one_joint_by_name_alone_declares_nothing_more(make_ros):
    node, values = declared(make_ros, 'joint:=knee')
    assert values.names == ('knee',)
    assert list(values.of('knee')) == list(values.values) == [x.name for x in SPECS]


@pytest.mark.ros
@pytest.mark.parametrize(('given', 'text'), [
    ('left.actuator.remanence:=-1.0', 'left.actuator.remanence is -1.0: expected float, 1e-09 to'),
    ('left.actuator.remanence:=.nan', 'left.actuator.remanence is nan: expected'),
    ('left.initial_stretch:=long', "left.initial_stretch is 'long': expected float")])
def test_bad_value_of_a_joint_is_refused(make_ros, given, text):
    with pytest.raises(BadInputError, match=re.escape(text)):
        declared(make_ros, 'joints:=[left, right]', given)


def test_topic_of_a_joint_has_its_name_where_there_are_several():
    several = ('left', 'right')
    assert topics.of_joint(topics.SETPOINT, 'left', ('left',)) is topics.SETPOINT
    assert topics.of_joint(topics.SETPOINT, 'left', several).name == '~/left/setpoint'
    assert topics.of_joint(
        topics.FLUX_DENSITY_COMMAND, 'left', several).name == 'left/flux_density_command'
