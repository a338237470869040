"""
Life cycle of a node process: start, spin, end cleanly on SIGINT and SIGTERM.

All nodes share this implementation of ``main``.
"""

from collections.abc import Callable, Sequence
import gc
import inspect
import os
import re
import sys

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.logging import get_logger_level, LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.task import Future

from hmsa.ending import ENDING
from hmsa.errors import BadInputError, complain, HmsaError
from hmsa_ros.nodes.parameters import unread_files
from hmsa_ros.nodes.temporary_node import start_ros

# On this rclpy (7.1), EventsExecutor.spin() without a time limit busy-loops and delivers nothing.
# Waiting in slices for a future works as documented. With events always at hand, though, a slice
# does not end in time: only a timer has its turn then.
_SLICE_SECONDS, _LOOK_SECONDS = 1.0, 0.1


def spin(nodes: Sequence[Node], ending: Callable[[], bool]) -> None:
    """Serve callbacks of nodes until ``ending`` returns true or their context is shut down."""
    context = nodes[0].context
    executor = EventsExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    ended = Future()

    def look() -> None:
        if ending() and not ended.done():
            ended.set_result(None)
    timer = nodes[0].create_timer(
        _LOOK_SECONDS, look, clock=Clock(clock_type=ClockType.STEADY_TIME))
    # A managed node destroys what it has created since it was configured.
    getattr(nodes[0], 'keep', lambda *entities: None)(timer)
    try:
        while context.ok() and not ended.done():
            executor.spin_until_future_complete(ended, _SLICE_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        timer.cancel()
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
