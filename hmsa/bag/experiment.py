"""
Metadata of the experiment in a bag: the parameters of its nodes.

The recorder stores them as custom data under the node's full name, a dot and the parameter's
name (``/left/plant.actuator.density``), the value as JSON. Bags of version 0.1 have the last
part of the node's name only (``plant.actuator.density``).
"""

from collections.abc import Mapping


def parameter_key(node: str, name: str) -> str:
    """Return the key of custom data for a parameter, as ``'/left/plant.actuator.density'``."""
    return f'{node}.{name}'


def node_parameters(custom_data: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Return values as JSON by parameter, by node (full name; in bags of version 0.1 its end)."""
    # Every node has this parameter, and no other custom data end with it.
    nodes = {key.partition('.')[0] for key in custom_data if key.endswith('.use_sim_time')}
    result: dict[str, dict[str, str]] = {}
    for key, value in custom_data.items():
        node, _, name = key.partition('.')
        if node in nodes and name:
            result.setdefault(node, {})[name] = value
    return result


def recorded_parameters(custom_data: Mapping[str, str], node: str, space: str) -> dict[str, str]:
    """Return JSON values by parameter of a namespace's node, else of the only such node."""
    nodes = node_parameters(custom_data)
    exact = nodes.get(f'{space.rstrip("/")}/{node}')
    if exact is not None:
        return exact
    alike = [values for name, values in nodes.items() if name.rsplit('/', 1)[-1] == node]
    return alike[0] if len(alike) == 1 else {}
