"""The report's page in a real browser: plots, clicks, phones and dark mode."""

from dataclasses import replace

from browser import Browser, find_browser, NAMES
import numpy as np
import pytest
from test_report import ACTUATOR, applied, parameters, parts_of, simulated, write

from hmsa.model.units import NANOSECONDS
from hmsa.report.arrivals import Part, timing
from hmsa.report.evaluation import evaluate
from hmsa.report.page import page
from hmsa.runs.bags import read_runs

pytestmark = pytest.mark.skipif(
    find_browser() is None,
    reason=f'the page was NOT tried in a browser: none of {", ".join(NAMES)} is installed')

FIGURES = {
    'response', 'phase', 'arrival0', 'arrival1', 'arrival2', 'residuals', 'prediction', 'timing'}
#: Draws what is far below, too, which otherwise waits until it comes near.
DRAW_ALL = 'window.dispatchEvent(new Event("beforeprint"))'
# More data than that is no page for a phone.
LARGEST_PAGE = 12e6


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
    opened.wait_for(
        '[...document.querySelectorAll(".plot")].every(x => x.querySelector(".main-svg"))')
    return set(opened.evaluate(
        '[...document.querySelectorAll(".plot")].filter(x => [...x.querySelectorAll('
        '".scatterlayer .trace path")].some(y => y.getBBox().width + y.getBBox().height > 0))'
        '.map(x => x.id)'))


@pytest.mark.slow
@pytest.mark.parametrize('name', ['one', 'both'])
def test_every_plot_is_drawn_without_a_complaint_or_a_request(browser, files, name):
    opened = browser.open(files / f'{name}.html')
    assert drawn(opened) == FIGURES
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

    def shown(name):
        return opened.evaluate(
            f'document.getElementById("response")._fullData.find(x => x.name === "{name}")'
            '.visible')

    assert shown('unshaped steps') is True
    x, y = opened.evaluate(
        '(() => { const texts = [...document.querySelectorAll("#response .legend .traces")];'
        'const one = texts.find(x => x.textContent === "unshaped steps");'
        'one.scrollIntoView({block: "center"});'
        'const box = one.querySelector(".legendtoggle").getBoundingClientRect();'
        'return [box.x + box.width / 2, box.y + box.height / 2]; })()')
    opened.click(x, y)
    opened.wait_for(
        'document.getElementById("response")._fullData.some('
        'x => x.name === "unshaped steps" && x.visible === "legendonly")')
    assert shown('recorded') is True


@pytest.mark.slow
@pytest.mark.parametrize('name', ['one', 'both'])
def test_toolbar_legend_and_curves_do_not_lie_over_each_other(browser, files, name):
    opened = browser.open(files / f'{name}.html')
    drawn(opened)
    boxes = opened.evaluate(
        """[...document.querySelectorAll(".plot")].map(figure => Object.fromEntries(
        [["bar", ".modebar"], ["legend", ".legend"], ["title", ".xtitle"],
         ["curves", ".nsewdrag"]].map(([name, where]) => {
          const all = [...figure.querySelectorAll(where)].map(x => x.getBoundingClientRect());
          return [name, [
            Math.min(...all.map(x => x.left)), Math.min(...all.map(x => x.top)),
            Math.max(...all.map(x => x.right)), Math.max(...all.map(x => x.bottom))]];
        })))""")
    assert len(boxes) == len(FIGURES)
    # Panels of arrivals of several runs have one key together.
    without = sum(x['legend'][0] is None for x in boxes)
    assert without == (3 if name == 'both' else 0)
    for box in boxes:
        if box['legend'][0] is None:
            box['legend'] = box['bar']
        for one, other in (('bar', 'legend'), ('bar', 'curves'), ('legend', 'title'),
                           ('legend', 'curves')):
            a, b = box[one], box[other]
            if a is b:
                continue
            apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] + 1 or b[3] <= a[1] + 1
            assert apart, (one, a, other, b)


@pytest.mark.slow
@pytest.mark.parametrize('dark', [False, True])
def test_a_phone_shows_the_page_in_its_width_and_the_dark_is_dark(browser, files, dark):
    opened = browser.open(files / 'one.html', width=390, height=844, dark=dark, mobile=True)
    assert drawn(opened) == FIGURES
    # What is wider scrolls by itself.
    assert opened.evaluate('document.documentElement.scrollWidth') <= 390
    assert all(x <= 390 for x in opened.evaluate(
        '[...document.querySelectorAll(".plot .main-svg")].map(x => '
        'x.getBoundingClientRect().right)'))
    page_colour, text, curve = (
        [int(x) for x in opened.evaluate(f'{what}.match(/\\d+/g).slice(0, 3)')] for what in (
            'getComputedStyle(document.body).backgroundColor',
            'getComputedStyle(document.querySelector("#response .xtitle")).fill',
            'getComputedStyle(document.querySelector("#response .js-line")).stroke'))
    assert (sum(page_colour) < 200) == dark
    assert (sum(text) > 500) == dark
    assert abs(sum(curve) - sum(page_colour)) > 200
    assert opened.complaints == []


@pytest.mark.slow
def test_a_change_of_light_while_the_page_is_open_is_followed(browser, files):
    opened = browser.open(files / 'one.html')
    drawn(opened)
    colour = 'getComputedStyle(document.querySelector("#response .xtitle")).fill'
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
    text = page([Part(ten_minutes, evaluate(ten_minutes), timing(ten_minutes))])
    assert len(text) < LARGEST_PAGE
    (tmp_path / 'long.html').write_text(text, encoding='utf-8')
    opened = browser.open(tmp_path / 'long.html')
    drawn(opened)
    low, high = opened.evaluate(
        '(() => { const curve = document.getElementById("response")._fullData.find('
        'x => x.name === "recorded"); return [Math.min(...curve.y), Math.max(...curve.y)]; })()')
    assert (low, high) == (0.7, 1.9)
    assert opened.complaints == []
