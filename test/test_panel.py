"""The panel: access to its page, and its effects on real nodes through its socket."""

import asyncio
from http.client import HTTPConnection
import json
import re
import signal
import socket
import subprocess
import sys

from extras import needs
import pytest
from test_driver_node import TUTORIALS
from test_package_imports import BLOCKED, run

from hmsa.errors import BadInputError

websocket = needs('tornado.websocket')

from tornado.httpclient import HTTPError, HTTPRequest  # noqa: E402

from hmsa_lab.panel.server import Server  # noqa: E402

WAIT_SECONDS = 60.0
UPGRADE = {
    'Upgrade': 'websocket', 'Connection': 'Upgrade', 'Sec-WebSocket-Version': '13',
    'Sec-WebSocket-Key': 'AAAAAAAAAAAAAAAAAAAAAA=='}


@pytest.fixture(scope='module')
def server(tmp_path_factory):
    """Return a running server with one report."""
    report = tmp_path_factory.mktemp('report') / 'report.html'
    report.write_text('<title>a report</title><script>1</script>')
    with Server() as running:
        running.reports['one'] = report
        yield running


def ask(server, path, method='GET', host='', **headers):
    """Return status, headers and body of the response to a request with given headers."""
    connection = HTTPConnection(server.host, timeout=WAIT_SECONDS)
    connection.putrequest(method, path, skip_host=True)
    for value in (host or server.host).split('|'):
        connection.putheader('Host', value)
    for name, value in headers.items():
        connection.putheader(name.replace('_', '-'), value)
    connection.endheaders()
    answer = connection.getresponse()
    body = b'' if answer.status == 101 else answer.read()
    connection.close()
    return answer.status, answer.headers, body


@pytest.mark.parametrize(('path', 'kind', 'words'), [
    ('', 'text/html', b'hmsa panel'), ('panel.js', 'text/javascript', b"'use strict'"),
    ('panel.css', 'text/css', b':root'), ('report/one', 'text/html', b'a report')])
def test_who_knows_the_address_gets_the_page_and_nobody_may_read_frame_or_keep_it(
        server, path, kind, words):
    for headers in ({}, {'Origin': f'http://{server.host}'}):
        status, found, body = ask(server, f'/{server.token}/{path}', **headers)
        assert status == 200
        assert words in body
        assert found['Content-Type'].startswith(kind)
        assert found['Referrer-Policy'] == 'no-referrer'
        assert found['Cache-Control'] == 'no-store'
        assert found['Cross-Origin-Resource-Policy'] == 'same-origin'
        policy = found['Content-Security-Policy']
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert 'unsafe' not in policy or 'sandbox' in policy.split()[0]
        assert 'allow-same-origin' not in policy
        assert not [x for x in found if x.lower().startswith('access-control')]


def test_the_page_says_what_stop_leaves_on_and_what_the_emergency_stop_is(server):
    page = ask(server, f'/{server.token}/')[2].decode()
    assert 'Stop comes to rest without vibration; the field stays on.' in page
    assert 'id="coil"' in page
    script = ask(server, f'/{server.token}/panel.js')[2].decode()
    assert 'The emergency stop is the interlock of a driver (~/interlock)' in script
    assert 'Coil off opens the interlock of the driver' in script


def test_the_page_has_no_script_or_style_of_its_own_and_asks_nobody_else(server):
    page = ask(server, f'/{server.token}/')[2].decode()
    assert not re.search(r'\son\w+=|\sstyle=|<style|<script(?! src="panel\.js")|https?:', page)
    for name in ('panel.js', 'panel.css'):
        assert not re.search('https?:|@import', ask(server, f'/{server.token}/{name}')[2].decode())


ATTACKS = {
    'no token': ('/', {}), 'no token for a file': ('/panel.js', {}),
    'another token': (f'/{"x" * 43}/', {}), 'a part of it': ('/{part}/', {}),
    'no character of it': ('/%C3%A9/', {}), 'more than it': ('/{token}x/', {}),
    'the token as a query': ('/?token={token}', {}),
    'a source': ('/{token}/server.py', {}), 'above': ('/{token}/../server.py', {}),
    'above, encoded': ('/{token}/..%2fserver.py', {}),
    'a file as report': ('/{token}/report/..%2f..%2f..%2f..%2fetc%2fpasswd', {}),
    'another name of the host (DNS rebinding)': ('/{token}/', {'host': 'evil.example:{port}'}),
    'another name without a port': ('/{token}/', {'host': 'evil.example'}),
    'localhost, which can be a foreign name': ('/{token}/', {'host': 'localhost:{port}'}),
    'two names': ('/{token}/', {'host': '127.0.0.1:{port}|evil.example'}),
    'another port': ('/{token}/', {'host': '127.0.0.1:1'}),
    'a foreign page': ('/{token}/', {'Origin': 'http://evil.example'}),
    'a page of another port': ('/{token}/panel.js', {'Origin': 'http://127.0.0.1:1'}),
    'a sandboxed page or file': ('/{token}/', {'Origin': 'null'}),
    'a form (CSRF)': ('/{token}/', {'method': 'POST', 'Content_Length': '0'}),
    'a preflight': ('/{token}/', {
        'method': 'OPTIONS', 'Origin': 'http://evil.example',
        'Access_Control_Request_Method': 'POST'}),
    'an address as a proxy has it': ('http://evil.example/{token}/', {}),
}


@pytest.mark.parametrize(('attack', 'path'), [
    (name, path) for name, (where, _) in ATTACKS.items()
    for path in ['', 'socket'][:1 + where.endswith('/')]])
def test_nothing_is_given_to(server, attack, path):
    port = server.host.partition(':')[2]
    where, more = ATTACKS[attack]
    fill = {'token': server.token, 'part': server.token[:20], 'port': port}
    if path:
        where += path
        more = {'Origin': f'http://{server.host}', **UPGRADE, **more}
    status, headers, body = ask(
        server, where.format(**fill), **{x: y.format(**fill) for x, y in more.items()})
    assert 400 <= status < 500
    assert server.token.encode() not in body
    assert len(body) < 300
    assert not [x for x in headers if x.lower().startswith('access-control')]
    assert not server.pages


def test_a_socket_needs_an_origin_and_with_ours_it_opens(server, wait_until):
    path = f'/{server.token}/socket'
    assert ask(server, path, **UPGRADE)[0] == 403
    assert ask(server, path, Origin=f'http://{server.host}', **UPGRADE)[0] == 101
    wait_until(lambda: not server.pages, 'the socket to be noticed as closed')


def test_it_listens_on_the_loopback_address_only(server):
    port = int(server.host.partition(':')[2])
    others = {x[4][0] for x in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)}
    for address in (others | {'127.0.0.2'}) - {'127.0.0.1'}:
        with pytest.raises(OSError, match='refused'):
            socket.create_connection((address, port), timeout=WAIT_SECONDS)


def connect(address):
    """Connect to the socket of a page."""
    origin = re.match('http://[^/]+', address)[0]
    return websocket.websocket_connect(HTTPRequest(
        f'{address.replace("http", "ws", 1)}socket', headers={'Origin': origin}))


def test_garbage_is_passed_over_and_a_flood_does_not_keep_stop_waiting(server, wait_until):
    async def attack():
        page = await connect(server.address)
        for message in (
                '', '[]', '"stop"', '{"do":', '[' * 4000, '{"do":' + '9' * 4000 + '}', 'NaN', '\0',
                '{"do": ["stop"]}'):
            await page.write_message(message)
        await page.write_message(b'\xff\xfe', binary=True)
        for _ in range(200):
            await page.write_message('{"do": "send", "setpoints": "1.1:1"}')
        assert not server.stop.is_set()
        assert not server.coil_off.is_set()
        for word, event in (('stop', server.stop), ('coil_off', server.coil_off)):
            await page.write_message(json.dumps({'do': word}))
            while not event.is_set():
                await asyncio.sleep(0.01)
        await page.write_message('x' * 5000)
        assert await page.read_message() is None
        page.close()

    asyncio.run(asyncio.wait_for(attack(), WAIT_SECONDS))
    assert server.commands.full()
    server.stop.clear()
    server.coil_off.clear()
    wait_until(lambda: not server.pages)


def test_a_port_that_cannot_be_used_is_refused(server):
    port = int(server.host.partition(':')[2])
    for wrong, words in ((port, 'expected a free port'), (65536, '0 to 65535'), (-1, '0 to')):
        with pytest.raises(BadInputError, match=words):
            Server(wrong)


def test_no_option_has_it_listen_elsewhere():
    done = subprocess.run(
        [sys.executable, '-m', 'hmsa_ros', 'panel', '--host', '0.0.0.0'], capture_output=True,
        text=True, check=False)
    assert done.returncode == 2
    assert 'unrecognized arguments: --host' in done.stderr


def test_without_tornado_it_says_what_to_install():
    done = run(BLOCKED.format(blocked=('tornado',)) + """
from hmsa.cli import main
sys.exit(main(['panel']))
""")
    assert done.returncode == 2
    assert 'pip install tornado' in done.stderr


# With nodes -----------------------------------------------------------------------------------

@pytest.fixture
def panel(start, tmp_path):
    """Return a starter of a panel with planner and plant; it returns process and address."""
    def begin(*options):
        start.hmsa('plant')
        # Far ahead, so that a busy machine does not delay commands.
        start.hmsa('planner', '--ros-args', '-p', 'lead_time:=0.5')
        process = start.hmsa('panel', '--out', tmp_path / 'recordings', *options)
        return process, re.search(r'http\S+', process.wait_for_output('/\n'))[0]
    return begin


class Page:
    """A page without a browser."""

    def __init__(self, connection):
        self._connection = connection

    async def until(self, condition):
        """Return the first frame for which a condition is true."""
        while (message := await self._connection.read_message()) is not None:
            frame = json.loads(message, parse_constant=pytest.fail)
            if condition(frame):
                return frame
        pytest.fail('the socket was closed')

    async def state(self, *states, setpoint=None):
        """Return the first frame with one of these states, and setpoint."""
        return await self.until(lambda x: x['request'] and x['request']['state'] in states and (
            setpoint is None or x['request']['setpoint'] == setpoint))

    async def send(self, **command):
        await self._connection.write_message(json.dumps(command))

    async def close(self):
        self._connection.close()


async def opened(address):
    """Return a page that has discovered the planner and its stop service."""
    page = Page(await connect(address))
    await page.until(lambda x: x['request'] and x['joints'] and x['feedback'] == 'off')
    return page


def play(scenario):
    """Run a scenario to its end."""
    asyncio.run(asyncio.wait_for(scenario, 2.0 * WAIT_SECONDS))


@pytest.mark.slow
@pytest.mark.ros
def test_stop_and_a_closed_page_bring_what_the_panel_moves_to_rest(panel, start):
    process, address = panel()

    async def scenario():
        page = await opened(address)
        for words, reason in (
                ('', 'no setpoint'), ('1.1', 'STRETCH:DURATION'), ('nan:1', 'finite'),
                ('1,1,1:1', '3 stretches for actuator'), ('1.1:1e300', 'less than')):
            await page.send(do='send', setpoints=words)
            await page.until(lambda x, reason=reason: reason in x['note']['text'])
        await page.send(do='launch')
        await page.until(lambda x: 'unknown command' in x['note']['text'])
        # Stopped at once, while the request is on its way.
        await page.send(do='send', setpoints='1.1:600 1.2:600')
        await page.send(do='stop')
        # Whichever comes first: the request is dropped, or stopped.
        await page.until(lambda x: not x['stopping'] and x['note']['level'] == 'OK'
                         and not x['note']['text'].startswith('sent'))
        await page.state('idle', 'at_rest')
        # In the middle.
        await page.send(do='send', setpoints='1.1:600 1.2:600')
        await page.state('holding')
        await page.send(do='stop')
        seen = await page.state('at_rest')
        assert seen['request']['setpoints'] < 2
        # A page that is loaded again stops nothing, a closed one does.
        await page.send(do='send', setpoints='1.1:600 1.2:600')
        await page.state('holding')
        await page.close()
        page = await opened(address)
        seen = await page.state('holding', 'at_rest')
        assert seen['request']['state'] == 'holding'
        await page.close()
        await asyncio.sleep(3.0)
        page = await opened(address)
        seen = await page.until(lambda x: x['request']['state'] != 'holding')
        assert seen['note']['number'] > 0
        await page.state('at_rest')
        # What somebody else has sent is not the page's to stop.
        send = start.hmsa('send', '1.1:5', '1.2:1')
        await page.state('holding', setpoint=1)
        await page.close()
        await asyncio.sleep(2.0)
        page = await opened(address)
        await page.state('at_rest', setpoint=2)
        await page.close()
        assert send.wait() == 0

    play(scenario())
    assert process.stop(signal.SIGINT) == 0
    assert 'Traceback' not in process.output


@pytest.mark.slow
@pytest.mark.ros
def test_without_stop_on_close_a_sequence_goes_on_to_its_planned_rest(panel):
    process, address = panel('--no-stop-on-close')

    async def scenario():
        page = await opened(address)
        await page.send(do='send', setpoints='1.1:5 1.2:1')
        await page.state('moving', 'holding', setpoint=1)
        await page.close()
        await asyncio.sleep(2.0)
        page = await opened(address)
        seen = await page.state('at_rest', setpoint=2)
        assert seen['request']['setpoints'] == 2
        await page.close()
        with pytest.raises(HTTPError):
            await connect(f'{address}x/')

    play(scenario())
    assert process.stop(signal.SIGTERM) == 0


@pytest.mark.slow
@pytest.mark.ros
def test_coil_off_opens_the_interlock_of_a_driver_until_the_panel_closes_it(start, tmp_path):
    start.hmsa('driver', '--ros-args', '-p', 'hardware:=hardware:Bench',
               '-p', 'publish_rate:=500.0', PYTHONPATH=str(TUTORIALS))
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=0.5')
    process = start.hmsa('panel', '--out', tmp_path)
    address = re.search(r'http\S+', process.wait_for_output('/\n'))[0]

    def flux(frame):
        return frame['joints'][0]['flux_density'] if frame['joints'] else None

    async def scenario():
        page = await opened(address)
        await page.until(lambda x: x['interlock']['present'])
        await page.send(do='send', setpoints='1.1:600')
        await page.until(lambda x: x['request']['state'] == 'at_rest' and flux(x))
        # A stop holds the field; the interlock does not.
        await page.send(do='stop')
        await page.until(lambda x: x['stopping'])
        await page.until(lambda x: not x['stopping'])
        seen = await page.state('at_rest')
        assert flux(seen) > 0.0
        await page.send(do='coil_off')
        seen = await page.until(lambda x: flux(x) == 0.0)
        assert seen['interlock'] == {'present': True, 'closed': False}
        assert 'interlock opened' in seen['note']['text']
        await page.send(do='send', setpoints='1.1:1')
        await page.until(lambda x: x['request']['code'] == 'interlock')
        # The next panel can close what this one has left open.
        await page.close()

    play(scenario())
    assert process.stop(signal.SIGINT) == 0
    process = start.hmsa('panel', '--out', tmp_path)
    address = re.search(r'http\S+', process.wait_for_output('/\n'))[0]

    async def again():
        page = await opened(address)
        await page.until(lambda x: x['interlock']['present'])
        await page.send(do='send', setpoints='1.1:1')
        await page.until(lambda x: x['request']['code'] == 'interlock')
        await page.send(do='close_interlock')
        await page.until(lambda x: x['interlock']['closed'])
        while True:
            await page.send(do='send', setpoints='1.1:600')
            seen = await page.until(lambda x: x['note']['text'].startswith('sent'))
            # Refused for another second, at least.
            if seen['request']['code'] == 'accepted':
                break
            await asyncio.sleep(0.2)
        await page.until(flux)
        await page.close()

    play(again())
    assert process.stop(signal.SIGINT) == 0
