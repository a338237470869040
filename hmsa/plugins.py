"""Entry points of commands, nodes, hardware and feedback, registered in ``setup.py``."""

from functools import cache
from importlib.metadata import entry_points, EntryPoint

#: Groups: commands of ``hmsa``, nodes, hardware by its short name, and feedback from samples.
COMMANDS, NODES, HARDWARE, FOLLOWER = (
    'hmsa.commands', 'hmsa_ros.nodes', 'hmsa_ros.hardware', 'hmsa_ros.follower')


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, in alphabetical order."""
    return {x.name: x for x in sorted(entry_points(group=group), key=lambda x: x.name)}
