"""Where messages of other packages have what a sensor reads: fields by their path."""

from collections.abc import Callable
import re
from typing import Any

from geometry_msgs.msg import TransformStamped
import numpy as np

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.equations import Array

#: By type, the field that is read unless another is named.
USUAL = {
    'geometry_msgs/msg/PoseStamped': 'pose.position',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'pose.pose.position',
    'geometry_msgs/msg/PointStamped': 'point',
    'geometry_msgs/msg/TransformStamped': 'transform.translation',
    'geometry_msgs/msg/Vector3Stamped': 'vector',
    'sensor_msgs/msg/JointState': 'position',
    'sensor_msgs/msg/Range': 'range',
    'std_msgs/msg/Float32': 'data',
    'std_msgs/msg/Float64': 'data',
    'tf2_msgs/msg/TFMessage': 'transform.translation',
}
_STEP = re.compile(r'([a-z]\w*)((?:\[\d+\])*)$')
_AXES = ('x', 'y', 'z')


def reader(type_name: str, kind: type[Any], path: str, element: str) -> Callable[[Any], Any]:
    """
    Return what takes timestamp and reading out of a message.

    Parameters
    ----------
    type_name : str
        Such as ``'geometry_msgs/msg/PoseStamped'``.
    kind : type
        The class of the messages.
    path : str
        Of the field, such as ``'pose.position.z'`` or ``'data[2]'``; a point or a vector is read
        whole. Empty: the one in `USUAL`.
    element : str
        Name of the joint or of the frame, for messages of several.

    Returns
    -------
    callable
        Returns the header's timestamp (None without a header) and the reading as an array of one
        or three numbers; None where the message does not contain the element.

    Raises
    ------
    BadInputError
        If there is no such field, it is no number, or an element is needed or not.

    """
    path = path or USUAL.get(type_name, '')
    if not path:
        raise BadInputError(
            f'parameter field is empty: expected the field of {type_name} to read, such as '
            'pose.position.z')
    find = _FIND.get(type_name)
    if (find is None) is bool(element):
        raise BadInputError(f'parameter element is {element!r}: expected ' + (
            f'none, since a {type_name} has one reading' if element else
            f'the name of the joint or frame to read in a {type_name}'))
    steps = _steps(path)
    _check(type_name, TransformStamped() if find is _of_frame else kind(), steps, path)

    def read(message: Any) -> tuple[Any, Array] | None:
        part, place = (message, None) if find is None else find(message, element)
        if part is None:
            return None
        value = part
        for step in steps:
            value = value[step] if isinstance(step, int) else getattr(value, step)
        header = getattr(part, 'header', None)
        return None if header is None else header.stamp, _numbers(
            value if place is None else value[place])

    return read


def _of_joint(message: Any, element: str) -> tuple[Any, int | None]:
    names = list(message.name)
    return (message, names.index(element)) if element in names else (None, None)


def _of_frame(message: Any, element: str) -> tuple[Any, None]:
    # The newest of several.
    found = [x for x in message.transforms if x.child_frame_id == element]
    return found[-1] if found else None, None


# What finds an element in messages that contain several.
_FIND: dict[str, Callable[[Any, str], tuple[Any, int | None]]] = {
    'sensor_msgs/msg/JointState': _of_joint, 'tf2_msgs/msg/TFMessage': _of_frame}


def _steps(path: str) -> list[str | int]:
    """Return the names and indices of a path."""
    found: list[str | int] = []
    for word in path.split('.'):
        match = _STEP.match(word)
        if match is None:
            raise BadInputError(
                f'parameter field is {path!r}: expected names of fields with dots between them, '
                'such as pose.position.z or data[2]')
        found += [match[1], *map(int, re.findall(r'\d+', match[2]))]
    return found


def _check(type_name: str, value: Any, steps: list[str | int], path: str) -> None:
    """Refuse a path that an empty message does not have, as far as that shows."""
    for step in steps:
        if isinstance(step, int):
            # An empty message may have none of them.
            return
        names = [*getattr(value, 'get_fields_and_field_types', dict)()]
        if step not in names:
            raise BadInputError(
                f'parameter field is {path!r}, and a {type_name} has no {step} there: expected '
                f'one of {", ".join(names)}' if names else
                f'parameter field is {path!r}: expected nothing after a number')
        value = getattr(value, step)
    if isinstance(value, (bool, str)) or not (
            isinstance(value, (int, float)) or hasattr(value, '__len__') or _is_point(value)):
        raise BadInputError(
            f'parameter field is {path!r}, of a {type_name} a {type(value).__name__}: expected a '
            'number, a point or a vector')


def _is_point(value: Any) -> bool:
    return all(hasattr(value, x) for x in _AXES) and not hasattr(value, 'w')


def _numbers(value: Any) -> Array:
    numbers = [getattr(value, x) for x in _AXES] if _is_point(value) else [value]
    return np.array(numbers, dtype=float)
