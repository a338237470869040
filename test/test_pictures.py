"""Figures: their size on paper, formats, colours and data, and the curves of a run."""

import csv
import importlib.util
from pathlib import Path
import re
from types import ModuleType

import matplotlib
from matplotlib.image import imread
import numpy as np
from PIL import Image
import pytest
from scipy.integrate import solve_ivp
from test_report import ACTUATOR, one, parameters, simulated

from hmsa import Actuator
from hmsa.errors import BadInputError
from hmsa.interfaces.topics import FLUX_DENSITY_COMMAND
from hmsa.report import style
from hmsa.report.charts import commanded, PANELS
from hmsa.report.comparison import Part
from hmsa.report.figures import decimate, through, TimeCurve
from hmsa.report.looks import case, CASES, KINDS, LineStyle, named, Paper, SHAPERS
from hmsa.report.picture import draw, draw_bands
from hmsa.table import percent
from hmsa_studies.pictures import label_of, worded

# What deuteranopia and protanopia leave of linear red, green and blue (Machado and others, IEEE
# Transactions on Visualization and Computer Graphics 15, 2009, full severity).
VISIONS = {
    'all': np.eye(3),
    'deuteranopia': np.array([
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881]]),
    'protanopia': np.array([
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998]])}
#: Differences of CIELAB that are seen at a glance on thin lines.
SEEN = 20.0
INCH = 25.4
#: Of shades from 0 to 255, mean and at a place, that a different release of the drawing library
#: and of the letters may cause in a picture that is seen from afar.
MEAN, PLACE, FEW = 1.0, 60.0, 2e-3
PERIOD = 1.2e-2
ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / 'docs' / 'images'


def cielab(colour: str, vision: np.ndarray) -> np.ndarray:
    """Return a colour as perceived with a type of vision."""
    rgb = np.array([int(colour[i:i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.array([
        [0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    ) @ np.clip(vision @ linear, 0.0, 1.0) / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize('vision', VISIONS)
@pytest.mark.parametrize('looks', [tuple(SHAPERS.values()), CASES], ids=['shapers', 'cases'])
def test_shapers_differ_in_colour_dash_and_marker_for_every_vision(
        looks: tuple[LineStyle, ...], vision: str) -> None:
    for part in ('colour', 'dash', 'marker'):
        assert len({getattr(x, part) for x in looks}) == len(looks)
    seen = [cielab(x.colour, VISIONS[vision]) for x in looks]
    assert min(np.linalg.norm(x - y) for i, x in enumerate(seen) for y in seen[:i]) > SEEN


def test_more_curves_than_colours_differ_in_dash_and_marker() -> None:
    more = [case(x) for x in range(24)]
    assert tuple(more[:len(CASES)]) == CASES
    for part in ('dash', 'marker'):
        assert len({(x.colour, getattr(x, part)) for x in more}) == len(more)


@pytest.mark.parametrize(('width', 'letters'), [(85.0, 7.0), (183.0, 9.0)])
def test_a_picture_is_as_wide_as_asked_in_every_format(
        width: float, letters: float, tmp_path: Path) -> None:
    paths = named(tmp_path, 'picture', KINDS)
    with style.picture(paths, 2.0, Paper(width, letters, 300.0)) as figure:
        axes = figure.add_subplot()
        axes.plot([0.0, 1.0], [0.0, 2.0], label='line', **style.SHAPED)
        style.finish(axes, style.axis('time', r'\tau'), style.axis('share', unit='%'), 'a')
        assert axes.xaxis.label.get_fontsize() == letters
    png, pdf, svg, pgf = paths
    assert imread(png).shape[1] == int(width / INCH * 300)
    box = re.search(rb'/MediaBox \[ ?0 0 ([\d.]+) ', pdf.read_bytes())
    assert box is not None
    assert float(box[1]) == pytest.approx(width / INCH * 72, abs=1e-3)
    drawn = svg.read_text(encoding='utf-8')
    assert float(re.findall(r'width="([\d.]+)pt"', drawn)[0]) == pytest.approx(
        width / INCH * 72, abs=1e-3)
    assert 'share' in drawn
    words = pgf.read_text(encoding='utf-8')
    assert rf'{{\pgfqpoint{{{width / INCH:.6f}in}}{{2.000000in}}}}' in words
    assert 'share (%)' in words
    assert words.count(r'\begin{pgfscope}') == words.count(r'\end{pgfscope}') > 10
    assert words.rstrip().endswith(r'\endgroup')


@pytest.mark.parametrize('numbers', [
    (30.0,), (85.0, 2.0), (85.0, 8.0, 5000.0), (float('nan'),), (85.0, 8.0, 600.0, False, 5.0)])
def test_paper_that_is_none_is_refused(numbers: tuple[float, ...]) -> None:
    with pytest.raises(BadInputError, match='of a picture is .* expected'):
        Paper(*numbers)


def test_what_is_below_what_is_resolved_is_said_to_be() -> None:
    assert [percent(x) for x in (7e-17, 9.9e-9, 2e-8, 0.0128, -0.5, float('nan'))] == [
        '<0.001', '<0.001', '<0.001', '1.3', '-50.0', '?']


def test_curves_of_a_sweep_are_named_by_symbols_and_axes_have_units_or_none() -> None:
    assert worded('j_lim 5, two_step') == r'$J_\mathrm{lim}$ = 5, two_step'
    assert worded('command_period 0.001, gent') == 'command period = 0.001 s, gent'
    assert worded('') == ''
    assert [label_of(x) for x in ('zeta', 'residual', 'actuator.density')] == [
        r'$\zeta$', 'residual vibration (% of step)', 'density (kg/m^3)']


def oscillation(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the approximate free motion of a nonlinear oscillator of period `PERIOD`."""
    rate = 2.0 * np.pi / PERIOD
    found = solve_ivp(
        lambda _, y: (y[1], -rate**2 * (y[0] - 1.1) * (1.0 + 0.5 * (y[0] - 1.1)) - 60.0 * y[1]),
        (0.0, times[-1]), (1.0, 0.0), t_eval=times, rtol=1e-10, atol=1e-12)
    return found.y[0], found.y[1]


def test_between_six_samples_a_period_the_curve_is_the_motion_and_no_polygon() -> None:
    time = np.arange(0.0, 0.05, PERIOD / 6.0)
    curve = through(TimeCurve(time, *oscillation(time)), PERIOD)
    truth, rate = oscillation(curve.time)
    error = np.max(np.abs(curve.stretch - truth))
    polygon = np.max(np.abs(np.interp(curve.time, time, oscillation(time)[0]) - truth))
    assert error < 0.12 * polygon
    assert np.max(np.abs(curve.rate - rate)) < 0.05 * np.max(np.abs(rate))
    # All samples are on it, and nothing is drawn where samples are missing.
    assert set(time) <= set(curve.time)
    gapped = through(TimeCurve(*(
        np.delete(x, [8, 9, 10, 11]) for x in (time, *oscillation(time)))), PERIOD)
    inside = (gapped.time > time[7]) & (gapped.time < time[12])
    assert np.isnan(gapped.stretch[inside]).all()
    assert np.isfinite(gapped.stretch[~inside]).all()
    shown = decimate(gapped.time, gapped.stretch)[1]
    assert np.count_nonzero(np.isnan(shown)) == 1


@pytest.mark.parametrize('repeated', [False, True])
def test_runs_that_agree_are_all_seen(tmp_path: Path, repeated: bool) -> None:
    run = one(tmp_path / 'one', simulated(), **parameters(planner=ACTUATOR, plant=ACTUATOR))
    path, paper = tmp_path / 'both.png', Paper(width=85.0, dpi=200.0)
    if repeated:
        draw_bands([path], {'first': [run], 'second': [run]}, paper)
    else:
        draw(path, [run, run], paper)
    shades = np.rint(255.0 * imread(path)[..., :3])
    for look in CASES[:2]:
        colour = [int(look.colour[i:i + 2], 16) for i in (1, 3, 5)]
        # More than its sample in the legend.
        assert np.count_nonzero(np.all(np.abs(shades - colour) < 8.0, axis=-1)) > 2000, look


def test_time_begins_at_the_first_level_of_the_run_and_its_step_is_drawn(tmp_path: Path) -> None:
    told = parameters(planner=ACTUATOR)
    messages = simulated(period=1_000_000)
    plain = one(tmp_path / 'plain', messages, **told)
    # A sign of life with the level that an earlier run has left.
    begin = min(x[0] for x in messages)
    first = min((x for x in messages if x[1].endswith(FLUX_DENSITY_COMMAND.name)),
                key=lambda x: x[0])
    early = type(first[3])(**vars(first[3]))
    early.header = type(early.header)(
        stamp=type(early.header.stamp)(sec=0, nanosec=0), frame_id=early.header.frame_id)
    early.header.stamp.sec, early.header.stamp.nanosec = divmod(begin - 2_000_000, 10**9)
    early.magnetic_field = type(early.magnetic_field)(x=0.0, y=0.0, z=0.0)
    later = one(tmp_path / 'later', [
        (begin - 1_000_000, first[1], first[2], early), *messages], **told)
    assert [x.stamp for x in later.evaluation.levels][1:] == [
        x.stamp for x in plain.evaluation.levels]
    assert later.evaluation.zero == plain.evaluation.zero == plain.evaluation.levels[0].stamp
    assert later.evaluation.results == plain.evaluation.results
    times, values = commanded(plain)
    assert times[0] < times[1] == 0.0
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert values[1] > 1.0
    assert all(x.arrival == pytest.approx(5.8e-3, rel=0.05) for x in plain.evaluation.results)
    # Twelve samples a period are drawn as points, with the motion between them.
    draw(tmp_path / 'run.png', [plain], Paper(85.0, dpi=100.0, data=True))
    with (tmp_path / 'run.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    panels = {
        curve: np.array([(float(x['x']), float(x['y'])) for x in rows
                         if (x['panel'], x['curve']) == ('b', curve)])
        for curve in ('samples', 'recorded', 'unshaped, simulated')}
    assert len(panels['recorded']) > 5 * len(panels['samples']) > 100
    assert len(panels['unshaped, simulated']) > 5 * len(panels['samples'])
    with pytest.raises(BadInputError, match='cannot write .*nowhere'):
        draw(tmp_path / 'nowhere' / 'run.png', [plain])


def test_a_column_of_a_journal_has_room_for_the_caption(tmp_path: Path) -> None:
    run = one(tmp_path / 'bag', simulated(), **parameters(planner=ACTUATOR))
    columns = {
        x: draw([], [run], Paper(85.0, **more)) for x, more in {
            'usual': {}, 'low': {'height': 60.0}, 'other': {'panels': ['phase', 'residual']},
        }.items()}
    heights = {x: INCH * y.get_figheight() for x, y in columns.items()}
    assert heights['usual'] < 120.0
    assert heights['low'] == pytest.approx(60.0)
    assert [x.get_xlabel() for x in columns['other'].axes] == [
        r'stretch $\lambda$', 'setpoint']
    # The plan is what happened, so that there is no difference to draw.
    with pytest.raises(BadInputError, match='panel plan of .* would be empty: expected'):
        draw([], [run], Paper(panels=['response', 'plan']))
    with pytest.raises(BadInputError, match="panel is 'side': expected one of command, resp"):
        Paper(panels=['side'])


@pytest.mark.parametrize(('name', 'panels'), [
    ('command', 1), ('response', 1), ('phase', 1), ('error', 3), ('residual', 1)])
def test_a_panel_on_paper_and_in_a_page_shows_the_same(
        tmp_path: Path, name: str, panels: int) -> None:
    run = one(tmp_path / 'bag', simulated(), **parameters(planner=ACTUATOR))
    described, drawn = PANELS[name]([run]), draw([], [run], Paper(panels=[name])).axes
    assert len(described) == len(drawn) == panels
    for panel, axes in zip(described, drawn, strict=True):
        shown = panel.to_dict()
        assert axes.get_xlim() == pytest.approx(shown['x']['limits'])
        assert axes.get_ylim() == pytest.approx(shown['y']['limits'])
        assert axes.get_yscale() == shown['y']['scale']
        lines = {str(x.get_label()): x for x in axes.get_lines()}
        for curve in shown['curves']:
            if curve['hidden'] or curve['form'] in ('band', 'vertical'):
                continue
            line = lines[curve['name']]
            assert line.get_color() == curve['colour']
            assert np.asarray(line.get_ydata(), dtype=float) == pytest.approx(
                np.array(curve['y'], dtype=float), nan_ok=True)


def test_the_plan_looks_alike_in_all_panels_and_like_nothing_else() -> None:
    block = Actuator(damping_ratio=0.04)
    motion = block.plan([(1.1, 0.5), (1.0, 0.5)]).simulate(
        truth=block.scaled(shear_modulus=1.05))
    curves = [x for name in ('response', 'error') for panel in PANELS[name]([Part.of(motion.run)])
              for x in panel.curves]
    looks = {(x.look.colour, x.look.dash) for x in curves if x.name == 'plan'}
    assert len(looks) == 1
    assert looks.isdisjoint((x.look.colour, x.look.dash) for x in curves if x.name != 'plan')


def script() -> ModuleType:
    """Return the script that draws the figures of the documentation."""
    path = ROOT / 'scripts' / 'draw_docs.py'
    spec = importlib.util.spec_from_file_location('draw_docs', path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


DRAWN = script().PICTURES
# In the gate; the others, which the same functions draw, take longer.
FAST = ('demo', 'moves', 'laws')
# With which they were drawn.
NEWEST = re.findall(
    r'^matplotlib==([\d.]+)', (ROOT / 'constraints.txt').read_text(encoding='utf-8'), re.M)[-1]


def from_afar(path: Path) -> Image.Image:
    """Return a figure in shades of grey, with eight dots combined into one."""
    image = Image.open(path).convert('L')
    return image.resize((image.width // 8, image.height // 8), Image.Resampling.BOX)


@pytest.mark.parametrize('name', [
    pytest.param(x, marks=[] if x in FAST else [pytest.mark.slow]) for x in DRAWN])
def test_the_pictures_of_the_documentation_are_what_the_package_draws_now(
        name: str, tmp_path: Path) -> None:
    DRAWN[name](tmp_path / f'{name}.png')
    drawn, shown = (from_afar(x / f'{name}.png') for x in (tmp_path, IMAGES))
    assert drawn.size == pytest.approx(shown.size, abs=2)
    if matplotlib.__version__ != NEWEST:
        return  # another one sets text in other places
    shades = [np.asarray(x.resize(shown.size), dtype=np.float64) for x in (drawn, shown)]
    apart = np.abs(shades[0] - shades[1])
    again = f'draw it anew with make pictures ARGS={name}'
    assert np.mean(apart) < MEAN, again
    assert np.mean(apart > PLACE) < FEW, again


@pytest.mark.slow
@pytest.mark.parametrize(('name', 'most'), [('moving', 500_000), ('modal', 1_000_000)])
def test_the_animations_are_what_the_package_draws_now(
        name: str, most: int, tmp_path: Path) -> None:
    shown = IMAGES / f'{name}.gif'
    assert shown.stat().st_size < most
    script().ANIMATIONS[name](tmp_path / f'{name}.gif')
    with Image.open(tmp_path / f'{name}.gif') as drawn, Image.open(shown) as kept:
        assert (drawn.size, drawn.n_frames) == (kept.size, kept.n_frames)
        for frame in (0, 10, 80):
            shades = []
            for image in (drawn, kept):
                image.seek(frame)
                shades.append(np.asarray(image.convert('L').resize((80, 36)), dtype=np.float64))
            assert np.mean(np.abs(shades[0] - shades[1])) < MEAN, (
                f'draw it anew with make pictures ARGS={name}')


def test_every_picture_of_the_documentation_is_drawn_by_the_script() -> None:
    # These two show measurements of hours, and of half an hour.
    expected = {*DRAWN, 'soak', 'harm'}
    assert {x.stem for x in IMAGES.glob('*.png')} == expected
    shown = {
        name for page in [ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')]
        for name in re.findall(r'!\[[^]]*\]\([^)]*images/(\w+)\.png\)',
                               page.read_text(encoding='utf-8'))}
    assert shown == expected
