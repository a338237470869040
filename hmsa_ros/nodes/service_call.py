"""A call of a service whose answer may be lost, without waiting."""

from time import monotonic
from typing import Any


class ServiceCall:
    """
    One request to a service, sent again while no answer comes.

    A server answers a client that it has just discovered before the way back is known to all: the
    answer is lost then, and its client would wait for ever. So a request must do no harm when it
    is carried out twice. An answer counts as lost after ``timeout`` in s; meanwhile the client's
    node must be served.
    """

    def __init__(self, client: Any, request: Any, timeout: float = 2.0) -> None:
        self._client = client
        self._request = request
        self._timeout = timeout
        self._futures: list[Any] = []
        self._sent = 0.0

    @property
    def ready(self) -> bool:
        """Whether there is a server."""
        return bool(self._client.service_is_ready())

    def answer(self) -> Any:
        """Return the response, or None as long as there is none; send what is due."""
        for future in self._futures:
            if future.done() and (response := future.result()) is not None:
                self._drop()
                return response
        if not self.ready:
            # Whoever was asked is gone: the next server is asked from the beginning.
            self._drop()
        elif not self._futures or monotonic() - self._sent > self._timeout:
            self._futures.append(self._client.call_async(self._request))
            self._sent = monotonic()
        return None

    def _drop(self) -> None:
        """Forget what was sent; `answer` begins anew."""
        for future in self._futures:
            self._client.remove_pending_request(future)
        self._futures.clear()
