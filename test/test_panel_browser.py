"""The panel in a real browser, with real nodes: display, controls and protection."""

from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import re
import signal
import threading

from browser import Browser, find_browser, NAMES
from extras import needs
import pytest

needs('tornado')

from hmsa_lab.panel.server import Server  # noqa: E402

pytestmark = pytest.mark.skipif(
    find_browser() is None,
    reason=f'the panel was NOT tried in a browser: none of {", ".join(NAMES)} is installed')

WAIT_SECONDS = 60.0
# Of a page that has got hold of the address: what it can reach of the panel.
FOREIGN = """
(async address => {
  const load = (name, set) => new Promise(done => {
    const element = document.createElement(name);
    element.onload = () => done('loaded');
    element.onerror = () => done('refused');
    set(element);
    document.body.append(element);
  });
  const reach = {
    read: await fetch(address).then(x => x.text(), () => 'refused'),
    script: await load('script', x => { x.src = address + 'panel.js'; }),
    style: await load('link', x => { x.rel = 'stylesheet'; x.href = address + 'panel.css'; }),
    form: await fetch(address, {method: 'POST', mode: 'no-cors', body: 'stop'}).then(
      x => x.type, () => 'refused'),
    socket: await new Promise(done => {
      const socket = new WebSocket(address.replace('http', 'ws') + 'socket');
      socket.onopen = () => done('open');
      socket.onerror = () => done('refused');
    })};
  await load('iframe', x => { x.src = address; });
  try { reach.frame = frames[0].document.title; } catch { reach.frame = 'refused'; }
  return reach;
})
"""


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp('browser')) as opened:
        yield opened


def test_a_page_of_another_origin_reaches_nothing_even_with_the_address(browser, tmp_path):
    (tmp_path / 'index.html').write_text('<title>another</title><body>')
    with Server() as server, ThreadingHTTPServer(
            ('127.0.0.1', 0), partial(SimpleHTTPRequestHandler, directory=tmp_path)) as other:
        threading.Thread(target=other.serve_forever).start()
        page = browser.open(f'http://127.0.0.1:{other.server_port}/index.html')
        reach = page.evaluate(f'({FOREIGN})("{server.address}")')
        other.shutdown()
        assert not server.pages
        assert server.commands.empty()
        assert not server.stop.is_set()
    # Of what it posts it learns nothing: it is refused by the server.
    assert reach.pop('form') in ('opaque', 'refused')
    assert reach == dict.fromkeys(('read', 'script', 'style', 'socket', 'frame'), 'refused')


def press(page, selector):
    """Click in the middle of an element, as a user does."""
    page.wait_for(f'!document.querySelector("{selector}").disabled')
    x, y = page.evaluate(
        f'(() => {{ const one = document.querySelector("{selector}");'
        'one.scrollIntoView({block: "nearest"}); const box = one.getBoundingClientRect();'
        'return [box.x + box.width / 2, box.y + box.height / 2]; })()')
    page.click(x, y)


def enter(page, field, text):
    page.evaluate(f'document.querySelector("#{field}").value = "{text}"')


@pytest.mark.slow
@pytest.mark.ros
def test_an_actuator_is_driven_from_the_page(browser, start, tmp_path):
    start.hmsa('plant', '--ros-args', '-p', 'mismatch.shear_modulus:=1.1')
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=0.5')
    process = start.hmsa('panel', '--out', tmp_path / 'recordings')
    address = re.search(r'http\S+', process.wait_for_output('/\n'))[0]
    page = browser.open(address, width=1280, height=800)

    def shows(selector, text):
        page.wait_for(
            f'document.querySelector("{selector}")?.textContent.includes("{text}")')

    shows('#joints h2', 'actuator')
    shows('#joints [data-of=stretch]', '1.00000')
    page.wait_for('document.querySelector("[data-mode=off][aria-pressed=true]") !== null')
    # The target is refused, and said so.
    enter(page, 'stretch', '9')
    press(page, '#move button')
    shows('#level', 'ERROR')
    shows('#message', '9')
    enter(page, 'stretch', 'x')
    press(page, '#move button')
    shows('#note', 'expected STRETCH:DURATION')
    # Recorded, with feedback, whose words leave the buttons where they are.
    place = 'document.querySelector("#record").getBoundingClientRect().y + scrollY'
    before = page.evaluate(place)
    press(page, '[data-mode=observe]')
    page.wait_for('document.querySelector("[data-mode=observe][aria-pressed=true]") !== null')
    press(page, '#record')
    shows('#nodes', 'recorder: recording')
    press(page, '#examples button')
    press(page, '#sequence button')
    shows('#joints [data-of=target]', '1.10000')
    page.wait_for('Math.abs(Number(document.querySelector("dd[data-of=stretch]").textContent)'
                  ' - 1.09) < 0.005')
    page.wait_for('document.querySelectorAll("#estimates .bar circle[cx]").length >= 1')
    shows('#estimates', 'shear modulus')
    shows('#state', 'at rest, 2 of 2')
    assert page.evaluate(place) == before
    # Both charts have been drawn.
    assert page.evaluate(
        '[...document.querySelectorAll("canvas")].map(x => new Set(x.getContext("2d")'
        '.getImageData(0, 0, x.width, x.height).data).size > 10)') == [True, True]
    # Stop is in sight wherever the page is, and works while the report is made.
    enter(page, 'setpoints', '1.1:600 1.2:600')
    press(page, '#sequence button')
    shows('#state', 'holding, 1 of 2')
    press(page, '#record')
    shows('#recording', 'making the report')
    page.evaluate('scrollTo(0, document.body.scrollHeight)')
    press(page, '#stop')
    shows('#state', 'at rest')
    report = page.wait_for('document.querySelector("#reports a")?.href')
    assert page.complaints == []
    shown = browser.open(report)
    shown.wait_for('document.querySelectorAll("table").length >= 6')
    assert shown.evaluate('origin') == 'null'
    # On a phone and in the dark, nothing is wider than the page.
    for dark in (False, True):
        phone = browser.open(address, width=390, height=844, dark=dark, mobile=True)
        phone.wait_for('document.querySelector("#joints canvas") !== null')
        assert phone.evaluate('document.documentElement.scrollWidth') <= 390
        colour = phone.evaluate(
            'getComputedStyle(document.body).backgroundColor.match(/\\d+/g).slice(0, 3)')
        assert (sum(map(int, colour)) < 200) == dark
        box = phone.evaluate(
            '(() => { scrollTo(0, 1e5); const box = document.querySelector("#stop")'
            '.getBoundingClientRect(); return [box.top, box.bottom]; })()')
        assert 0 <= box[0] < box[1] <= 844
    # The end of the panel is seen.
    assert process.stop(signal.SIGINT) == 0
    phone.wait_for('document.querySelector("#note").textContent.includes("hmsa stop")')
