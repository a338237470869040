"""
Draw the pictures of the documentation into docs/images, from the package itself.

Used by ``make pictures``; names of pictures as arguments draw these alone. Of what is shown there
only the graph of nodes (``make graph``) and the soak's memory, which takes hours, are
made otherwise.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
import math
from pathlib import Path
import re
import sys

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
import numpy as np
from PIL import Image

from hmsa.model.delivery import ramps
from hmsa.planning.shapers.request import MoveRequest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.beam_segments import Chain  # noqa: E402
from benchmarks.block_elements import Block  # noqa: E402
from benchmarks.robustness import PICTURES as STUDIES  # noqa: E402
from benchmarks.warming import SILICONE  # noqa: E402
from hmsa import Actuator  # noqa: E402
from hmsa.interfaces.actuator import actuator_from  # noqa: E402
from hmsa.interfaces.diagnostics import Outcome  # noqa: E402
from hmsa.interfaces.parameters import BLOCK  # noqa: E402
from hmsa.model.compressible import condensed  # noqa: E402
from hmsa.model.continuum import mode_shapes, spectrum  # noqa: E402
from hmsa.model.creep import Creep  # noqa: E402
from hmsa.model.delivery import Delivery  # noqa: E402
from hmsa.model.equations import elastic_force, stretch_limits  # noqa: E402
from hmsa.model.laws import LAWS  # noqa: E402
from hmsa.model.laws.bending import centreline  # noqa: E402
from hmsa.model.moves import State  # noqa: E402
from hmsa.model.parameters import NondimensionalParameters, paper_actuator  # noqa: E402
from hmsa.model.simulation import ActuatorSimulation, simulate  # noqa: E402
from hmsa.model.units import NANOSECONDS  # noqa: E402
from hmsa.planning.planner import Options, Planner  # noqa: E402
from hmsa.planning.sequence import plan_sequence, Setpoint  # noqa: E402
from hmsa.planning.shapers import get_shaper  # noqa: E402
from hmsa.planning.two_step import plan_two_step  # noqa: E402
from hmsa.report import looks, style  # noqa: E402
from hmsa.report.comparison import Part  # noqa: E402
from hmsa.report.looks import SCREEN  # noqa: E402
from hmsa.report.picture import draw  # noqa: E402
from hmsa.runs.record import described, RecordedLevel, Run  # noqa: E402
from hmsa_ros.clients.demo import second_act, SEQUENCE  # noqa: E402
from hmsa_studies.paper import draw_figure, FIGURES  # noqa: E402

FOLDER = ROOT / 'docs' / 'images'
STRETCH, TIME = style.axis('stretch', r'\lambda'), style.axis('time', r'\tau')
LOAD = style.axis('load', r'\beta')
MATERIAL = NondimensionalParameters(zeta=0.2, j_lim=5.0)


def force(path: Path) -> None:
    """Draw the load that holds a stretch, and where the chains end it."""
    with style.picture(path, 2.9, replace(SCREEN, width=120)) as figure:
        axes = figure.add_subplot()
        for j_lim, look in zip((5.0, 3.0, 1.0), looks.CASES, strict=False):
            lower, upper = stretch_limits(j_lim)
            stretch = np.linspace(lower, upper, 2001)[1:-1]
            load = elastic_force(stretch, j_lim)
            axes.plot(stretch, load, **look.line(label=rf'$J_\mathrm{{lim}}$ = {j_lim:g}'))
            for limit in (lower, upper):
                axes.axvline(limit, color=look.colour, linestyle=':', linewidth=0.8)
        axes.axhline(0.0, color=looks.GREY, linewidth=0.6)
        axes.plot([1.0], [0.0], **style.EQUILIBRIUM)
        axes.set_ylim(-8.0, 8.0)
        axes.legend(loc=(0.22, 0.66))
        style.finish(axes, STRETCH, style.axis('load', r'\beta_1'))


def two_steps(path: Path) -> None:
    """Draw the two-step move over time and in the phase plane."""
    plan = plan_two_step(1.0, 1.4, MATERIAL)
    time = np.linspace(0.0, 6.0, 1201)
    shaped = simulate([0.0, plan.tau_p], [plan.beta_p, plan.beta_1], time, MATERIAL)
    weak = simulate([0.0], [plan.beta_p], time, MATERIAL)
    plain = simulate([0.0], [plan.beta_1], time, MATERIAL)
    with style.picture(path, 3.1, SCREEN) as figure:
        left, right = figure.subplots(1, 2, width_ratios=[1.2, 1.0])
        grey = {'color': looks.INDIGO, 'linewidth': 1.2, 'linestyle': '-.', 'zorder': 2}
        left.plot(time, plain[0], label=r'$\beta_1$ alone', **style.UNSHAPED)
        left.plot(time, weak[0], label=r'$\beta_p$ alone', **grey)
        left.plot(time, shaped[0], label=r'$\beta_p$, then $\beta_1$', **style.SHAPED)
        left.axvline(plan.tau_p, **style.TARGET)
        left.annotate(r'$\tau_p$', (plan.tau_p, 1.0), (4, 0), textcoords='offset points')
        left.axhline(1.4, **style.TARGET)
        left.legend(loc='lower right')
        style.finish(left, TIME, STRETCH, 'a')
        right.plot(*plain, **style.UNSHAPED)
        right.plot(*weak, **grey)
        right.plot(*shaped, **style.SHAPED)
        right.plot([1.0, 1.4], [0.0, 0.0], **style.EQUILIBRIUM)
        right.annotate('start', (1.0, 0.0), (6, -12), textcoords='offset points')
        right.annotate('target', (1.4, 0.0), (6, -12), textcoords='offset points')
        style.finish(right, STRETCH, r'stretch rate $\dot\lambda$', 'b')


def energy(path: Path) -> None:
    """Draw why two paths cannot cross: stretch rate over stretch for a range of loads."""
    plan = plan_two_step(1.0, 1.4, MATERIAL)
    time = np.linspace(0.0, 3.0, 1201)
    with style.picture(path, 2.9, replace(SCREEN, width=120)) as figure:
        axes = figure.add_subplot()
        for share in (0.7, 0.85, 1.15, 1.3):
            stretch, rate = simulate([0.0], [plan.beta_p * share], time, MATERIAL)
            end = int(np.argmax(rate[1:] <= 0.0)) + 2
            axes.plot(stretch[:end], rate[:end], color=looks.GREY, linewidth=0.9)
            top = int(np.argmax(rate[:end]))
            axes.annotate(rf'{share:g} $\beta_p$', (stretch[top], rate[top]), (0, 3), ha='center',
                          textcoords='offset points', **style.SOFT)
        stretch, rate = simulate([0.0], [plan.beta_p], time, MATERIAL)
        end = int(np.argmax(rate[1:] <= 0.0)) + 2
        axes.plot(stretch[:end], rate[:end], **style.SHAPED)
        axes.plot([1.0, 1.4], [0.0, 0.0], **style.EQUILIBRIUM)
        axes.set_ylim(top=0.7)
        style.finish(
            axes, STRETCH, r'stretch rate $\dot\lambda$ until it turns')


def deliveries(path: Path) -> None:
    """Draw the same move as an ideal, a sampled and a ramped command."""
    period = 0.4
    cases = (
        ('ideal', Delivery()), (f'on a grid of {period:g}', Delivery(period=period)),
        ('ramped, 0.8 per time scale', Delivery(slew=0.8)))
    time = np.linspace(-0.3, 3.0, 661)
    holding = 0.0
    with style.picture(path, 3.1, SCREEN) as figure:
        rows = figure.subplots(2, 3, sharex=True, sharey='row', height_ratios=[1.0, 1.2])
        for i, (title, delivery) in enumerate(cases):
            segment, = plan_sequence(
                [Setpoint(1.4, 20 * period)],
                MoveRequest.of(MATERIAL, State(1.0, 0.0, 0.0), delivery=delivery))
            levels = segment.move.levels
            rest = levels[0]._replace(time=float(time[0]), load=holding)
            switches, loads, slopes = np.array(ramps(
                [rest, *levels], holding, 3.0, delivery.slew)[0]).T
            stretch, _ = simulate(switches, loads, time, MATERIAL, slopes=slopes)
            command = np.zeros_like(time)
            for at, load, slope in zip(switches, loads, slopes, strict=True):
                after = time >= at
                command[after] = load + slope * (time[after] - at)
            rows[0, i].plot(time, command, **style.SHAPED)
            rows[1, i].plot(time, stretch, **style.SHAPED)
            rows[1, i].axhline(1.4, **style.TARGET)
            if delivery.period:
                for at in np.arange(0.0, 3.0, period):
                    rows[0, i].axvline(at, **style.TARGET)
            style.finish(rows[0, i], '', '' if i else LOAD, 'abc'[i])
            rows[0, i].set_title(title, fontsize='small')
            style.finish(rows[1, i], TIME, '' if i else STRETCH)


def smooth(path: Path) -> None:
    """Draw the same move by the two-step command, the chain and a smooth path."""
    time = np.linspace(-0.3, 4.0, 1721)
    with style.picture(path, 2.9, SCREEN) as figure:
        left, right = figure.subplots(1, 2)
        for shaper in ('two_step', 'robust', 'smooth'):
            look = looks.SHAPERS[shaper]
            segment, = plan_sequence([Setpoint(1.4, math.inf)], MATERIAL, shaper=shaper)
            switches, loads = np.array([
                (-0.3, 0.0), *((x.time, x.load) for x in segment.move.levels)]).T
            stretch, _ = simulate(switches, loads, time, MATERIAL)
            left.step(np.append(switches, time[-1]), np.append(loads, loads[-1]), where='post',
                      **look.line(label=shaper))
            right.plot(time, stretch, **look.line(label=shaper))
        left.legend(loc='lower right')
        right.axhline(1.4, **style.TARGET)
        style.finish(left, TIME, LOAD, 'a')
        style.finish(right, TIME, STRETCH, 'b')


def laws(path: Path) -> None:
    """Draw the load that holds a stretch by each law, all with the same modulus."""
    cases = {
        'mooney_rivlin': {'law.c10': 3e3, 'law.c01': 2e3},
        'yeoh': {'law.c10': 5e3, 'law.c20': -200.0, 'law.c30': 40.0},
        'ogden': {'law.mu': [2e4], 'law.alpha': [1.0]},
        'arruda_boyce': {'law.mu': [8.354e3], 'law.lambda_m': 2.0}}
    groups = {
        r'gent, $J_\mathrm{lim} = 5$': MATERIAL,
        'neo_hookean': NondimensionalParameters(j_lim=np.inf)} | {
        name: NondimensionalParameters(law=LAWS[name].scaled(values)[1])
        for name, values in cases.items()}
    with style.picture(path, 3.2, replace(SCREEN, width=120)) as figure:
        axes = figure.add_subplot()
        stretch = np.linspace(0.5, 2.6, 1001)
        for (name, group), look in zip(groups.items(), looks.CASES, strict=False):
            axes.plot(stretch, elastic_force(stretch, group), **look.line(label=name))
        axes.axhline(0.0, color=looks.GREY, linewidth=0.6)
        axes.plot([1.0], [0.0], **style.EQUILIBRIUM)
        axes.set_ylim(-4.0, 6.0)
        axes.legend(loc='upper left')
        style.finish(axes, STRETCH, style.axis('load', r'\beta_1'))


def entanglements(path: Path) -> None:
    """Draw the command of a move by share of entanglements, and what is left without them."""
    shares, time = np.linspace(0.0, 0.9, 19), np.linspace(0.0, 40.0, 8001)
    chains = replace(MATERIAL, j_lim=math.inf)
    with style.picture(path, 2.9, SCREEN) as figure:
        left, middle, right = figure.subplots(1, 3)
        for target, look in zip((1.2, 1.4, 1.8), looks.CASES, strict=False):
            found = []
            for share in shares:
                bound = 3.0
                moduli = {'law.gc': (1.0 - share) / (1.0 + 2.0 / 3.0 / (bound**2 - 1.0)),
                          'law.ge': share, 'law.lambda_m': bound}
                network = replace(MATERIAL, law=LAWS['nonaffine'].scaled(moduli)[1])
                plan, without = (plan_two_step(1.0, target, x) for x in (network, chains))
                stretch, _ = simulate(
                    [0.0, without.tau_p], [without.beta_p, without.beta_1], time, network)
                rings = stretch[time > without.tau_p][:800]
                found.append((plan.beta_p, plan.tau_p, 100.0 * np.ptp(rings) / (target - 1.0)))
            for axes, values in zip((left, middle, right), np.transpose(found), strict=True):
                axes.plot(shares, values, **look.line(label=f'to {target:g}'))
        right.legend(loc='upper left')
        share = style.axis('share of entanglements', 'G_e/G')
        style.finish(left, share, style.axis('load', r'\beta_p'), 'a')
        style.finish(middle, share, style.axis('time', r'\tau_p'), 'b')
        style.finish(right, share, style.axis('vibration', unit='% of step'), 'c')


def temperature(path: Path) -> None:
    """Draw the command of a move by temperature, and what that of 25 degrees leaves there."""
    cold = replace(paper_actuator(MATERIAL), thermal=SILICONE)
    time = np.linspace(0.0, 60.0, 12001)
    known = plan_two_step(1.0, 1.4, cold.nondimensional)
    temperatures, found = np.linspace(5.0, 65.0, 25), []
    for celsius in temperatures:
        hot = cold.at_temperature(float(celsius))
        plan = plan_two_step(1.0, 1.4, hot.nondimensional)
        load, faster = (getattr(cold, x) / getattr(hot, x) for x in (
            'flux_density_unit', 'time_unit'))
        switch = known.tau_p * faster
        stretch, _ = simulate(
            [0.0, switch], [load * known.beta_p, load * known.beta_1], time, hot.nondimensional)
        found.append((
            1e3 * hot.units.level(plan.beta_p), 1e3 * hot.units.level(plan.beta_1),
            1e3 * plan.tau_p * hot.time_unit, 250.0 * np.ptp(stretch[time > switch][:800]),
            250.0 * (stretch[-1] - 1.4)))
    first, last, tau, rings, offset = np.transpose(found)
    with style.picture(path, 2.9, SCREEN) as figure:
        left, middle, right = figure.subplots(1, 3)
        for axes, rows in (
                (left, {'$B_p$': first, '$B_1$': last}), (middle, {'': tau}),
                (right, {'vibration': rings, 'offset': offset})):
            for (name, values), look in zip(rows.items(), looks.CASES, strict=False):
                axes.plot(temperatures, values, **look.line(label=name))
        left.legend(loc='upper left')
        right.legend(loc='lower left')
        degrees = style.axis('temperature', 'T', '°C')
        style.finish(left, degrees, style.axis('flux density', unit='mT'), 'a')
        style.finish(middle, degrees, style.axis('time', 't_p', 'ms'), 'b')
        style.finish(right, degrees, style.axis('error', unit='% of step'), 'c')


def compressibility(path: Path) -> None:
    """Draw the command of a move by bulk modulus, and what is left by that of constant volume."""
    ratios, time = np.geomspace(2.0, 1000.0, 19), np.linspace(0.0, 40.0, 8001)
    with style.picture(path, 2.9, SCREEN) as figure:
        left, middle, right = figure.subplots(1, 3)
        for target, look in zip((0.8, 1.2, 1.4), looks.CASES, strict=False):
            found = []
            still = plan_two_step(1.0, target, MATERIAL)
            for ratio in ratios.tolist():
                soft = replace(MATERIAL, law=condensed(None, MATERIAL.j_lim, ratio))
                plan = plan_two_step(1.0, target, soft)
                stretch, _ = simulate(
                    [0.0, still.tau_p], [still.beta_p, still.beta_1], time, soft)
                rings = stretch[time > still.tau_p][:800]
                found.append((
                    100.0 * (plan.beta_1 / still.beta_1 - 1.0),
                    100.0 * (plan.tau_p / still.tau_p - 1.0),
                    100.0 * np.ptp(rings) / abs(target - 1.0)))
            for axes, values in zip((left, middle, right), np.transpose(found), strict=True):
                axes.semilogx(ratios, values, **look.line(label=f'to {target:g}'))
        right.legend(loc='upper right')
        ratio = style.axis('bulk over shear modulus', 'K/G')
        style.finish(left, ratio, style.axis('change of the load', r'\beta_1', '%'), 'a')
        style.finish(middle, ratio, style.axis('change of the time', r'\tau_p', '%'), 'b')
        style.finish(right, ratio, style.axis('vibration', unit='% of step'), 'c')


def creep(path: Path) -> None:
    """Draw a creeping block commanded by the paper's two-step and by a plan that knows it."""
    creeping = replace(MATERIAL, creep=Creep((0.1, 0.1), (2.0, 20.0)))
    span, grid = 15.0, Delivery(0.25)
    setpoints = [Setpoint(1.4, span), Setpoint(1.1, math.inf)]
    time = np.linspace(0.0, 2.0 * span, 3001)
    curves = ((MATERIAL, 'planned without creep', style.UNSHAPED),
              (creeping, 'planned for creep', style.SHAPED))
    with style.picture(path, 4.2, SCREEN) as figure:
        rows = figure.subplots(3, 1, sharex=True, height_ratios=[1.0, 1.2, 0.9])
        for material, name, look in curves:
            segments = plan_sequence(setpoints, MoveRequest.of(material, delivery=grid))
            levels = [(x.begin + y.time, y.load) for x in segments for y in x.move.levels]
            switches, loads = np.array([x for x in levels if x[0] < time[-1]]).T
            stretch, _ = simulate(switches, loads, time, creeping)
            rows[0].step(np.append(switches, time[-1]), np.append(loads, loads[-1]),
                         where='post', **look)
            rows[1].plot(time, stretch, label=name, **look)
            off = 100.0 * (stretch - np.where(time < span, 1.4, 1.1))
            rows[2].plot(time, off / np.where(time < span, 0.4, 0.3), **look)
        rows[1].legend(loc='upper right')
        rows[2].set_ylim(-18.0, 18.0)
        style.finish(rows[0], '', LOAD, 'a')
        style.finish(rows[1], '', STRETCH, 'b')
        style.finish(rows[2], TIME, style.axis('error', unit='% of step'), 'c')


def beam(path: Path) -> None:
    """Draw bent beams, and a move on a chain of many links that is planned for one mode."""
    youngs, length, width, thickness, density, remanence, damping = (
        1e6, 0.025, 0.005, 0.001, 2000.0, 0.1, 2.27e-4)
    strip = actuator_from({x.name: x.default for x in BLOCK} | {
        'law.name': 'beam', 'law.youngs_modulus': youngs, 'law.width': width,
        'actuator.half_length': length / 2, 'actuator.half_thickness': thickness / 2,
        'actuator.density': density, 'actuator.remanence': remanence,
        'actuator.damping_coefficient': damping})
    chain = Chain(24, length, width, thickness, density, youngs, remanence, damping)
    unit, period, target = strip.flux_density_unit, chain.first_period, 0.3
    plan = plan_two_step(0.0, target, strip.nondimensional)
    hold, arrival = plan.beta_1 * unit, plan.tau_p * strip.time_unit
    with style.picture(path, 2.9, replace(SCREEN, width=183)) as figure:
        shapes, move, left = figure.subplots(1, 3)
        for deflection, look in zip((0.3, 0.6, 0.1, 0.75), looks.CASES, strict=False):
            shapes.plot(*centreline(deflection, 41), **look.line())
            flux = 1e3 * float(elastic_force(deflection, strip.nondimensional)) * unit
            x, y = (part[-1] for part in centreline(deflection, 41))
            shapes.annotate(f'{flux:.1f} mT', (x + 0.02, y), fontsize='small')
        shapes.plot([0.0, 0.0], [-0.08, 0.08], color='black', linewidth=3.0)
        shapes.set_aspect('equal')
        shapes.set_xlim(-0.05, 1.35)
        for label, kind, levels in (
                ('unshaped step', style.UNSHAPED, [(4.0 * period, hold)]),
                ('two-step', style.SHAPED, [
                    (arrival, plan.beta_p * unit), (4.0 * period - arrival, hold)])):
            time, deflection = chain.follow(levels, 400)
            move.plot(1e3 * time, deflection, **kind, label=label)
        after = time > arrival
        left.plot(
            1e3 * time[after], 100.0 * (deflection[after] / target - 1.0), **style.SHAPED)
        move.legend(loc='lower right')
        left.axhline(0.0, color=looks.GREY, linewidth=0.6)
        left.set_ylim(-0.5, 3.5)
        style.finish(shapes, 'along / length', 'across / length', 'a')
        style.finish(move, style.axis('time', 't', 'ms'), style.axis('deflection', 'u'), 'b')
        style.finish(
            left, style.axis('time', 't', 'ms'), style.axis('error', unit='% of step'), 'c')


def modes(path: Path) -> None:
    """Draw the three strongest modes of a cube, in the plane through its centre."""
    found, count, swing = spectrum(1.0, 'free'), 3, 0.12
    strong = np.sort(np.argsort(-found.shares)[:count])
    fine, coarse = np.linspace(-1.0, 1.0, 61), np.linspace(-1.0, 1.0, 9)
    lines = [np.column_stack(y) for x in coarse for y in (
        (fine, 0.0 * fine, x + 0.0 * fine), (x + 0.0 * fine, 0.0 * fine, fine))]
    moved = mode_shapes(1.0, count, np.concatenate(lines)).reshape(count, len(lines), -1, 3)
    with style.picture(path, 2.4, SCREEN) as figure:
        for i, (axes, place) in enumerate(zip(figure.subplots(1, count), strong, strict=True)):
            for line, away in zip(lines, moved[i], strict=True):
                # Modes of small share move inside more than on the face of the load.
                now = line + swing * away / np.max(np.abs(moved[i]))
                axes.plot(now[:, 0], now[:, 2], color=looks.BLUE, linewidth=0.8)
            axes.add_patch(Rectangle(
                (-1.0, -1.0), 2.0, 2.0, fill=False, color=looks.GREY, linestyle='--'))
            axes.set_aspect('equal')
            axes.set_axis_off()
            ratio = found.frequencies[place] / found.frequencies[found.first]
            axes.set_title(
                f'{ratio:.2f} $f_1$, {100.0 * found.shares[place]:.0f} %', fontsize='small')


def simulated(*setpoints: tuple[float, float], rate: float) -> Run:
    """Return the run of setpoints (stretch, span in s), as its recorder would see it."""
    block, start, lead = paper_actuator(), NANOSECONDS, 5_000_000
    ends = np.cumsum([round(x * NANOSECONDS) for _, x in setpoints]).tolist()
    points = [(x, end) for (x, _), end in zip(setpoints, ends, strict=True)]
    plan = Planner(block, Options(lead_time=lead)).request(points, None, start)
    levels = tuple(
        RecordedLevel(x.stamp, x.flux_density, start, x.stretch, x.rate) for x in plan.levels
        if x.stamp >= start)
    plant = ActuatorSimulation(block, time=start)
    for level in levels:
        plant.command(level.stamp, level.flux_density)
    samples = []
    for stamp in range(start, start + lead + ends[-1], round(NANOSECONDS / rate)):
        plant.advance(stamp)
        samples.append((stamp, plant.stretch, plant.rate, plant.flux_density))
    time, *motion = (np.array(x) for x in zip(*samples, strict=True))
    asked, before = [], block.rest
    for x in plan.segments:
        setpoint = described(block, x.stretch, before, x.since, x.until)
        asked.append(Outcome(setpoint=replace(setpoint, arrival=x.arrival)))
        before = x.stretch
    return Run(
        'run', 'actuator', Path('run'), time, time, *motion,
        commands=tuple(RecordedLevel(x.stamp, x.flux_density, x.sent) for x in levels),
        plans=(levels,),
        outcomes=tuple(asked), plant=block, planner=block, parameters_known=True,
        origin='simulated')


def demo(path: Path) -> None:
    """Draw the run of `hmsa demo`."""
    run = simulated(*(
        (x, span * paper_actuator().time_unit) for x, span in SEQUENCE), rate=20_000.0)
    draw(path, [Part.of(run)], SCREEN)


def adapting(path: Path) -> None:
    """Draw the second act of `hmsa demo`."""
    second_act(path)


def moves(path: Path) -> None:
    """Draw the figure of the guide to bags, by its own code."""
    page = (ROOT / 'docs' / 'guides' / 'bags.md').read_text(encoding='utf-8')
    code, = re.findall(r'```python\n(import matplotlib.*?)```', page, flags=re.DOTALL)
    run = simulated((1.2, 0.3), (0.9, 0.3), (1.0, 0.3), rate=1000.0)
    names = {
        'levels': [(x.stamp / NANOSECONDS, x.flux_density) for x in run.commands],
        'time': run.time / NANOSECONDS, 'stretch': run.stretch}
    exec(code.replace("'moves.png'", repr(str(path))), names)  # noqa: S102 - our own page


def moving(path: Path) -> None:
    """Draw two moves of the paper's block as an animation, unshaped and shaped."""
    unit = paper_actuator().time_unit * 1e3
    material = paper_actuator().nondimensional
    setpoints = [Setpoint(1.4, 9.0), Setpoint(0.8, math.inf)]
    time = np.linspace(-1.0, 19.0, 81)
    fine = np.linspace(time[0], time[-1], 1601)
    runs = []
    for shaper in ('step', 'two_step'):
        levels = [(x.begin + y.time, y.load) for x in plan_sequence(
            setpoints, material, shaper=shaper) for y in x.move.levels]
        switches, loads = np.array([(time[0], 0.0), *levels]).T
        runs.append(simulate(switches, loads, fine, material)[0])
    figure = Figure(figsize=(6.4, 2.9), dpi=100, layout='constrained')
    canvas = FigureCanvasAgg(figure)
    blocks, curves = figure.subplots(1, 2, width_ratios=[1.0, 1.5])
    blocks.set(xlim=(-0.7, 1.7), ylim=(0.0, 2.1), xticks=[0, 1], yticks=[])
    blocks.set_xticklabels(['unshaped step', 'two-step'])
    curves.set(xlim=(time[0] * unit, time[-1] * unit), ylim=(0.4, 2.1))
    style.finish(curves, style.axis('time', 't', 'ms'), STRETCH)
    targets = [x.axhline(1.0, **style.TARGET) for x in (blocks, curves)]
    looks_of = (style.UNSHAPED, style.SHAPED)
    lines = [curves.plot([], [], **x)[0] for x in looks_of]
    bodies = [blocks.add_patch(Rectangle((0.0, 0.0), 1.0, 1.0, facecolor=x['color'], alpha=0.8))
              for x in looks_of]
    frames = []
    for now in time:
        past = fine <= now + 1e-9
        for target in targets:
            target.set_ydata([1.0 if now < 0.0 else 1.4 if now < setpoints[0].span else 0.8] * 2)
        for i, (line, body, stretch) in enumerate(zip(lines, bodies, runs, strict=True)):
            line.set_data(fine[past] * unit, stretch[past])
            height = stretch[past][-1]
            width = 0.8 / math.sqrt(height)
            body.set_bounds(i - width / 2, 0.0, width, height)
        canvas.draw()
        figure.set_layout_engine('none')
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB').quantize(
            32, dither=Image.Dither.NONE))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=90, loop=0)


def modal(path: Path) -> None:
    """Draw a move of a cube of finite elements as an animation, by two_step and by modal."""
    target, enlarged, ratio, j_lim = 1.2, 2.0, 0.05, 5.0
    paper = Actuator(half_length=0.01, damping_ratio=ratio, chain_limit=j_lim)
    block, material = paper.replace(mount='free'), paper.model.material
    unit, slower = paper.block.time_unit, block.block.time_unit / paper.block.time_unit
    time = np.linspace(-0.5, 12.0, 81)
    runs = []
    for actuator, shaper, factor in ((paper, 'two_step', 1.0), (block, 'modal', slower)):
        move = get_shaper(shaper)(MoveRequest(State(1.0), target, actuator.model.material))
        starts = np.array([-math.inf, *(factor * x.time for x in move.levels)])
        loads = [0.0, *(x.load for x in move.levels)]
        elements = Block(1.0, j_lim, material.zeta * material.c1 / 6.0, (5, 5, 5))
        section = np.flatnonzero(elements.position[:, 1] < 1e-9)
        frames_of, now = [elements.position[section]], float(time[0])
        stretches = [1.0]
        for end in time[1:]:
            edges = [now, *(x for x in starts if now < x < end), float(end)]
            elements.follow([
                (until - begin, loads[int(np.searchsorted(starts, begin, 'right')) - 1])
                for begin, until in pairwise(edges)])
            frames_of.append(elements.position[section])
            stretches.append(elements.stretch)
            now = float(end)
        runs.append((np.array(frames_of), np.array(stretches)))
    figure = Figure(figsize=(6.4, 2.9), dpi=100, layout='constrained')
    canvas = FigureCanvasAgg(figure)
    blocks, curves = figure.subplots(1, 2, width_ratios=[1.3, 1.2])
    blocks.set(xlim=(-1.35, 4.05), ylim=(-1.6, 1.6), xticks=[0.0, 2.7], yticks=[])
    blocks.set_xticklabels(["two_step, paper's model", 'modal'])
    blocks.set_aspect('equal')
    curves.set(xlim=(1e3 * unit * time[0], 1e3 * unit * time[-1]), ylim=(0.99, 1.28))
    curves.axhline(target, **style.TARGET)
    style.finish(curves, style.axis('time', 't', 'ms'), style.axis('mean stretch', r'\lambda'))
    side = round(math.sqrt(len(runs[0][0][0])))
    looks_of = (style.UNSHAPED, style.SHAPED)
    lines = [curves.plot([], [], **x)[0] for x in looks_of]
    grids = [blocks.add_collection(LineCollection([], color=x['color'], linewidths=0.8))
             for x in looks_of]
    frames = []
    for i in range(len(time)):
        for j, (line, grid, (places, stretches)) in enumerate(
                zip(lines, grids, runs, strict=True)):
            line.set_data(1e3 * unit * time[:i + 1], stretches[:i + 1])
            # An eighth of the block by symmetry, so a quarter of the section.
            quarter = (places[0] + enlarged * (places[i] - places[0]))[:, [0, 2]].reshape(
                side, side, 2)
            half = np.concatenate([quarter[:0:-1] * [-1.0, 1.0], quarter])
            whole = np.concatenate([half[:, :0:-1] * [1.0, -1.0], half], axis=1) + [2.7 * j, 0.0]
            grid.set_segments([*whole, *whole.swapaxes(0, 1)])
        canvas.draw()
        figure.set_layout_engine('none')
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB').quantize(
            32, dither=Image.Dither.NONE))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=90, loop=0)


def figure(number: int) -> Callable[[Path], None]:
    """Return what draws a figure of the paper."""
    return lambda path: draw_figure(FIGURES[number], [path], SCREEN)


#: What draws each picture, by its name.
PICTURES: dict[str, Callable[[Path], None]] = {
    'demo': demo, 'adapting': adapting, 'moves': moves, 'figure_05': figure(5),
    'figure_08': figure(8), 'theory_force': force, 'theory_two_steps': two_steps,
    'theory_paths': energy, 'theory_deliveries': deliveries, 'theory_smooth': smooth,
    'laws': laws, 'entanglements': entanglements, 'temperature': temperature,
    'compressibility': compressibility, 'creep': creep, 'beam': beam, 'modes': modes, **STUDIES}
#: What draws each animation.
ANIMATIONS: dict[str, Callable[[Path], None]] = {'moving': moving, 'modal': modal}


def main() -> int:
    """Draw all of them, or those named."""
    for name in sys.argv[1:] or [*PICTURES, *ANIMATIONS]:
        path = FOLDER / f'{name}.{"gif" if name in ANIMATIONS else "png"}'
        (PICTURES | ANIMATIONS)[name](path)
        print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
