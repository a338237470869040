"""Entry points: the commands, nodes and hardware that packages register in their ``setup.py``."""

from importlib.metadata import entry_points, EntryPoint

#: Groups: commands of ``hmsa``, nodes, and hardware by its short name.
COMMANDS, NODES, HARDWARE = 'hmsa.commands', 'hmsa_ros.nodes', 'hmsa_ros.hardware'


def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, in alphabetical order."""
    return {x.name: x for x in sorted(entry_points(group=group), key=lambda x: x.name)}
