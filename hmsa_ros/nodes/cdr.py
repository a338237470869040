"""
Messages read field by field from their serialized form, without ROS and its objects.

rclpy makes objects of all points of a trajectory at once, which takes seconds and gigabytes for a
million. Here the header is read first, so that a trajectory that is too long costs nothing, and
the points when they are asked for.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
import struct

from hmsa_ros.control.records import Trajectory
from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.model.units import NANOSECONDS

# What a message begins with: the representation, and options of two bytes.
_PREAMBLE = 4
_LITTLE = b'\x00\x01'
_BIG = b'\x00\x00'


class Cursor:
    """Reads CDR, the form that messages have on the wire: everything aligned to its size."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (_LITTLE, _BIG) or len(data) < _PREAMBLE:
            raise BadInputError('the message cannot be decoded: expected plain CDR')
        self._data = memoryview(data)[_PREAMBLE:]
        self._order = '<' if data[:2] == _LITTLE else '>'
        self.place = 0

    @property
    def left(self) -> int:
        """Bytes that are left."""
        return len(self._data) - self.place

    def _pass(self, size: int, alignment: int = 1) -> int:
        """Return where some bytes begin, and go on behind them."""
        place = -(-self.place // alignment) * alignment
        if place + size > len(self._data):
            raise BadInputError('the message cannot be decoded: it ends too early')
        self.place = place + size
        return place

    def take(self, kind: str, count: int = 1) -> tuple[float, ...]:
        """Return numbers of a kind of the module struct."""
        if not count:
            return ()
        size = struct.calcsize(f'<{kind}')
        place = self._pass(count * size, size)
        return struct.unpack_from(f'{self._order}{count}{kind}', self._data, place)

    def count(self) -> int:
        """Return the length of what follows."""
        return int(self.take('I')[0])

    def time(self) -> int:
        """Return a stamp or a duration in ns."""
        seconds, = self.take('i')
        nanoseconds, = self.take('I')
        return int(seconds) * NANOSECONDS + int(nanoseconds)

    def text(self) -> str:
        """Return a string."""
        length = self.count()
        place = self._pass(length)
        return bytes(self._data[place:place + length]).rstrip(b'\0').decode('utf-8', 'replace')


def stamp_of(data: bytes) -> int:
    """Return the stamp in ns of a serialized message that begins with a header, else 0."""
    try:
        return Cursor(data).time()
    except BadInputError:
        return 0


# The least that a point takes: four lengths and a duration.
_LEAST_POINT = 24
# More joints than any planner has.
_MOST_JOINTS = 1000
_FIELDS = ('positions', 'velocities', 'accelerations', 'effort')


def read_trajectory(data: bytes) -> Trajectory:
    """
    Return a serialized JointTrajectory as a request, which reads its points when asked for.

    Raises
    ------
    BadInputError
        If it cannot be decoded.

    """
    cursor = Cursor(data)
    stamp, name = cursor.time(), cursor.text()
    many = cursor.count()
    if many > _MOST_JOINTS:
        raise BadInputError(
            f'the trajectory names {many} joints: expected at most {_MOST_JOINTS}')
    names = tuple(cursor.text() for _ in range(many))
    count = cursor.count()
    if _LEAST_POINT * count > cursor.left + 4:
        raise BadInputError('the message cannot be decoded: it ends too early')
    raw = bool(count) and _raw(cursor, names)
    return Trajectory(
        names, _Points(cursor, names, count, 'effort' if raw else 'positions'), count,
        stamp or None, name, raw)


@dataclass(frozen=True)
class _Points:
    """Points behind a cursor, read anew each time that they are asked for."""

    cursor: Cursor
    names: Sequence[str]
    count: int
    wanted: str

    def __iter__(self) -> Iterator[tuple[Sequence[float], int]]:
        return _points(copy(self.cursor), self.names, self.count, self.wanted)


def _raw(cursor: Cursor, names: Sequence[str]) -> bool:
    """Whether the next point has efforts and no positions."""
    place = cursor.place
    try:
        sizes = [len(cursor.take('d', cursor.count())) for _ in _FIELDS]
    except BadInputError:
        return False
    finally:
        cursor.place = place
    return bool(names) and sizes == [0, sizes[1], sizes[2], len(names)]


def _points(
        cursor: Cursor, names: Sequence[str], count: int,
        wanted: str) -> Iterator[tuple[Sequence[float], int]]:
    """Yield stretches, or levels in T, and time from the start in ns of each point."""
    rest = (0.0,) * len(names)
    for number in range(count):
        for field in _FIELDS:
            values = cursor.take('d', cursor.count())
            if field == wanted:
                found = values
                if len(found) != len(names):
                    raise RefusedError(
                        Code.BAD_INPUT,
                        f'point {number} has {len(found)} {wanted}: expected {len(names)}, '
                        'one for each of joint_names')
            elif values not in ((), rest):
                raise RefusedError(
                    Code.BAD_INPUT,
                    f'point {number} has {field} {excerpt(list(values))}: expected none, '
                    + ('the actuator comes to rest at each setpoint' if wanted == 'positions'
                       else 'the levels of the field are all there is'))
        yield found, cursor.time()
