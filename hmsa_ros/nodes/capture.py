"""
Taking raw messages off subscriptions, fast and with all that is known of each.

rclpy's own executors pass one message at a time and do not tell which publisher sent it. Here
a thread of its own looks at several subscriptions and takes whatever has arrived in one go, with
the publisher's identifier, so that a gap in its sequence numbers is a lost message.
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
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.type_support import check_is_valid_msg_type

from hmsa_ros.errors import BadInputError

# Taken from one subscription before the next has its turn.
_BATCH = 2000
# The thread rests this long after messages have arrived, and if none have: at high rates many are
# taken at once. Stamps come from the middleware, so this does not blur them.
_REST_SECONDS, _IDLE_SECONDS = 0.001, 0.005
# A publisher of /clock that has been silent for so long gives way to another.
_SILENCE_NS = 1_000_000_000


class Taken(NamedTuple):
    """A message as received: stamps in ns, sequence number, publisher's identifier, payload."""

    source_ns: int
    received_ns: int
    sequence: int
    publisher: bytes
    data: bytes


def decode(data: bytes, message_type: type[Any]) -> Any:
    """
    Return the message of a class that a payload holds.

    Raises
    ------
    BadInputError
        If it holds none.

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
    """rmw_message_info_t of Jazzy."""

    _fields_ = [
        ('source', ctypes.c_int64), ('received', ctypes.c_int64),
        ('sequence', ctypes.c_uint64), ('reception_sequence', ctypes.c_uint64),
        ('implementation', ctypes.c_char_p), ('publisher', ctypes.c_ubyte * 16),
        ('from_intra_process', ctypes.c_bool),
        # Room for what a later distribution may add at the end.
        ('_reserve', ctypes.c_ubyte * 64)]


class _Taker:
    """
    Takes serialized messages by rcl's own function.

    rclpy's binding leaves out the publisher's identifier, without which gaps cannot be told
    where several publishers share a topic. The interpreter lock is kept: a take lasts about a
    microsecond, giving the lock away and getting it back much longer.
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
        """Take up to some number of messages off the subscription at an address."""
        result: list[Taken] = []
        take, string_at, array, info = self._take, ctypes.string_at, self._array, self._info
        array_at, info_at = ctypes.addressof(array), ctypes.addressof(info)
        while len(result) < limit and take(pointer, array_at, info_at, None) == 0:
            result.append(Taken(
                info.source, info.received, info.sequence, bytes(info.publisher),
                string_at(array.buffer, array.length)))
        return result


_taker = cache(_Taker)


class RawSubscription:
    """A subscription that belongs to no executor and is read by ``take``."""

    def __init__(
            self, node: Node, message_type: type[Any], topic: str, qos: QoSProfile) -> None:
        check_is_valid_msg_type(message_type)
        with node.handle:
            self.handle = _rclpy.Subscription(
                node.handle, message_type, topic, qos.get_c_qos_profile())

    def take(self, limit: int = _BATCH) -> list[Taken]:
        """Take at most ``limit`` messages in order of arrival; none if there are none."""
        try:
            with self.handle:
                return _taker().take(self.handle.pointer, limit)
        except InvalidHandle:
            return []

    @property
    def matched(self) -> bool:
        """Whether it has found a publisher, whose messages it receives from then on."""
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
    A thread that takes messages off subscriptions and passes them on in batches.

    ``deliver`` gets a list of (key, messages) a round, in the order of the subscriptions.
    """

    def __init__(self, deliver: Callable[[Sequence[tuple[Any, list[Taken]]]], None]) -> None:
        self._deliver = deliver
        self._subscriptions: list[tuple[Any, RawSubscription]] = []
        self._leaving: list[tuple[Any, RawSubscription]] = []
        self._stopping = False
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='capture', daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def add(self, key: Any, subscription: RawSubscription) -> None:
        """Take over a subscription: read it, pass its messages on with the key, destroy it."""
        self._subscriptions.append((key, subscription))

    def replace(self, key: Any, subscription: RawSubscription) -> None:
        """Read another subscription under a known key; what the old one holds is passed on."""
        for i, (known, old) in enumerate(self._subscriptions):
            if known is key:
                self._subscriptions[i] = key, subscription
                self._leaving.append((key, old))

    def matched(self) -> list[Any]:
        """Return the keys of the subscriptions that have found a publisher."""
        return [key for key, x in self._subscriptions if x.matched]

    def take_again(self) -> list[tuple[Any, list[Taken]]]:
        """Take all that has arrived since this round was taken; for ``deliver`` alone."""
        return self._round(sys.maxsize)

    def stop(self) -> None:
        """Pass on what has arrived so far and end the thread."""
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
            for _, subscription in self._subscriptions:
                subscription.destroy()

    def _round(self, limit: int = _BATCH) -> list[tuple[Any, list[Taken]]]:
        """
        Take once from each subscription.

        The first is taken last: with /clock added first, every tick that came before a message
        of this round is known when the message is stamped.
        """
        taken = [(key, x.take(limit)) for key, x in reversed([*self._subscriptions])]
        while self._leaving:
            key, old = self._leaving.pop()
            taken.append((key, old.take(sys.maxsize)))
            old.destroy()
        return [x for x in reversed(taken) if x[1]]


class SimulatedTime:
    """
    Finds the simulated time at which a message was received.

    The time of a message is that of the last ``/clock`` message received before it, by the
    stamps of the middleware, however late either is taken. Of several publishers of ``/clock``
    the first one is followed until it falls silent: a time that goes to and fro between two
    simulations is none. ``jumps`` counts how often time has jumped back, ``ignored`` the messages
    of other publishers, and such as tell no time.
    """

    def __init__(self) -> None:
        self._received: list[int] = []
        self._times: list[int] = []
        self._publisher = b''
        self.jumps = 0
        self.ignored = 0

    @property
    def started(self) -> bool:
        """Return whether a ``/clock`` message has come."""
        return bool(self._times)

    def add(self, received_ns: int, time_ns: int, publisher: bytes = b'') -> int | None:
        """Take in a ``/clock`` message (ns); return the time before if time jumped back."""
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
        """Return the simulated time at a system time, in ns; before the first, the first."""
        return self._times[max(0, bisect_right(self._received, received_ns) - 1)]
