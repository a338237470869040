"""
Take raw messages from subscriptions, fast and with their metadata, and publish without the lock.

The executors of rclpy pass one message at a time, without its publisher. Here a separate thread
polls several subscriptions and takes all messages that have arrived at once, with the publisher's
identifier, so that a gap in its sequence numbers shows a lost message.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
import ctypes
from functools import cache
import sys
import threading
import time
from typing import Any, NamedTuple

from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import check_is_valid_msg_type

from hmsa.errors import BadInputError

# Maximum number of messages taken from one subscription before the next.
_BATCH = 2000
# Sleep times of the thread after messages have arrived, and if none have: at high rates many are
# taken at once. Timestamps come from the middleware and are not affected.
_REST_SECONDS, _IDLE_SECONDS = 0.001, 0.005
# Time in s for which a replaced subscription is still read: on an idle machine, the publishers,
# which are known already, find the new one within some ms.
_OVERLAP_SECONDS = 2.0
# Time in ns without messages after which a publisher of /clock is replaced by another.
_SILENCE_NS = 1_000_000_000


class Taken(NamedTuple):
    """A received message: timestamps in ns, sequence number, publisher's identifier, payload."""

    source_ns: int
    received_ns: int
    sequence: int
    publisher: bytes
    data: bytes


def decode(data: bytes, message_type: type[Any]) -> Any:
    """
    Return a payload as a message of a class.

    Raises
    ------
    BadInputError
        If the payload is not such a message.

    """
    try:
        return deserialize_message(data, message_type)
    except Exception as error:  # rclpy raises errors of several unrelated classes here
        why = str(error).partition(', at ')[0]
        raise BadInputError(
            f'{len(data)} bytes cannot be read as {message_type.__name__}: {why}') from error


class _Allocator(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in (
        'allocate', 'deallocate', 'reallocate', 'zero_allocate', 'state')]


class Buffer(ctypes.Structure):
    """The structure rcutils_uint8_array_t."""

    _fields_ = [
        ('buffer', ctypes.c_void_p), ('length', ctypes.c_size_t),
        ('capacity', ctypes.c_size_t), ('allocator', _Allocator)]


class _Info(ctypes.Structure):
    """rmw_message_info_t of Jazzy and Kilted."""

    _fields_ = [
        ('source', ctypes.c_int64), ('received', ctypes.c_int64),
        ('sequence', ctypes.c_uint64), ('reception_sequence', ctypes.c_uint64),
        ('implementation', ctypes.c_char_p), ('publisher', ctypes.c_ubyte * 16),
        ('from_intra_process', ctypes.c_bool),
        # Space for fields that later distributions may append.
        ('_reserve', ctypes.c_ubyte * 64)]


class _Taker:
    """
    Take serialized messages with the function of rcl.

    The binding of rclpy omits the publisher's identifier, without which gaps cannot be detected if
    several publishers share a topic. The global interpreter lock is held: a take lasts about a
    microsecond, while releasing and acquiring the lock takes much longer.
    """

    def __init__(self) -> None:
        rcl = ctypes.PyDLL('librcl.so')
        utils = ctypes.PyDLL('librcutils.so')
        utils.rcutils_get_default_allocator.restype = _Allocator
        allocator = utils.rcutils_get_default_allocator()
        self._array = Buffer()
        self._info = _Info()
        init = utils.rcutils_uint8_array_init
        init.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p]
        if init(ctypes.byref(self._array), 2**16, ctypes.byref(allocator)) != 0:
            raise MemoryError('no memory for a receive buffer')
        self._take = rcl.rcl_take_serialized_message
        self._take.argtypes = [ctypes.c_void_p] * 4
        self._take.restype = ctypes.c_int

    def take(self, pointer: int, limit: int) -> list[Taken]:
        """Take at most ``limit`` messages from the subscription at an address."""
        result: list[Taken] = []
        take, string_at, array, info = self._take, ctypes.string_at, self._array, self._info
        array_at, info_at = ctypes.addressof(array), ctypes.addressof(info)
        while len(result) < limit and take(pointer, array_at, info_at, None) == 0:
            # On a busy machine, Fast DDS has passed on a message of many fragments without payload
            # and timestamps before the whole one. Every payload begins with its encoding.
            if array.length:
                result.append(Taken(
                    info.source, info.received, info.sequence, bytes(info.publisher),
                    string_at(array.buffer, array.length)))
        return result


_taker = cache(_Taker)


class RawSubscription:
    """A subscription without executor, read by `take`."""

    def __init__(
            self, node: Node, message_type: type[Any], topic: str, qos: QoSProfile) -> None:
        check_is_valid_msg_type(message_type)
        with node.handle:
            self.handle = _rclpy.Subscription(
                node.handle, message_type, topic, qos.get_c_qos_profile())

    def take(self, limit: int = _BATCH) -> list[Taken]:
        """Take at most ``limit`` messages in order of arrival."""
        try:
            with self.handle:
                return _taker().take(self.handle.pointer, limit)
        except InvalidHandle:
            return []

    @property
    def matched(self) -> bool:
        """Whether a publisher is matched, so that its messages are received."""
        try:
            with self.handle:
                return bool(self.handle.get_publisher_count())
        except InvalidHandle:
            return False

    def destroy(self) -> None:
        """Stop receiving."""
        self.handle.destroy_when_not_in_use()


class Capture:
    """
    A thread that takes messages from subscriptions and delivers them in batches.

    ``deliver`` is called with a list of (key, messages) for each round, in the order of the
    subscriptions.
    """

    def __init__(self, deliver: Callable[[Sequence[tuple[Any, list[Taken]]]], None]) -> None:
        self._deliver = deliver
        self._subscriptions: list[tuple[Any, RawSubscription]] = []
        # Replaced subscriptions, and until when they are read.
        self._leaving: list[tuple[Any, RawSubscription, float]] = []
        self._stopping = False
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='capture', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def add(self, key: Any, subscription: RawSubscription) -> None:
        """Take over a subscription: read it, deliver its messages with the key, destroy it."""
        self._subscriptions.append((key, subscription))

    def replace(self, key: Any, subscription: RawSubscription) -> None:
        """
        Read another subscription under a known key.

        Both are read for a while, so that nothing is lost before the publishers have found the new
        one; messages that both receive are delivered twice.
        """
        for i, (known, old) in enumerate(self._subscriptions):
            if known is key:
                self._leaving.append((key, old, time.monotonic() + _OVERLAP_SECONDS))
                self._subscriptions[i] = key, subscription

    def matched(self) -> list[Any]:
        """Return the keys of the subscriptions with a matched publisher."""
        return [key for key, x in self._subscriptions if x.matched]

    def take_again(self) -> list[tuple[Any, list[Taken]]]:
        """Take all messages that arrived since this round; only to be called from ``deliver``."""
        return self._round(sys.maxsize)

    def stop(self) -> None:
        """Deliver the messages that have arrived, and end the thread."""
        self._stopping = True
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            while True:
                # Read before the last round, so that this round is complete.
                stopping = self._stopping
                taken = self._round()
                if taken:
                    self._deliver(taken)
                elif stopping:
                    break
                if not stopping:
                    time.sleep(_REST_SECONDS if taken else _IDLE_SECONDS)
        except BaseException as error:  # reported by the node that owns the thread
            self.error = error
        finally:
            for subscription in (
                    *(x for _, x in self._subscriptions), *(x for _, x, _ in self._leaving)):
                subscription.destroy()

    def _round(self, limit: int = _BATCH) -> list[tuple[Any, list[Taken]]]:
        """
        Take once from each subscription.

        The first one is read last: if /clock was added first, every tick received before a message
        of this round is known when the message gets its timestamp.
        """
        now, known = time.monotonic(), [*self._subscriptions]
        # What is replaced from here on is read as the present one, and then as a replaced one.
        leaving = [*self._leaving]
        taken = []
        for key, subscription in reversed(known):
            messages = subscription.take(limit)
            # Read after the new one but delivered before it, so that each message that only one of
            # them has comes in its order.
            before = [(x, old.take(sys.maxsize)) for x, old, _ in leaving if x is key]
            taken += [(key, messages), *reversed(before)]
        for entry in leaving:
            if entry[2] < now:
                self._leaving.remove(entry)
                entry[1].destroy()
        return [x for x in reversed(taken) if x[1]]


class SimulatedTime:
    """
    Find the simulated time at which a message was received.

    The time of a message is that of the last ``/clock`` message received before it, by the
    timestamps of the middleware, however late either is taken. Of several publishers of
    ``/clock``, the first one is followed until it stops, because times that alternate between two
    simulations are useless. ``jumps`` counts backward jumps of time, ``ignored`` the messages of
    other publishers and those without a valid time.
    """

    def __init__(self) -> None:
        self._received: list[int] = []
        self._times: list[int] = []
        self._publisher = b''
        self.jumps = 0
        self.ignored = 0

    @property
    def started(self) -> bool:
        """Whether a ``/clock`` message has arrived."""
        return bool(self._times)

    def add(self, received_ns: int, time_ns: int, publisher: bytes = b'') -> int | None:
        """Add a ``/clock`` message (ns); return the previous time if time jumped back."""
        before = self._times[-1] if self._times else time_ns
        if self._times and publisher != self._publisher \
                and received_ns - self._received[-1] < _SILENCE_NS:
            self.ignored += 1
            return None
        self._publisher = publisher
        self._received.append(received_ns)
        self._times.append(time_ns)
        if len(self._times) > 100_000:
            del self._received[:50_000], self._times[:50_000]
        if time_ns < before:
            self.jumps += 1
            return before
        return None

    def at(self, received_ns: int) -> int:
        """Return the simulated time at a system time, in ns; the first one for earlier times."""
        return self._times[max(0, bisect_right(self._received, received_ns) - 1)]


@cache
def _function() -> Any:
    """Return rcl's function; calls through `ctypes.CDLL` release the global interpreter lock."""
    found = ctypes.CDLL('librcl.so').rcl_publish_serialized_message
    found.argtypes = [ctypes.c_void_p] * 3
    found.restype = ctypes.c_int
    return found


class FastPublisher:
    """
    Publish from one thread with a publisher of rclpy, while other threads run.

    rclpy holds the global interpreter lock while the middleware sends. A send that blocks, for
    example to a host that has disappeared, would block all threads, including the one that serves
    a coil.
    """

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._send = _function()
        self._buffer = Buffer()
        self._address = ctypes.byref(self._buffer)

    def publish(self, message: Any) -> None:
        """Publish a message, or bytes of a serialized one."""
        data = message if isinstance(message, bytes) else serialize_message(message)
        self._buffer.buffer = ctypes.cast(ctypes.c_char_p(data), ctypes.c_void_p).value
        self._buffer.length = self._buffer.capacity = len(data)
        handle = self._publisher.handle
        with handle:
            failed = self._send(handle.pointer, self._address, None)
        if failed:
            # rclpy raises an error with the reason.
            self._publisher.publish(data)
