"""``hmsa planner`` and similar: run a node, or planner and device in one process."""

import argparse
from typing import Any

from hmsa.ending import ENDING
from hmsa.plugins import NODES, registered

# Summary and example of each node.
_NODES = {
    'planner': ('plan shaped commands for setpoint sequences', '-r __ns:=/left'),
    'plant': ('simulate the actuator', '-p publish_rate:=500.0'),
    'driver': (
        'operate a physical actuator in place of the plant', '-p hardware:=my_lab:Coil'),
    'recorder': (
        'record topics to a bag', '-p storage.uri:=my_run -p record.all_topics:=true'),
    'player': ('replay a bag', '-p storage.uri:=my_run'),
    'controller': (
        'planner and plant, or driver, in one process and one loop',
        '--params-file actuator.yaml -p lead_time:=0.003'),
}


def add_parser(subparsers: Any) -> None:
    """Add one command for each node."""
    for name, (summary, example) in _NODES.items():
        add_node(subparsers, name, summary, example)


def add_node(subparsers: Any, name: str, summary: str, example: str) -> None:
    """Add the command that runs a node, registered as an entry point of ``hmsa_ros.nodes``."""
    parser = subparsers.add_parser(
        name, help=f'run the {name} node: {summary}',
        description=f'Run the {name} node: {summary}.',
        usage=f'hmsa {name} [-h] [--ros-args ...]',
        epilog='ROS arguments are parameters (-p NAME:=VALUE, --params-file FILE) and '
               f'remappings (-r FROM:=TO). example: hmsa {name} --ros-args {example}')
    parser.set_defaults(node=name, is_node=True)


def run(arguments: argparse.Namespace) -> int:
    """Run the node until the end is requested."""
    # A request to end while ROS is imported needs no clean-up.
    if arguments.node == 'recorder':
        ENDING.leave(1, 'the recorder was told to end before its bag was open: no bag is written')
    else:
        ENDING.leave(0)
    status: int = registered(NODES)[arguments.node].load().main(arguments.ros_args)
    return status
