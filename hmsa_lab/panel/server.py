"""
The panel's server: a page and its socket, on this host, for holders of the address.

It only answers requests whose address contains the token and whose ``Host`` is its own, which
excludes foreign names that resolve to this host (DNS rebinding). A socket must also have its own
``Origin``, which excludes other pages in the same browser.
"""

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from hmac import compare_digest
import json
import logging
from pathlib import Path
from queue import Full, Queue
from secrets import token_urlsafe
import socket
import threading
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from hmsa.errors import BadInputError, check_number

_HERE = Path(__file__).parent
_ADDRESS = '127.0.0.1'
_FILES = {
    '': ('index.html', 'text/html'), 'panel.css': ('panel.css', 'text/css'),
    'panel.js': ('panel.js', 'text/javascript')}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
    "connect-src 'self' ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'")
# A report contains scripts and comes from a bag, so it gets neither origin nor network access.
_REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; frame-ancestors 'none'")
_HEADERS = {
    'Cache-Control': 'no-store', 'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff', 'Cross-Origin-Opener-Policy': 'same-origin',
    'Cross-Origin-Resource-Policy': 'same-origin', 'Server': 'hmsa'}
# Maximum length of a page's message in bytes, and number of waiting commands.
_LONGEST, _MOST = 4096, 64
# Polling interval for a new frame, and timeout for a page without answer, in s.
_LOOK, _PING = 0.01, 3.0


class Server:
    """
    A server in a separate thread; a context manager.

    ``frame`` is the text sent to the pages when it changes. ``reports`` contains the reports of
    recordings by name. Commands of the pages wait in ``commands``, except that ``stop`` and
    ``coil_off`` are set immediately.

    Parameters
    ----------
    port : int
        0 to 65535; 0 for a free one.

    Raises
    ------
    BadInputError
        If the port cannot be used.

    """

    def __init__(self, port: int = 0) -> None:
        for name in ('access', 'general'):
            # Refused requests are not logged.
            logging.getLogger(f'tornado.{name}').addHandler(logging.NullHandler())
        check_number('port', port, least=0, most=65535)
        try:
            self._socket = socket.create_server((_ADDRESS, port))
        except OSError as error:
            raise BadInputError(
                f'cannot listen on port {port} of {_ADDRESS} ({error.strerror}): expected a free '
                'port; --port 0 takes one') from error
        self.host = f'{_ADDRESS}:{self._socket.getsockname()[1]}'
        self.token = token_urlsafe(32)
        self.frame = ''
        self.reports: dict[str, Path] = {}
        self.commands: Queue[Mapping[str, Any]] = Queue(_MOST)
        self.stop, self.coil_off = threading.Event(), threading.Event()
        #: Open pages.
        self.pages: set[object] = set()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=asyncio.run, args=(self._serve(),), daemon=True)

    @property
    def address(self) -> str:
        """Secret address of the page."""
        return f'http://{self.host}/{self.token}/'

    def __enter__(self) -> 'Server':
        self._thread.start()
        self._ready.wait()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    async def _serve(self) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        ours = {'server': self}
        server = HTTPServer(
            Application(
                [('/([^/]+)/socket', _Socket, ours),
                 ('/([^/]+)/report/(.+)', _ReportHandler, ours),
                 ('/([^/]+)/([^/]*)', _Page, ours)],
                default_handler_class=_Guarded, default_handler_args=ours,
                log_function=lambda _: None, websocket_max_message_size=_LONGEST,
                websocket_ping_interval=_PING, websocket_ping_timeout=_PING),
            max_body_size=_LONGEST, idle_connection_timeout=60.0)
        self._socket.setblocking(False)
        server.add_socket(self._socket)
        self._ready.set()
        await self._end.wait()
        server.stop()
        await server.close_all_connections()

    def take(self, message: str | bytes) -> None:
        """Accept a message of a page; ignore invalid commands."""
        with suppress(ValueError, RecursionError, Full):
            command = json.loads(message)
            if isinstance(command, dict):
                match command.get('do'):
                    case 'stop':
                        self.stop.set()
                    case 'coil_off':
                        self.coil_off.set()
                    case _:
                        self.commands.put_nowait(command)


class _Guarded(RequestHandler):
    """Refuse requests without valid token, host and origin; serve no content itself."""

    origin_needed = False

    def initialize(self, server: Server) -> None:
        self.server = server

    def set_default_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.set_header(name, value)
        self.set_header('Content-Security-Policy', "default-src 'none'; frame-ancestors 'none'")

    def prepare(self) -> None:
        """Raise `HTTPError` unless token, host and origin are valid."""
        server, headers = self.server, self.request.headers
        token = self.path_args[0] if self.path_args else ''
        origins = headers.get_list('Origin')
        if headers.get_list('Host') != [server.host] or (
                not compare_digest(token.encode(), server.token.encode())) or (
                origins != [f'http://{server.host}'] and (origins or self.origin_needed)):
            raise HTTPError(403)

    def write_error(self, status_code: int, **_: Any) -> None:
        self.set_header('Content-Type', 'text/plain; charset=utf-8')
        self.finish(f'{status_code}: expected the address that hmsa panel printed\n')


class _Page(_Guarded):
    def get(self, _: str, name: str) -> None:
        """Send a file of the page; raise `HTTPError` if it does not exist."""
        if name not in _FILES:
            raise HTTPError(404)
        file, kind = _FILES[name]
        self.set_header('Content-Type', f'{kind}; charset=utf-8')
        self.set_header('Content-Security-Policy', _POLICY.format(host=self.server.host))
        self.finish((_HERE / file).read_bytes())


class _ReportHandler(_Guarded):
    def get(self, _: str, name: str) -> None:
        """Send a report; raise `HTTPError` if it does not exist."""
        path = self.server.reports.get(name)
        if path is None or not path.is_file():
            raise HTTPError(404)
        self.set_header('Content-Security-Policy', _REPORT_POLICY)
        self.finish(path.read_bytes())


class _Socket(_Guarded, WebSocketHandler):
    origin_needed = True

    def open(self, *_: str, **__: str) -> None:
        self.server.pages.add(self)
        self._feeding = asyncio.create_task(self._feed())

    async def _feed(self) -> None:
        """Send each new frame; a slow page only gets the newest one."""
        sent = ''
        with suppress(WebSocketClosedError):
            while True:
                if (frame := self.server.frame) is not sent:
                    await self.write_message(frame)
                    sent = frame
                await asyncio.sleep(_LOOK)

    def on_message(self, message: str | bytes) -> None:
        self.server.take(message)

    def on_close(self) -> None:
        self._feeding.cancel()
        self.server.pages.discard(self)
