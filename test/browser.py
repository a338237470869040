"""A headless Chromium, controlled through a pipe with its own protocol."""

from __future__ import annotations

import base64
import json
import os
from pathlib import Path
import select
import shutil
import subprocess
import sys
import time
from typing import Any

# The protocol uses file descriptors 3 and 4.
_LAUNCH = """
import os
import sys
# Copied out of the way first: either may be 3 or 4 itself.
ours = [os.dup2(int(x), 60 + i) for i, x in enumerate(sys.argv[1:3])]
os.dup2(ours[0], 3)
os.dup2(ours[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
# Limit of every wait: generous, since only failing tests reach it.
WAIT_SECONDS = 60.0


def find_browser() -> str | None:
    """Return the browser's path, None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser process; a context manager."""

    def __init__(self, folder: Path) -> None:
        program = find_browser()
        assert program is not None
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()
        self.process = subprocess.Popen(
            [sys.executable, '-c', _LAUNCH, str(theirs_in), str(theirs_out), program,
             '--headless=new', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
             '--hide-scrollbars', '--no-first-run', '--disable-extensions',
             '--disable-background-networking',
             '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1',
             f'--user-data-dir={folder / "profile"}', '--remote-debugging-pipe'],
            pass_fds=(theirs_in, theirs_out), stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out = ours_in, ours_out
        self._buffer = b''
        self._number = 0
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self._in)
        os.close(self._out)

    def call(self, method: str, session: str = '', **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        self._number += 1
        message: dict[str, Any] = {
            'id': self._number, 'method': method, 'params': parameters}
        if session:
            message['sessionId'] = session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        while (answer := self.receive()).get('id') != self._number:
            self.events.append(answer)
        assert 'error' not in answer, answer
        result: dict[str, Any] = answer['result']
        return result

    def receive(self) -> dict[str, Any]:
        """Return the next message of the browser."""
        end = time.monotonic() + WAIT_SECONDS
        while b'\0' not in self._buffer:
            assert select.select([self._in], [], [], end - time.monotonic())[0], 'it is silent'
            data = os.read(self._in, 1 << 20)
            assert data, 'the browser has ended'
            self._buffer += data
        message, _, self._buffer = self._buffer.partition(b'\0')
        received: dict[str, Any] = json.loads(message)
        return received

    def open(
            self, path: Path | str, *, width: int = 1280, height: int = 900, dark: bool = False,
            mobile: bool = False) -> Page:
        """Open a file or an address of this host, and wait until it is loaded."""
        return Page(self, path, width, height, dark, mobile)


class Page:
    """A page in a separate tab."""

    def __init__(
            self, browser: Browser, path: Path | str, width: int, height: int, dark: bool,
            mobile: bool) -> None:
        self._browser = browser
        target = browser.call('Target.createTarget', url='about:blank')['targetId']
        self._session = browser.call(
            'Target.attachToTarget', targetId=target, flatten=True)['sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.call(f'{domain}.enable')
        self.call(
            'Emulation.setDeviceMetricsOverride', width=width, height=height,
            deviceScaleFactor=1, mobile=mobile)
        self.call('Emulation.setTouchEmulationEnabled', enabled=mobile)
        self.call('Emulation.setEmulatedMedia', features=[
            {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'},
            {'name': 'pointer', 'value': 'coarse' if mobile else 'fine'}])
        url = path if isinstance(path, str) else path.resolve().as_uri()
        # Permitted requests: those to the server of the page, if any.
        self._own = ('file:', 'data:', 'blob:', *(
            [url, url.replace('http:', 'ws:')] if isinstance(path, str) else []))
        self.call('Page.navigate', url=url)
        self.wait_for("location.href !== 'about:blank' && document.readyState === 'complete'")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol on this page."""
        return self._browser.call(method, self._session, **parameters)

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression, or of its promise."""
        result = self.call(
            'Runtime.evaluate', expression=expression, returnByValue=True, awaitPromise=True)
        assert 'exceptionDetails' not in result, result
        return result['result'].get('value')

    def wait_for(self, expression: str) -> Any:
        """Wait until an expression is true, and return its value."""
        end = time.monotonic() + WAIT_SECONDS
        while not (value := self.evaluate(f'Boolean({expression}) && ({expression})')):
            assert time.monotonic() < end, expression
        return value

    def click(self, x: float, y: float, count: int = 1) -> None:
        """Click with the left button."""
        for kind in ('mouseMoved', 'mousePressed', 'mouseReleased'):
            self.call(
                'Input.dispatchMouseEvent', type=kind, x=x, y=y,
                button='none' if kind == 'mouseMoved' else 'left', clickCount=count)

    def screenshot(self, path: Path, *, whole: bool = False) -> None:
        """Write a screenshot of the visible part, or of the whole page."""
        data = self.call('Page.captureScreenshot', captureBeyondViewport=whole)['data']
        path.write_bytes(base64.b64decode(data))

    @property
    def complaints(self) -> list[Any]:
        """Return the errors reported by the page, and its network requests."""
        found = []
        for event in self._browser.events:
            if event.get('sessionId') != self._session:
                continue
            method, what = event['method'], event['params']
            if method == 'Runtime.exceptionThrown':
                found.append(what['exceptionDetails'])
            elif method == 'Runtime.consoleAPICalled' and what['type'] in ('error', 'warning'):
                found.append(what['args'])
            elif method == 'Log.entryAdded' and what['entry']['level'] in ('error', 'warning'):
                found.append(what['entry'])
            elif method == 'Network.requestWillBeSent' and not what['request'][
                    'url'].startswith(self._own):
                found.append(what['request']['url'])
        return found
