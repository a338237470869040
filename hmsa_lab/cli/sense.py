"""``hmsa sense``: run the node that publishes what a sensor measures."""

from typing import Any

from hmsa_ros.cli.node import add_node, run

__all__ = ['add_parser', 'run']


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_node(
        subparsers, 'sense', 'publish the stretch that a camera or another sensor measures',
        '-p topic:=/block/pose -p sensor.rest_length:=0.02')
