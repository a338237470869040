"""Managed nodes: their states, from inside and through the services of ROS 2."""

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
import pytest
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64

from hmsa.errors import BadInputError
from hmsa.interfaces.parameters import ParameterSpec
from hmsa_ros.nodes.capture import RawSubscription
from hmsa_ros.nodes.managed import ManagedNode
from hmsa_ros.nodes.parameters import declare
from hmsa_ros.nodes.temporary_node import ServiceCall

pytestmark = pytest.mark.ros


class Example(ManagedNode):
    """Records its calls; refuses while it is configured to."""

    def __init__(self, refuse=()):
        super().__init__('example')
        declare(self, [ParameterSpec('gain', 1.0, 'Gain.')])
        self.refuse = set(refuse)
        self.done = []
        self.autostart()

    def _do(self, name):
        self.done.append(name)
        if name in self.refuse:
            raise BadInputError(f'{name} is not wanted: expected another transition')

    def configure(self):
        self.out = self.create_publisher(Float64, 'out', 10)
        self.create_timer(3600.0, lambda: None)
        self._do('configure')

    def activate(self):
        self._do('activate')

    def deactivate(self):
        self._do('deactivate')

    def cleanup(self):
        self._do('cleanup')


def change(ros, transition=0, label=''):
    request = ChangeState.Request()
    request.transition = Transition(id=transition, label=label)
    return ros.call(ChangeState, 'example/change_state', request).success


def state(ros):
    return ros.call(GetState, 'example/get_state').current_state.id


def test_a_node_starts_by_itself_and_goes_through_all_states(ros, serve, capfd):
    served = serve(Example)
    node = served.nodes[0]
    assert node.done == ['configure', 'activate']
    assert node.active
    assert state(ros) == State.PRIMARY_STATE_ACTIVE
    assert change(ros, Transition.TRANSITION_DEACTIVATE)
    assert state(ros) == State.PRIMARY_STATE_INACTIVE
    assert not node.active
    assert change(ros, Transition.TRANSITION_CLEANUP)
    assert state(ros) == State.PRIMARY_STATE_UNCONFIGURED
    assert not [x for x in node.publishers if x.topic_name.endswith('/out')]
    assert not list(node.timers)
    assert change(ros, label='configure')
    assert [x for x in node.publishers if x.topic_name.endswith('/out')]
    assert change(ros, label='activate')
    assert node.active
    assert node.done == [
        'configure', 'activate', 'deactivate', 'cleanup', 'configure', 'activate']
    node.refuse.add('deactivate')
    assert not change(ros, Transition.TRANSITION_DEACTIVATE)
    assert 'cannot deactivate: deactivate is not wanted' in capfd.readouterr().err


class Asked(Example):
    """Is called in every way during clean-up."""

    def configure(self):
        super().configure()
        self.calls = []
        self.create_timer(0.001, lambda: self.calls.append('timer'))
        self.create_subscription(Float64, 'in', lambda _: self.calls.append('subscription'), 10)
        self.create_service(GetState, 'ask', lambda *_: self.calls.append('service'))

    def cleanup(self):
        super().cleanup()
        witness = RawSubscription(self, Float64, 'in', QoSProfile(depth=10))
        self.disturb(witness)
        self.calls.clear()


def test_what_comes_for_a_node_while_it_is_cleaned_up_is_dropped(ros, serve, wait_until):
    node = serve(Asked).nodes[0]
    publisher = ros.publisher(Float64, 'in')
    client = ros.node.create_client(GetState, 'ask')
    ros.spin_until(client.service_is_ready, 'the service')

    def disturb(witness):
        wait_until(lambda: publisher.get_subscription_count() == 2)
        client.call_async(GetState.Request())
        publisher.publish(Float64())
        wait_until(witness.take)
        witness.destroy()

    node.disturb = disturb
    assert change(ros, Transition.TRANSITION_DEACTIVATE)
    assert change(ros, Transition.TRANSITION_CLEANUP)
    assert state(ros) == State.PRIMARY_STATE_UNCONFIGURED
    assert node.calls == []


def test_shutdown_ends_the_node(ros, serve):
    node = serve(Example).nodes[0]
    assert change(ros, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert node.finished
    assert node.done[-2:] == ['deactivate', 'cleanup']
    assert state(ros) == State.PRIMARY_STATE_FINALIZED


@pytest.mark.parametrize('transition', [Transition.TRANSITION_CONFIGURE, 77])
def test_a_transition_that_does_not_begin_here_is_refused(ros, serve, transition):
    node = serve(Example).nodes[0]
    assert not change(ros, transition)
    assert state(ros) == State.PRIMARY_STATE_ACTIVE
    assert node.active


def test_a_refused_transition_can_be_tried_again(ros, serve):
    node = serve(
        lambda: Example(['configure']), '-p', 'autostart:=false').nodes[0]
    assert state(ros) == State.PRIMARY_STATE_UNCONFIGURED
    assert node.done == []
    assert not change(ros, Transition.TRANSITION_CONFIGURE)
    assert state(ros) == State.PRIMARY_STATE_UNCONFIGURED
    assert not list(node.timers)
    node.refuse.clear()
    assert change(ros, Transition.TRANSITION_CONFIGURE)
    node.refuse.add('activate')
    assert not change(ros, Transition.TRANSITION_ACTIVATE)
    assert state(ros) == State.PRIMARY_STATE_INACTIVE
    assert not node.active


def test_a_lost_answer_is_asked_for_again_by_a_client_of_its_own(ros, serve):
    service = serve(Example).nodes[0]._service_get_state
    answer = service.send_response
    asked = []

    def lose(response, header):
        asked.append(header)
        if len(asked) > 2:
            answer(response, header)

    service.send_response = lose
    call = ServiceCall(ros.node, GetState, 'example/get_state', GetState.Request(), timeout=0.05)
    assert ros.spin_until(call.answer).current_state.id == State.PRIMARY_STATE_ACTIVE
    assert len([*ros.node.clients]) == 1 < len(asked)
    # Asked anew, by the client that was answered.
    assert call.answer() is None
    assert ros.spin_until(call.answer).current_state.id == State.PRIMARY_STATE_ACTIVE
    call.close()
    assert not [*ros.node.clients]
