"""The report's page in a real browser: plots, clicks, phones and dark mode."""

from dataclasses import replace
import json

from browser import Browser, find_browser, NAMES
import numpy as np
import pytest
from test_report import ACTUATOR, applied, parameters, parts_of, simulated, write

from hmsa.model.units import NANOSECONDS
from hmsa.report.comparison import Part
from hmsa.report.page import page
from hmsa.runs.bags import read_runs

pytestmark = pytest.mark.skipif(
    find_browser() is None,
    reason=f'the page was NOT tried in a browser: none of {", ".join(NAMES)} is installed')

FIGURES = {'response', 'phase', 'arrival0', 'arrival1', 'arrival2', 'residuals'}
#: Draws what is far below, too, which otherwise waits until it comes near.
DRAW_ALL = 'window.dispatchEvent(new Event("beforeprint"))'
# More data than that is no page for a phone.
LARGEST_PAGE = 5e6


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp('browser')) as opened:
        yield opened


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Return two bags of the paper's sequence, the second of a heavier block."""
    folder = tmp_path_factory.mktemp('bags')
    heavier = replace(ACTUATOR, density=2100.0)
    messages = simulated()
    return [
        write(folder / 'run', messages + applied(messages), **parameters(
            planner=ACTUATOR, plant=ACTUATOR)),
        write(folder / 'other', simulated(plant=heavier), **parameters(
            planner=ACTUATOR, plant=heavier))]


@pytest.fixture(scope='module')
def files(bags, tmp_path_factory):
    """Return the pages of one bag and of both."""
    folder = tmp_path_factory.mktemp('pages')
    for name, shown in (('one', bags[:1]), ('both', bags)):
        (folder / f'{name}.html').write_text(page(parts_of(*shown)), encoding='utf-8')
    return folder


def drawn(opened):
    """Draw all figures, and return the keys of those with visible curves."""
    opened.evaluate(DRAW_ALL)
    return set(opened.evaluate(
        '[...document.querySelectorAll(".plot")].filter(x => [...x.querySelectorAll(".curve")]'
        '.some(y => y.getBBox().width + y.getBBox().height > 0)).map(x => x.id)'))


def limits(opened, figure='response'):
    """Return the ticks of a figure as text."""
    return opened.evaluate(
        f'[...document.querySelectorAll("#{figure} .area text:not(.label)")].map('
        'x => x.textContent)')


def place(opened, x, y, figure='response'):
    """Return a position in the window, by fractions of the area of a figure."""
    left, top, width, height = opened.evaluate(
        f'(() => {{ const area = document.querySelector("#{figure} .area");'
        'area.scrollIntoView({block: "center"}); const box = area.getBoundingClientRect();'
        'return [box.x, box.y, box.width, box.height]; })()')
    return left + x * width, top + y * height


def mouse(opened, kind, x, y, **more):
    """Move, press or release the left button."""
    opened.call('Input.dispatchMouseEvent', type=f'mouse{kind}', x=x, y=y, **{
        'button': 'left', 'buttons': 1, 'clickCount': 1, **more})


@pytest.mark.slow
@pytest.mark.parametrize('name', ['one', 'both'])
def test_every_plot_is_drawn_without_a_complaint_or_a_request(browser, files, name):
    opened = browser.open(files / f'{name}.html')
    # The second differs from its plan.
    assert drawn(opened) == FIGURES | ({'deviation'} if name == 'both' else set())
    assert opened.complaints == []
    assert opened.evaluate('document.querySelectorAll("table").length') >= 6


def test_a_complaint_would_be_seen(browser, tmp_path):
    (tmp_path / 'bad.html').write_text(
        '<title>x</title><img src="http://example.invalid/x.png"><script>nothing()</script>')
    opened = browser.open(tmp_path / 'bad.html')
    found = ' '.join(map(str, opened.complaints))
    assert 'nothing is not defined' in found
    assert 'http://example.invalid/x.png' in found


@pytest.mark.slow
def test_a_click_in_the_legend_hides_a_curve(browser, files):
    opened = browser.open(files / 'one.html')
    drawn(opened)
    shown = ('[...document.querySelectorAll("#response .curve")].map(x => x.dataset.name)'
             '.includes("unshaped steps")')
    assert opened.evaluate(shown) is True
    x, y = opened.evaluate(
        '(() => { const one = [...document.querySelectorAll("#response .entry")].find('
        'x => x.textContent === "unshaped steps"); one.scrollIntoView({block: "center"});'
        'const box = one.getBoundingClientRect();'
        'return [box.x + box.width / 2, box.y + box.height / 2]; })()')
    opened.click(x, y)
    opened.wait_for(f'!{shown}')
    assert opened.evaluate(shown.replace('unshaped steps', 'simulated')) is True


@pytest.mark.slow
def test_a_frame_zooms_shift_moves_a_double_click_goes_back_and_values_are_read(browser, files):
    opened = browser.open(files / 'one.html')
    drawn(opened)
    first = limits(opened)
    x, y = place(opened, 0.5, 0.6)
    mouse(opened, 'Moved', x, y, button='none', buttons=0)
    tip = opened.wait_for('!document.querySelector("#response .tip").hidden'
                          ' && document.querySelector("#response .tip").innerText')
    # The second target is held there.
    values = dict(line.split(': ') for line in tip.strip().split('\n'))
    assert 43.0 < float(values['time t (ms)']) < 87.0
    assert float(values['target']) == 1.2
    assert float(values['simulated']) == pytest.approx(1.2, abs=1e-4)
    ticks = ('[...document.querySelectorAll("#response .area text:not(.label)")]'
             '.map(x => x.textContent).join()')

    def changes(before):
        opened.wait_for(f'{ticks} !== {json.dumps(",".join(before))}')
        return limits(opened)

    mouse(opened, 'Pressed', x, y)
    mouse(opened, 'Moved', x + 200, y + 80)
    mouse(opened, 'Released', x + 200, y + 80)
    zoomed = changes(first)
    mouse(opened, 'Pressed', x, y, modifiers=8)
    mouse(opened, 'Moved', x - 300, y, modifiers=8)
    mouse(opened, 'Released', x - 300, y, modifiers=8)
    assert changes(zoomed) != first
    opened.click(x, y, count=2)
    opened.wait_for(f'{ticks} === {json.dumps(",".join(first))}')
    assert opened.complaints == []


@pytest.mark.slow
@pytest.mark.parametrize('width', [390, 1280])
def test_labels_and_legend_do_not_lie_over_each_other_and_no_deciding_column_is_cut(
        browser, files, width):
    opened = browser.open(files / 'one.html', width=width, mobile=width < 600)
    drawn(opened)
    for figure in opened.evaluate("""[...document.querySelectorAll(".plot")].map(figure =>
        [...figure.querySelectorAll(".area text, .bar > div")].map(x => {
          const box = x.getBoundingClientRect();
          return [x.textContent, box.left, box.top, box.right, box.bottom]; }))"""):
        for i, (name, *a) in enumerate(figure):
            for other, *b in figure[:i]:
                apart = (a[2] <= b[0] + 1 or b[2] <= a[0] + 1
                         or a[3] <= b[1] + 3 or b[3] <= a[1] + 3)
                assert apart, (name, a, other, b)
    needed, room = opened.evaluate(
        '(() => { const x = document.getElementById("setpoint-table").parentElement;'
        'return [x.scrollWidth, x.clientWidth]; })()')
    assert needed <= room
    opened.evaluate('document.querySelector("[data-columns=setpoint-table]").click()')
    assert opened.evaluate('[...document.querySelectorAll("#setpoint-table th")].every('
                           'x => x.getBoundingClientRect().width > 0)')


@pytest.mark.slow
@pytest.mark.parametrize('dark', [False, True])
def test_a_phone_shows_the_page_in_its_width_and_the_dark_is_dark(browser, files, dark):
    opened = browser.open(files / 'one.html', width=390, height=844, dark=dark, mobile=True)
    assert drawn(opened) == FIGURES
    # What is wider scrolls by itself.
    assert opened.evaluate('document.documentElement.scrollWidth') <= 390
    assert all(x <= 390 for x in opened.evaluate(
        '[...document.querySelectorAll(".plot .area")].map(x => '
        'x.getBoundingClientRect().right)'))
    page_colour, text, curve = (
        [int(x) for x in opened.evaluate(f'{what}.match(/\\d+/g).slice(0, 3)')] for what in (
            'getComputedStyle(document.body).backgroundColor',
            'getComputedStyle(document.querySelector("#response .label")).fill',
            'getComputedStyle(document.querySelector("#response [data-name=simulated]")).stroke'))
    assert (sum(page_colour) < 200) == dark
    assert (sum(text) > 500) == dark
    assert abs(sum(curve) - sum(page_colour)) > 200
    assert opened.complaints == []


@pytest.mark.slow
def test_a_change_of_light_while_the_page_is_open_is_followed(browser, files):
    opened = browser.open(files / 'one.html')
    drawn(opened)
    colour = 'getComputedStyle(document.querySelector("#response .label")).fill'
    before = opened.evaluate(colour)
    opened.call('Emulation.setEmulatedMedia', features=[
        {'name': 'prefers-color-scheme', 'value': 'dark'}])
    opened.wait_for(f'{colour} !== "{before}"')
    assert opened.complaints == []


@pytest.mark.slow
def test_a_table_is_copied_in_full_precision(browser, files):
    opened = browser.open(files / 'one.html')
    copied = opened.evaluate(
        '(async () => { let text = ""; '
        'Object.defineProperty(navigator, "clipboard", {value: {writeText: async x => '
        '{ text = x; }}});'
        'document.querySelector("button[data-table=setpoint-table]").click();'
        'await new Promise(x => setTimeout(x, 50)); return text; })()')
    rows = [x.split('\t') for x in copied.split('\n')]
    setpoint = dict(zip(rows[0], rows[1], strict=True))
    assert len(rows) == 4
    assert len(setpoint['b_p [1]']) > 12
    assert float(setpoint['target λ [1]']) == 1.1


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ten_minutes_at_1_khz_keep_their_peaks_on_a_page_that_opens(browser, bags, tmp_path):
    run, = read_runs(bags[0])
    count = 600_000
    time = run.time[0] + np.arange(count) * (NANOSECONDS // 1000)
    stretch = np.interp(time, run.time, run.stretch)
    stretch[123_456], stretch[432_100] = 1.9, 0.7
    ten_minutes = replace(
        run, time=time, logged=time + 1000, stretch=stretch, rate=np.gradient(stretch, 1e-3),
        flux_density=np.interp(time, run.time, run.flux_density))
    text = page([Part.of(ten_minutes)])
    assert len(text) < LARGEST_PAGE
    (tmp_path / 'long.html').write_text(text, encoding='utf-8')
    opened = browser.open(tmp_path / 'long.html')
    drawn(opened)
    low, high = opened.evaluate(
        '(() => { const curve = JSON.parse(document.getElementById("report-data").textContent)[0]'
        '.panels[1].curves.find(x => x.name === "simulated");'
        'return [Math.min(...curve.y), Math.max(...curve.y)]; })()')
    assert (low, high) == (0.7, 1.9)
    assert opened.complaints == []
