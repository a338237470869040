"""Parameters of other nodes, requested until they arrive."""

from typing import Any

import pytest
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters, GetParameterTypes, ListParameters
from rclpy.parameter import Parameter

from hmsa.bag.metadata import parameter_key
from hmsa.errors import BadInputError
from hmsa_ros.clients.remote import RemoteNode
from hmsa_ros.nodes.temporary_node import RemoteParameters

pytestmark = pytest.mark.ros


def answer_list(_: Any, response: Any) -> Any:
    response.result.names = ['lead_time']
    return response


def answer_types(_: Any, response: Any) -> Any:
    response.types = [3]
    return response


def answer_get(request: Any, response: Any) -> Any:
    assert list(request.names) == ['lead_time']
    response.values = [ParameterValue(type=3, double_value=0.05)]
    return response


def test_what_nobody_answers_is_asked_again(ros, make_ros):
    # Its executor never runs.
    deaf = make_ros().node
    deaf.create_service(ListParameters, '/planner/list_parameters', answer_list)
    deaf.create_service(GetParameters, '/planner/get_parameters', answer_get)
    asking = RemoteParameters(ros.node, '/planner')
    found: list[dict[str, str]] = []

    def asked() -> bool:
        asking.poll(found.append)
        return asking._call is not None

    ros.spin_until(asked, 'the question')
    ros.node.create_service(ListParameters, '/planner/list_parameters', answer_list)
    ros.node.create_service(GetParameterTypes, '/planner/get_parameter_types', answer_types)
    ros.node.create_service(GetParameters, '/planner/get_parameters', answer_get)
    ros.spin_until(lambda: asking.poll(found.append) or found, 'the answer')
    assert found == [{parameter_key('/planner', 'lead_time'): '0.05'}]


def test_a_parameter_without_a_value_hides_no_other(make_ros):
    ros = make_ros(start_parameter_services=True)
    ros.node.declare_parameter('density', 1900.0)
    # As a joint has that is one of several.
    ros.node.declare_parameter('left.density', Parameter.Type.DOUBLE)
    name = ros.node.get_fully_qualified_name()
    asking = RemoteParameters(ros.node, name)
    found: list[dict[str, str]] = []
    ros.spin_until(lambda: asking.poll(found.append) or found, 'the answer')
    assert found[0][parameter_key(name, 'density')] == '1900.0'
    assert parameter_key(name, 'left.density') not in found[0]


@pytest.mark.parametrize('name', ['law.name', '', 'a b', '/'])
def test_what_cannot_be_a_node_is_refused(name):
    with pytest.raises(BadInputError, match='expected the name of a node before that of a param'):
        RemoteNode(name)
