"""
Publish without holding the global interpreter lock.

rclpy holds the lock while the middleware sends. A send that blocks, for example to a host that has
disappeared, would block all threads, including the one that serves a coil.
"""

import ctypes
from functools import cache
from typing import Any

from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message

from hmsa_ros.nodes.capture import Buffer


@cache
def _function() -> Any:
    """Return rcl's function; calls through `ctypes.CDLL` release the global interpreter lock."""
    found = ctypes.CDLL('librcl.so').rcl_publish_serialized_message
    found.argtypes = [ctypes.c_void_p] * 3
    found.restype = ctypes.c_int
    return found


class Outlet:
    """Publish from one thread with a publisher of rclpy, while other threads run."""

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
