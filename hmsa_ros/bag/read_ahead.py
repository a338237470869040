"""Reading the messages of a bag before they are wanted."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import islice

from hmsa_ros.bag.reader import Message

_POLL_SECONDS = 0.02
# Read ahead at a time, each an equal share of the messages and of the memory.
_BATCHES = 8
#: Read ahead at most, whatever the number of messages: they may be large.
READ_AHEAD_BYTES = 64 * 2**20


class ReadAhead:
    """Reads so many messages ahead in a thread; ``read`` learns whether nobody wants more."""

    def __init__(
            self, read: Callable[[Callable[[], bool]], Iterator[Message]], size: int) -> None:
        self._ended = False
        self._messages = read(lambda: self._ended)
        self._most = -(-size // _BATCHES)
        # One thread: the batches come in order.
        self._thread = ThreadPoolExecutor(1, 'read ahead')
        self._ahead = deque(self._thread.submit(self._batch) for _ in range(_BATCHES))

    def _batch(self) -> list[Message]:
        """Return the next messages, none at the end."""
        batch, size = [], 0
        for message in islice(self._messages, self._most):
            batch.append(message)
            size += len(message.data)
            if size > READ_AHEAD_BYTES // _BATCHES:
                break
        return batch

    def __iter__(self) -> Iterator[Message]:
        while batch := self._ahead.popleft().result():
            self._ahead.append(self._thread.submit(self._batch))
            yield from batch

    def wait(self, cancelled: Callable[[], bool]) -> None:
        """Wait for the first messages, or the end if there are none or nobody waits."""
        while not (self._ahead[0].done() or cancelled()):
            wait([self._ahead[0]], _POLL_SECONDS)

    def stop(self) -> None:
        """Read no further."""
        self._ended = True
        self._thread.shutdown(cancel_futures=True)
