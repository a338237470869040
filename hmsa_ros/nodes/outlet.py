"""
Publishing without Python's lock.

rclpy keeps the lock while the middleware sends. What hangs there, as a send to a host that is
gone may, would keep all threads waiting, also the one that looks after a coil.
"""

import ctypes
from functools import cache
from typing import Any

from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message

from hmsa_ros.nodes.capture import Buffer


@cache
def _function() -> Any:
    """Return rcl's own function; a call by `ctypes.CDLL` gives Python's lock away meanwhile."""
    found = ctypes.CDLL('librcl.so').rcl_publish_serialized_message
    found.argtypes = [ctypes.c_void_p] * 3
    found.restype = ctypes.c_int
    return found


class Outlet:
    """Publishes with a publisher of rclpy, from one thread, while others run."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._send = _function()
        self._buffer = Buffer()
        self._address = ctypes.byref(self._buffer)

    def publish(self, message: Any) -> None:
        """Publish a message, or bytes that are one already."""
        data = message if isinstance(message, bytes) else serialize_message(message)
        self._buffer.buffer = ctypes.cast(ctypes.c_char_p(data), ctypes.c_void_p).value
        self._buffer.length = self._buffer.capacity = len(data)
        handle = self._publisher.handle
        with handle:
            failed = self._send(handle.pointer, self._address, None)
        if failed:
            # rclpy's own way tells why.
            self._publisher.publish(data)
