"""
Life of a node process: start, spin, end cleanly on SIGINT and SIGTERM.

One place for what every node's ``main`` does, so that a node file holds wiring only.
"""

from collections.abc import Callable, Sequence
import gc
import inspect
import os
import re
import sys

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.logging import get_logger_level, LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.task import Future

from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError, complain, HmsaError
from hmsa_ros.nodes.visitor import start_ros

# EventsExecutor.spin() without a time limit busy-loops and delivers nothing on this rclpy
# (7.1); waiting for a future that never completes, a slice at a time, behaves as documented.
_SLICE_SECONDS = 0.1


def spin(nodes: Sequence[Node], ending: Callable[[], bool]) -> None:
    """Serve the callbacks of nodes until ``ending`` says so or their context is shut down."""
    context = nodes[0].context
    executor = EventsExecutor(context=context)
    for node in nodes:
        executor.add_node(node)
    never = Future()
    try:
        while context.ok() and not ending():
            executor.spin_until_future_complete(never, _SLICE_SECONDS)
    except ExternalShutdownException:
        pass
    finally:
        executor.shutdown()


def run(
        factory: Callable[[], Node | Sequence[Node]], args: Sequence[str] | None = None) -> int:
    """Run one node or several as a process; return 0, 1 for a failure, or 2 for bad parameters."""
    # The factory may raise errors, which refuse the start. A node's method ``close`` is called
    # before it is destroyed; an error in its attribute ``failure`` makes the run a failed one, and
    # a true attribute ``finished`` ends it.
    ENDING.note()
    arguments = list(sys.argv[1:] if args is None else args)
    nodes: Sequence[Node] = ()
    status = 0
    try:
        _initialise(arguments)
        made = factory()
        nodes = (made,) if isinstance(made, Node) else made
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
    """Do now what would keep commands waiting for tens of milliseconds later."""
    # rclpy asks for the module of whoever logs something. The first time all modules are looked
    # up, which takes 30 ms and more, and would be when a command is late.
    inspect.getmodule(inspect.currentframe())
    # The libraries bring 140,000 objects along. A full collection of garbage looks at them all for
    # 40 ms, and Python makes it so seldom that garbage and spare tuples pile up until then.
    gc.collect()
    gc.freeze()
    # With nothing left to look at: tells Python that a full collection is cheap from now on.
    gc.collect()


def _initialise(arguments: Sequence[str]) -> None:
    """Start rclpy, and refuse arguments that it or nobody understands."""
    if os.environ.get('NO_COLOR') and not os.environ.get('RCUTILS_COLORIZED_OUTPUT'):
        os.environ['RCUTILS_COLORIZED_OUTPUT'] = '0'
    # What rcl says of bad arguments is in its error too, which is printed below in one line.
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
