"""Classes of messages and services by the names of their types."""

from importlib import import_module
from typing import Any

from hmsa_ros.bag.definitions import is_interface_package
from hmsa_ros.errors import BagError


def interface_class(type_name: str) -> type[Any]:
    """
    Return the class of a message, service or action type like ``'std_msgs/msg/Float64'``.

    Raises
    ------
    BagError
        If its package is not installed.

    """
    parts = type_name.split('/')
    try:
        package, folder, name = parts
        # The name may come from anybody's bag: nothing but an interface is ever imported.
        if folder not in ('msg', 'srv', 'action') or not is_interface_package(package):
            raise ImportError(type_name)
        found: type[Any] = getattr(import_module(f'{package}.{folder}'), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise BagError(
            f'message type {type_name} is not installed: expected its Python package; source '
            'its workspace') from error
    return found
