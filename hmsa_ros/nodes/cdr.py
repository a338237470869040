"""Messages read field by field from their serialized form, without ROS and its objects."""

import struct

from hmsa_ros.errors import BadInputError
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
