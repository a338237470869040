"""Fields of messages by path, such as ``pose.position.z`` or ``data[2]``."""

import re
from typing import Any

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array

#: Default field by type.
USUAL = {
    'geometry_msgs/msg/PoseStamped': 'pose.position',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'pose.pose.position',
    'geometry_msgs/msg/PointStamped': 'point',
    'geometry_msgs/msg/TransformStamped': 'transform.translation',
    'geometry_msgs/msg/Vector3Stamped': 'vector',
    'sensor_msgs/msg/JointState': 'position',
    'sensor_msgs/msg/MagneticField': 'magnetic_field',
    'sensor_msgs/msg/Range': 'range',
    'std_msgs/msg/Float32': 'data',
    'std_msgs/msg/Float32MultiArray': 'data[0]',
    'std_msgs/msg/Float64': 'data',
    'std_msgs/msg/Float64MultiArray': 'data[0]',
    'tf2_msgs/msg/TFMessage': 'transform.translation',
}
AXES = ('x', 'y', 'z')
_STEP = re.compile(r'([a-z]\w*)((?:\[\d+\])*)$')


def located(type_name: str, message: Any, path: str) -> tuple[str, list[str | int], Any]:
    """
    Return a path, or the default for an empty one, its steps, and the value at its end.

    The value is that of an empty message of the type, or the array before an index.

    Raises
    ------
    BadInputError
        If the path is invalid, or an empty message shows that the field does not exist.

    """
    path = path or USUAL.get(type_name, '')
    if not path:
        raise BadInputError(
            f'parameter field is empty: expected that of a {type_name} to use, such as '
            'pose.position.z or data[0]')
    way: list[str | int] = []
    for word in path.split('.'):
        match = _STEP.match(word)
        if match is None:
            raise BadInputError(
                f'parameter field is {path!r}: expected names of fields with dots between them, '
                'such as pose.position.z or data[2]')
        way += [match[1], *map(int, re.findall(r'\d+', match[2]))]
    value = message
    for step in way:
        if isinstance(step, int):
            # An array in an empty message may have no elements.
            break
        names = [*getattr(value, 'get_fields_and_field_types', dict)()]
        if step not in names:
            raise BadInputError(
                f'parameter field is {path!r}, and a {type_name} has no {step} there: expected '
                f'one of {", ".join(names)}' if names else
                f'parameter field is {path!r}: expected nothing after a number')
        value = getattr(value, step)
    return path, way, value


def is_point(value: Any) -> bool:
    """Return whether a value has exactly three coordinates."""
    return all(hasattr(value, x) for x in AXES) and not hasattr(value, 'w')


def numbers(value: Any) -> Array:
    """Return a number as an array of one element, or a point or vector as one of three."""
    return np.array(
        [getattr(value, x) for x in AXES] if is_point(value) else [value], dtype=float)
