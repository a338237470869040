"""The launch files in the form required by ROS 2's ``launch``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from hmsa.errors import HmsaError
from hmsa_ros.clients.launching import failure, LaunchFile, Started
from hmsa_ros.clients.processes import NodeProcess

# Before SIGTERM and SIGKILL: enough for a recorder to write its messages to a slow disk.
_PATIENCE = {'sigterm_timeout': '30', 'sigkill_timeout': '30'}


def description(file: LaunchFile) -> LaunchDescription:
    """Return a launch file's arguments and processes; a failing one ends all with status 1."""
    def start(context: Any) -> list[Any]:
        share = Path(FindPackageShare('hmsa_ros').perform(context))
        return _actions(file.evaluate(context.launch_configurations, share))

    return LaunchDescription([
        *(DeclareLaunchArgument(
            x.name, default_value=x.default, description=x.description,
            choices=x.choices or None) for x in file.arguments),
        OpaqueFunction(function=start)])


def _actions(started: Started) -> list[Any]:
    # RViz first: if it is not installed, launch fails before anything is started.
    rviz = [] if started.rviz is None else [_action(started.rviz, 'rviz2', None)]
    note = [LogInfo(msg=started.note)] if started.note else []
    return note + rviz + [
        _action(x, 'hmsa_ros', _ended(x.name, x.name == started.last)) for x in started.nodes]


def _action(process: NodeProcess, package: str, on_exit: Any) -> Node:
    return Node(
        package=package, executable=process.name, arguments=list(process.options),
        ros_arguments=process.ros_arguments(), on_exit=on_exit, output='screen', **_PATIENCE)


def _ended(name: str, last: bool) -> Callable[[Any, Any], Any]:
    """Return the reaction to the end of a node."""
    def ended(event: Any, context: Any) -> Any:
        sentence = failure(name, event.returncode, context.is_shutdown)
        if sentence:
            raise HmsaError(sentence)
        return Shutdown(reason=f'the {name} is done') if last else None

    return ended
