"""
Read messages field by field from their serialized form, without ROS message objects.

rclpy creates objects for all points of a trajectory at once. For a million points this takes
seconds and half a gigabyte. Here the header is read first, so that rejecting an overlong
trajectory costs nothing, and the points are read on demand.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
import math
import struct
from typing import Any

from hmsa.errors import BadInputError, excerpt
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa_ros.runtime.records import Trajectory

# Length of the preamble: the representation identifier and two bytes of options.
_PREAMBLE = 4
# Limit on the number of joints, above that of any planner.
_MOST_JOINTS = 1000
_LITTLE = b'\x00\x01'
_BIG = b'\x00\x00'


class CdrReader:
    """Read CDR, the wire format of messages, in which each value is aligned to its size."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (_LITTLE, _BIG) or len(data) < _PREAMBLE:
            raise BadInputError('the message cannot be decoded: expected plain CDR')
        self._data = memoryview(data)[_PREAMBLE:]
        self._order = '<' if data[:2] == _LITTLE else '>'
        self.place = 0

    @property
    def left(self) -> int:
        """Number of bytes left."""
        return len(self._data) - self.place

    def _pass(self, size: int, alignment: int = 1) -> int:
        """Return the aligned start of the next ``size`` bytes, and move behind them."""
        place = -(-self.place // alignment) * alignment
        if place + size > len(self._data):
            raise BadInputError('the message cannot be decoded: it ends too early')
        self.place = place + size
        return place

    def take(self, kind: str, count: int = 1) -> tuple[float, ...]:
        """Return ``count`` numbers of a format character of the module struct."""
        if not count:
            return ()
        size = struct.calcsize(f'<{kind}')
        place = self._pass(count * size, size)
        return struct.unpack_from(f'{self._order}{count}{kind}', self._data, place)

    def count(self) -> int:
        """Return the length of the following sequence or string."""
        return int(self.take('I')[0])

    def time(self) -> int:
        """Return a timestamp or a duration in ns."""
        seconds, = self.take('i')
        nanoseconds, = self.take('I')
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    def text(self) -> str:
        """Return a string."""
        length = self.count()
        place = self._pass(length)
        return bytes(self._data[place:place + length]).rstrip(b'\0').decode('utf-8', 'replace')

    def names(self, what: str) -> tuple[str, ...]:
        """Return the names of joints; raise `BadInputError` if there are too many."""
        many = self.count()
        if many > _MOST_JOINTS:
            raise BadInputError(f'{what} names {many} joints: expected at most {_MOST_JOINTS}')
        return tuple(self.text() for _ in range(many))


def stamp_of(data: bytes) -> int:
    """Return the timestamp in ns of a serialized message that begins with a header, else 0."""
    try:
        return CdrReader(data).time()
    except BadInputError:
        return 0


class JointStateReader:
    """Read serialized JointStates; names are decoded only if they differ from the last ones."""

    def __init__(self) -> None:
        self._order = self._head = b''  # representation, and the part from frame to names
        self._names: tuple[str, ...] = ()
        self._end = 0  # of that part

    def read(self, data: bytes) -> tuple[tuple[str, ...], int, list[Sequence[float]]]:
        """
        Return joints, timestamp in ns, and stretch, rate (1/s) and flux density (T) of each.

        A field that is not measured is empty in the message, and NaN here.

        Raises
        ------
        BadInputError
            If it cannot be decoded.

        """
        reader = CdrReader(data)
        stamp = reader.time()
        if data[:2] == self._order and data[_PREAMBLE + 8:self._end] == self._head:
            reader.place = self._end - _PREAMBLE
        else:
            reader.text()
            self._names = reader.names('a sample')
            self._order, self._end = data[:2], reader.place + _PREAMBLE
            self._head = data[_PREAMBLE + 8:self._end]
        many = len(self._names)
        fields = (reader.take('d', reader.count()) for _ in range(3))
        return self._names, stamp, [
            x if len(x) == many else (*x, *(math.nan,) * many)[:many] for x in fields]


# Minimum size of a point: four lengths and a duration.
_LEAST_POINT = 24
_FIELDS = ('positions', 'velocities', 'accelerations', 'effort')
# Required fields of the points, and the message about unexpected values in the others.
_WANTED = {
    'positions': (
        ('positions',),
        'none, the actuator comes to rest at each setpoint (with the parameter trajectory_mode '
        'set to path, it follows velocities)'),
    'effort': (('effort',), 'none, the levels of the field are all there is'),
    'path': (
        ('positions', 'velocities'), 'accelerations of all joints or none, and no effort'),
}


def read_trajectory(data: bytes) -> Trajectory:
    """
    Return a serialized JointTrajectory as a request that reads its points on demand.

    Raises
    ------
    BadInputError
        If it cannot be decoded.

    """
    cursor = CdrReader(data)
    stamp, name = cursor.time(), cursor.text()
    names = cursor.names('the trajectory')
    many = len(names)
    count = cursor.count()
    if _LEAST_POINT * count > cursor.left + 4:
        raise BadInputError('the message cannot be decoded: it ends too early')
    sizes = _sizes(cursor) if count and names else []
    raw = bool(sizes) and not sizes[0] and sizes[3] == many
    points = _Points(cursor, names, count, 'effort' if raw else 'positions')
    return Trajectory(
        names, points, count, stamp or None, name, raw,
        replace(points, wanted='path') if sizes[:2] == [many, many] else None)


@dataclass(frozen=True)
class _Points:
    """
    Points at a cursor, read again for each iteration.

    Each contains stretches, or levels in T, and the time from the start in ns. Points of a path
    contain stretch, rate and acceleration of each joint; an omitted acceleration is NaN.
    """

    cursor: CdrReader
    names: Sequence[str]
    count: int
    wanted: str

    def __iter__(self) -> Iterator[tuple[Sequence[Any], int]]:
        many = len(self.names)
        cursor, rest = copy(self.cursor), (0.0,) * many
        needed, expected = _WANTED[self.wanted]
        for number in range(self.count):
            found = []
            for field in _FIELDS:
                values = cursor.take('d', cursor.count())
                if field in needed:
                    if len(values) != many:
                        raise RefusedError(
                            Code.BAD_INPUT,
                            f'point {number} has {len(values)} {field}: expected {many}, one for '
                            'each of joint_names')
                    found.append(values)
                elif self.wanted == 'path' and field == 'accelerations' and len(values) == many:
                    found.append(values)
                elif values not in ((), rest):
                    raise RefusedError(
                        Code.BAD_INPUT,
                        f'point {number} has {field} {excerpt(list(values))}: expected {expected}')
            if self.wanted == 'path':
                yield list(zip(*found[:2], *found[2:] or [(math.nan,) * many], strict=True)), (
                    cursor.time())
            else:
                yield found[0], cursor.time()


def _sizes(cursor: CdrReader) -> list[int]:
    """Return the length of each field of the next point; an empty list if it is truncated."""
    try:
        ahead = copy(cursor)
        return [len(ahead.take('d', ahead.count())) for _ in _FIELDS]
    except BadInputError:
        return []
