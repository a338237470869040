"""What takes time on its way."""

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

from hmsa_ros.errors import BadInputError

T = TypeVar('T')


class Transport(Generic[T]):
    """
    Things on their way, all of which take the same time in ns.

    Raises
    ------
    BadInputError
        If that is negative.

    """

    def __init__(self, delay: int) -> None:
        if delay < 0:
            raise BadInputError(f'delay is {delay} ns: expected at least 0')
        self.delay = delay
        self._moving: deque[tuple[int, T]] = deque()

    def send(self, now: int, thing: T) -> None:
        """Send something at a time in ns, not before what was sent last."""
        self._moving.append((now + self.delay, thing))

    def arrived(self, now: int) -> Iterator[tuple[int, T]]:
        """Yield what has arrived by a time in ns, and when; each once."""
        while self._moving and self._moving[0][0] <= now:
            yield self._moving.popleft()

    def clear(self) -> None:
        """Lose what is on its way."""
        self._moving.clear()
