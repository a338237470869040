"""``hmsa planner`` and similar: run a node, or planner and device in one process."""

import argparse
from importlib import import_module
from typing import Any

from hmsa_ros.ending import ENDING

NODES = {
    'planner': 'plan shaped commands for setpoint sequences',
    'plant': 'simulate the actuator',
    'driver': 'operate a physical actuator in place of the plant',
    'recorder': 'record topics to a bag',
    'player': 'replay a bag',
    'sense': 'publish the stretch that a camera or another sensor measures',
    'controller': 'planner and plant, or driver, in one process and one loop',
}
_EXAMPLES = {
    'planner': '-r __ns:=/left',
    'plant': '-p publish_rate:=500.0',
    'driver': '-p hardware:=my_lab:Coil',
    'recorder': '-p storage.uri:=my_run -p record.all_topics:=true',
    'player': '-p storage.uri:=my_run',
    'sense': '-p topic:=/block/pose -p sensor.rest_length:=0.02',
    'controller': '--params-file actuator.yaml -p lead_time:=0.003',
}


def add_parser(subparsers: Any) -> None:
    """Add one command for each node."""
    for name, summary in NODES.items():
        parser = subparsers.add_parser(
            name, help=f'run the {name} node: {summary}',
            description=f'Run the {name} node: {summary}.',
            usage=f'hmsa {name} [-h] [--ros-args ...]',
            epilog='ROS arguments are parameters (-p NAME:=VALUE, --params-file FILE) and '
                   f'remappings (-r FROM:=TO). example: hmsa {name} --ros-args {_EXAMPLES[name]}')
        parser.set_defaults(node=name)


def run(arguments: argparse.Namespace) -> int:
    """Run the node until the end is requested."""
    # A request to end while ROS is imported needs no clean-up.
    if arguments.node == 'recorder':
        ENDING.leave(1, 'the recorder was told to end before its bag was open: no bag is written')
    else:
        ENDING.leave(0)
    module = import_module(f'hmsa_ros.nodes.{arguments.node}')
    status: int = module.main(arguments.ros_args)
    return status
