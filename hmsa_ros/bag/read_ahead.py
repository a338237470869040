"""Reading the messages of a bag before they are wanted."""

from collections import deque
from collections.abc import Callable, Iterator
from itertools import islice
import threading

from hmsa_ros.bag.reader import Message

_POLL_SECONDS = 0.02
_BATCH = 100
#: Read ahead at most, whatever the number of messages: they may be large.
READ_AHEAD_BYTES = 64 * 2**20


class ReadAhead:
    """Reads so many messages ahead in a thread; ``read`` learns whether nobody wants more."""

    def __init__(
            self, read: Callable[[Callable[[], bool]], Iterator[Message]], size: int) -> None:
        self._messages = read(lambda: self._ended)
        self._size = size
        self._condition = threading.Condition()
        self._batches: deque[tuple[list[Message], int]] = deque()
        self._count = 0
        self._bytes = 0
        self._ended = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='read ahead', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Read until the end or until nobody wants more."""
        try:
            more = True
            while more:
                batch, size = [], 0
                for message in islice(self._messages, min(_BATCH, self._size)):
                    batch.append(message)
                    size += len(message.data)
                    if size > READ_AHEAD_BYTES // 8:
                        break
                more = bool(batch)
                with self._condition:
                    self._condition.wait_for(lambda: self._ended or (
                        self._count < self._size and self._bytes < READ_AHEAD_BYTES))
                    if self._ended:
                        return
                    if batch:
                        self._batches.append((batch, size))
                        self._count += len(batch)
                        self._bytes += size
                        self._condition.notify_all()
        except BaseException as error:  # raised again where the messages are taken
            self._error = error
        finally:
            with self._condition:
                self._ended = True
                self._condition.notify_all()

    def __iter__(self) -> Iterator[Message]:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._batches or self._ended)
                if not self._batches:
                    if self._error is not None:
                        raise self._error
                    return
                batch, size = self._batches.popleft()
                self._count -= len(batch)
                self._bytes -= size
                self._condition.notify_all()
            yield from batch

    def wait(self, cancelled: Callable[[], bool]) -> None:
        """Wait for the first messages, or the end if there are none or nobody waits."""
        with self._condition:
            while not (self._batches or self._ended or cancelled()):
                self._condition.wait(_POLL_SECONDS)

    def stop(self) -> None:
        """Read no further."""
        with self._condition:
            self._ended = True
            self._batches.clear()
            self._condition.notify_all()
        self._thread.join()
