"""
Managed nodes: configured, activated, deactivated and cleaned up, by themselves or from outside.

All share the life cycle of their process: start, spin, end cleanly on SIGINT and SIGTERM.

The states and services are those of ROS 2 (``ros2 lifecycle``, launch). With the parameter
``autostart``, true by default, a node configures and activates itself at startup.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
import gc
import inspect
import os
import re
import sys
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
import rclpy
from rclpy.clock import Clock as RclpyClock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logger_level, LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.task import Future
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from hmsa.ending import ENDING
from hmsa.errors import BadInputError, complain, HmsaError
from hmsa.interfaces import topics
from hmsa.interfaces.parameters import ParameterSpec
from hmsa_ros.middleware import AddressWatch
from hmsa_ros.nodes import ros_entities
from hmsa_ros.nodes.capture import FastPublisher
from hmsa_ros.nodes.conversions import to_diagnostics, to_status
from hmsa_ros.nodes.parameters import (
    check_former_names,
    check_names,
    checked,
    declare,
    unknown,
    unread_files,
)
from hmsa_ros.nodes.temporary_node import start_ros

AUTOSTART = ParameterSpec(
    'autostart', True,
    'Whether the node configures and activates itself at startup; otherwise it waits for '
    '~/change_state (ros2 lifecycle set).')
# On this rclpy (7.1), EventsExecutor.spin() without a time limit busy-loops and delivers nothing.
# Waiting in slices for a future works as documented. With events always at hand, though, a slice
# does not end in time, and a timer has its turn after all events before it.
_SLICE_SECONDS, _LOOK_SECONDS = 1.0, 0.1


class ManagedNode(LifecycleNode):
    """
    Node with the states of a managed node.

    A subclass declares its parameters in ``__init__``, implements `configure`, `activate`,
    `deactivate` and `cleanup`, and calls `autostart` last. Each of the four may raise `HmsaError`:
    the transition is refused and can be tried again. The node acts while ``active``. ``finished``
    means that it was shut down from outside and the process is to end.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, start_parameter_services=False)
        self._parameter_service = _CarefulParameterService(self)
        self._guard_clock()
        self.active = False
        self.finished = False
        self._address, self._moved = AddressWatch(), ''
        check_former_names(self._parameter_overrides)
        self._autostart: bool = declare(self, [AUTOSTART])[AUTOSTART.name]
        self._refusal: Exception | None = None
        self._kept: set[object] = set()
        # If a requested transition does not start in the present state, rclpy raises an error from
        # its callback, which would end the process.
        change = self._service_change_state.callback

        def change_state(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except rclpy_implementation.RCLError:
                self.get_logger().error(
                    f'transition {request.transition.label or request.transition.id} refused: '
                    f'there is none of that name or number from {self.state}')
                response.success = False
                return response

        self._service_change_state.callback = change_state

    def _guard_clock(self) -> None:
        """Ignore times before zero, whose error in rclpy would end the node."""
        source = self._time_source
        take = source.clock_callback

        def take_carefully(message: Clock) -> None:
            if message.clock.sec >= 0:
                take(message)
            else:
                self.get_logger().error(
                    f'time {message.clock.sec} s on /clock skipped: expected at least 0',
                    throttle_duration_sec=1.0)

        # For a subscription created later, when use_sim_time is set, and for the present one.
        source.clock_callback = take_carefully
        if source._clock_sub is not None:
            source._clock_sub.callback = take_carefully

    @property
    def state(self) -> str:
        """Name of the state: unconfigured, inactive, active or finalized."""
        label: str = self._state_machine.current_state[1]
        return label

    # -- for use by subclasses -----------------------------------------------------------------

    def every(self, seconds: float, act: Callable[[], None]) -> Timer:
        """Call a function periodically in steady time, whatever the pace of simulated time."""
        return self.create_timer(
            seconds, act, clock=RclpyClock(clock_type=ClockType.STEADY_TIME))

    def offer(self, service: topics.Service, act: Callable[..., tuple[bool, str]]) -> None:
        """Offer a service that returns success and message; ``act`` gets any request data."""
        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = (
                    act(request.data) if hasattr(request, 'data') else act())
            except HmsaError as error:
                response.success, response.message = False, str(error)
            return response

        self.create_service(ros_entities.interface_class(service.type), service.name, answer)

    def diagnose(
            self, report: Callable[[], Iterable[DiagnosticStatus]]) -> Callable[[], None]:
        """Publish statuses once a second; return a function that publishes immediately."""
        publisher = FastPublisher(ros_entities.publisher(self, topics.DIAGNOSTICS))

        def publish() -> None:
            statuses = [*report()]
            moved = self._address.words
            if moved:
                statuses.append(to_status(
                    f'{self.get_name()}: host', '', DiagnosticStatus.WARN[0], moved, {}))
            if moved and moved != self._moved:
                self.get_logger().warning(moved)
            self._moved = moved
            publisher.publish(to_diagnostics(self.now(), *statuses))

        self.every(1.0, publish)
        return publish

    def on_change(self, take: Callable[[Mapping[str, Any]], None]) -> None:
        """Call ``take`` with changed values by name; its `BadInputError` refuses them."""
        def change(parameters: Sequence[Parameter]) -> SetParametersResult:
            try:
                take(checked(self, parameters))
            except BadInputError as error:
                return SetParametersResult(successful=False, reason=str(error))
            return SetParametersResult(successful=True)

        self.add_on_set_parameters_callback(change)

    def complain(self, sentence: str, failure: bool) -> None:
        """Log a failure or a warning."""
        # On two lines, because rclpy forbids two severities on one line.
        if failure:
            self.get_logger().error(sentence)
        else:
            self.get_logger().warning(sentence)

    @property
    def simulated(self) -> bool:
        """Whether the node follows simulated time."""
        return bool(self.get_clock().ros_time_is_active)

    def now(self) -> int:
        """Return the node's time in ns."""
        return int(self.get_clock().now().nanoseconds)

    def keep(self, *entities: object) -> None:
        """Exclude entities from destruction when the node is cleaned up."""
        self._kept |= {*entities}

    # -- to be overridden by subclasses --------------------------------------------------------

    def configure(self) -> None:
        """Create the node's entities; it does not act yet."""

    def activate(self) -> None:
        """Start to act."""

    def deactivate(self) -> None:
        """Stop acting."""

    def cleanup(self) -> None:
        """Release everything except publishers, subscriptions, services, clients and timers."""

    def autostart(self) -> None:
        """
        Refuse unknown parameters; configure and activate if the parameter requests it.

        Raises
        ------
        HmsaError
            If a transition is refused, which refuses the start.

        """
        check_names(self)
        if not self._autostart:
            return
        for transition in (self.trigger_configure, self.trigger_activate):
            self._refusal = None
            transition()
            if self._refusal is not None:
                raise self._refusal
        # Errors of later transitions are not raised, so they must be logged.
        self._autostart = False

    # -- transitions ---------------------------------------------------------------------------

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Configure; destroy the entities of a refused attempt."""
        self._kept = self._entities()
        result = self._attempt('configure', self.configure)
        if result != TransitionCallbackReturn.SUCCESS:
            self._destroy()
        return result

    def on_activate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        result = self._attempt('activate', self.activate)
        self.active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate."""
        result = self._attempt('deactivate', self.deactivate)
        self.active = result != TransitionCallbackReturn.SUCCESS
        return result

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Clean up: destroy the entities created since the node was configured."""
        result = self._attempt('clean up', self.cleanup)
        if result == TransitionCallbackReturn.SUCCESS:
            self._destroy()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate and clean up as needed, then end."""
        if self.active:
            self.on_deactivate(state)
        if state.label != 'unconfigured':
            self.on_cleanup(state)
        self.finished = True
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, name: str, act: Callable[[], None]) -> TransitionCallbackReturn:
        """Execute a transition; an error refuses it."""
        try:
            act()
        except Exception as error:  # rclpy would discard it silently
            self._refusal = error
            if not isinstance(error, HmsaError) or not self._autostart:
                self.get_logger().error(f'cannot {name}: {error}')
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _entities(self) -> set[object]:
        return {*self.publishers, *self.subscriptions, *self.services, *self.clients,
                *self.timers}

    def _destroy(self) -> None:
        """Destroy the entities created since the node was configured."""
        for found, destroy in (
                (self.timers, self.destroy_timer),
                (self.subscriptions, self.destroy_subscription),
                (self.services, self.destroy_service), (self.clients, self.destroy_client),
                (self.publishers, self.destroy_publisher)):
            for entity in list(found):
                if entity not in self._kept:
                    silence(entity)
                    destroy(entity)


def silence(entity: Any) -> None:
    """
    Replace the callback of an entity that is about to be destroyed.

    The executor stores events that arrived during the present callback, and handles them later: a
    destroyed timer would fire again, and a destroyed service would raise an error on its response.
    """
    def nothing(*_: object) -> None:
        pass

    if hasattr(entity, 'callback'):
        entity.callback = nothing
    if hasattr(entity, 'send_response'):
        entity.send_response = nothing


class _CarefulParameterService(ParameterService):
    """
    The parameter services of rclpy, with invalid requests refused.

    The original services raise an error on a value of unknown type and thereby end the node: any
    participant in the domain could end it with one message. They list parameters without value,
    and do not respond if the value of one of them is requested.
    """

    def _list_parameters_callback(self, request: Any, response: Any) -> Any:
        found = super()._list_parameters_callback(request, response)
        node = self._get_node()
        found.result.names = [
            x for x in found.result.names if node.get_parameter_or(x).value is not None]
        return found

    def _get_parameters_callback(self, request: Any, response: Any) -> Any:
        node = self._get_node()
        if all(node.has_parameter(x) for x in request.names):
            response.values = [
                node.get_parameter_or(x).get_parameter_value() for x in request.names]
        return response

    def _set_parameters_callback(self, request: Any, response: Any) -> Any:
        # One at a time, so that an invalid value does not refuse the others.
        response.results = [
            self._set_parameters_atomically_callback(
                SetParametersAtomically.Request(parameters=[x]),
                SetParametersAtomically.Response()).result
            for x in request.parameters]
        return response

    def _set_parameters_atomically_callback(self, request: Any, response: Any) -> Any:
        try:
            check_former_names(x.name for x in request.parameters)
            for x in request.parameters:
                if not self._get_node().has_parameter(x.name):
                    # The error of rclpy does not name the parameter.
                    raise unknown(self._get_node(), x.name)
            return super()._set_parameters_atomically_callback(request, response)
        except Exception as error:  # rclpy raises errors of several unrelated classes here
            response.result = SetParametersResult(
                successful=False, reason=str(error) if isinstance(error, HmsaError)
                else f'{error}: expected a declared parameter of its own type')
            return response


def spin(nodes: Sequence[Node], ending: Callable[[], bool]) -> None:
    """Serve callbacks of nodes until ``ending`` returns true or their context is shut down."""
    context = nodes[0].context
    executor = EventsExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    ended, served = Future(), threading.Event()

    def look() -> None:
        while not (served.wait(_LOOK_SECONDS) or ended.done()):
            if ending():
                ended.set_result(None)
    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        while context.ok() and not ended.done():
            executor.spin_until_future_complete(ended, _SLICE_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        served.set()
        thread.join()
        executor.shutdown()


def run(
        factory: Callable[[], Node | Sequence[Node]], args: Sequence[str] | None = None) -> int:
    """Run one node or several as a process; return 0, 1 for a failure, or 2 for bad parameters."""
    # Errors of the factory refuse the start. The method ``close`` of a node is called before the
    # node is destroyed. An error in its attribute ``failure`` makes the run fail, and a true
    # attribute ``finished`` ends it.
    ENDING.note()
    arguments = list(sys.argv[1:] if args is None else args)
    nodes: Sequence[Node] = ()
    status = 0
    try:
        _initialise(arguments)
        made = factory()
        nodes = (made,) if isinstance(made, Node) else made
        for sentence in unread_files(arguments, [x.get_fully_qualified_name() for x in nodes]):
            nodes[0].get_logger().warning(sentence)
        _avoid_pauses()
        spin(nodes, lambda: ENDING.asked or any(getattr(x, 'finished', False) for x in nodes))
    except (BadInputError, ParameterException) as error:
        status = complain(error, 2)
    except HmsaError as error:
        status = complain(error, 1)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        for node in nodes:
            getattr(node, 'close', lambda: None)()
            node.destroy_node()
        rclpy.try_shutdown()
    failure = next(filter(None, (getattr(x, 'failure', None) for x in nodes)), None)
    return complain(failure, 1) if failure is not None and not status else status


def _avoid_pauses() -> None:
    """Do work now that would delay commands by tens of milliseconds later."""
    # The first log message makes rclpy look up all modules, which takes 30 ms or more. That would
    # happen when a command is late.
    inspect.getmodule(inspect.currentframe())
    # The libraries create 140,000 objects. A full garbage collection visits all of them in 40 ms.
    # Python runs it so rarely that garbage and spare tuples accumulate.
    gc.collect()
    gc.freeze()
    # With nothing left to visit, this makes Python treat full collections as cheap.
    gc.collect()


def _initialise(arguments: Sequence[str]) -> None:
    """Start rclpy, and refuse unknown arguments."""
    if os.environ.get('NO_COLOR') and not os.environ.get('RCUTILS_COLORIZED_OUTPUT'):
        os.environ['RCUTILS_COLORIZED_OUTPUT'] = '0'
    # The error of rcl also contains its log message, and is printed below in one line.
    set_logger_level('rcl', LoggingSeverity.FATAL)
    try:
        start_ros(['hmsa', *arguments])
    except BadInputError:
        raise
    except Exception as error:  # rclpy raises errors of several unrelated classes here
        text = re.sub(r'^failed to initialize rcl: |, at \S+:\d+', '', str(error))
        raise BadInputError(
            f'arguments {" ".join(arguments)!r}: {text}; expected -p NAME:=VALUE, -r FROM:=TO, '
            '--params-file FILE or another option of ROS 2') from error
    finally:
        if get_logger_level('rcl') == LoggingSeverity.FATAL:
            set_logger_level('rcl', LoggingSeverity.UNSET)
    unknown = rclpy.utilities.remove_ros_args(['hmsa', *arguments])[1:]
    if unknown:
        raise BadInputError(
            f'unknown argument {unknown[0]!r}: expected nothing but --ros-args ...; see --help')
