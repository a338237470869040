"""
Commands for a block on finite elements, which have every mode.

    python -m benchmarks continuum [--quick]

Material, size and damping are known exactly; only the equation of motion is simpler than that of
the block.
What remains is the vibration of the mean stretch in the first period of the first mode after
arrival, peak to peak, in % of the step.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
import math
from typing import Any

import numpy as np

from benchmarks import bench_harm
from benchmarks.block_elements import Block
from benchmarks.laboratory import Bench, drawn, Plant
from benchmarks.sheet import Sheet
from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import (
    check_free,
    DEFAULT_FREE,
    MODES,
    SECONDARY,
    values_of,
)
from hmsa.identification.result import Identification
from hmsa.model.equations import elastic_force
from hmsa.model.modes import Modes
from hmsa.model.moves import Limits, Move, State
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import ActuatorSimulation
from hmsa.planning.sequence import remaining
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest, SmoothLimits

#: H/L, and elements along x, y and z.
SHAPES = {0.1: (6, 6, 2), 0.3: (6, 6, 3), 0.5: (5, 5, 4), 0.707: (5, 5, 4), 1.0: (5, 5, 5),
          2.0: (4, 4, 7), 4.0: (3, 3, 10)}
_MORE_SHAPES = dict(sorted({0.05: (7, 7, 1), 0.2: (6, 6, 2), **SHAPES}.items()))
TARGETS = (0.9, 1.1, 1.2)
# H/L of glued blocks: elements have twice the height.
_GLUED = (0.25, 0.5, 1.0, 2.0)
# Damping ratios of the paper's model about rest.
_RATIO, _LITTLE, _GLUED_RATIO = 0.08, 0.02, 0.05
J_LIM = 5.0
# Two-step command whose move time is the unit, by mount, and columns of tables.
_BASES = {'free': 'paper', 'glued': 'first'}
_WITH_MODES = '`modal` (time)', '`modal`, order 3 (time)'
# Limits of what modal may leave at its default order and at order 3, also of a glued block, and of
# the relative error of a prediction.
_MOST, _MOST_3, _MOST_GLUED, _APART = 3.0, 1.0, 1.2, 0.2


def compare(*, quick: bool) -> Sheet:
    """Return what is left by the commands of the paper's model and of the modes."""
    shapes = [1.0] if quick else [*SHAPES]
    targets = TARGETS[1:2] if quick else TARGETS
    rows, figures, worst, apart = [], [], 0.0, 0.0
    for shape in shapes:
        for target in targets:
            found = dict(_left(shape, target))
            figures.append({'shape': shape, 'target': target, **found})
            worst = max(worst, found['modal'])
            apart = max(apart, abs(found['predicted'] / found['first'] - 1.0))
            rows.append([
                f'{shape:g}, to {target:g}', *(f'{found[x]:.1f}' for x in (
                    'step', 'paper', 'first', 'predicted')),
                *(f'{found[x]:.1f} ({found[f"{x} time"]:.2f})' for x in ('modal', 'modal 3'))])
    return Sheet(
        'continuum', f'Vibration in % of the step on finite elements, damping ratio {_RATIO:g}',
        ('H/L', 'step', "`two_step`, paper's model", '`two_step`, first mode', 'predicted',
         *_WITH_MODES),
        rows, {'rows': figures}, worst <= _MOST and apart <= _APART and all(
            x['modal 3'] <= _MOST_3 for x in figures))


def little_damped(*, quick: bool) -> Sheet:
    """Return what modal leaves at little damping, where weak modes fade slowly."""
    rows, figures, worst = _by_shape(_MORE_SHAPES, _LITTLE, 'free', quick=quick)
    return Sheet(
        'continuum_little', f'The same at a damping ratio of {_LITTLE:g}, to 0.9, 1.1 and 1.2',
        ('H/L', "`two_step`, paper's model", *_WITH_MODES), rows, {'rows': figures},
        worst <= _MOST_3)


def glued(*, quick: bool) -> Sheet:
    """Return what commands leave of blocks that are glued with a face."""
    rows, figures, worst = _by_shape(_GLUED, _GLUED_RATIO, 'glued', quick=quick)
    return Sheet(
        'continuum_glued', 'Blocks that are glued with a face, damping ratio '
        f'{_GLUED_RATIO:g}, to 0.9, 1.1 and 1.2',
        ('H/L', '`two_step`, first mode', *_WITH_MODES), rows, {'rows': figures},
        worst <= _MOST_GLUED)


def _by_shape(
        shapes: Iterable[float], damping_ratio: float, mount: str, *, quick: bool
) -> tuple[list[list[str]], list[dict[str, Any]], float]:
    """Return rows and figures of a two-step command and of modal, and the most at order 3."""
    names, rows, figures, worst = (_BASES[mount], 'modal', 'modal 3'), [], [], 0.0
    for shape in (1.0,) if quick else shapes:
        found = [
            dict(_left(shape, target, damping_ratio, names, mount))
            for target in (TARGETS[1:2] if quick else TARGETS)]
        figures.append({'shape': shape, 'targets': found})
        worst = max(worst, *(x['modal 3'] for x in found))
        rows.append([f'{shape:g}', ', '.join(f'{x[names[0]]:.1f}' for x in found), *(
            ', '.join(f'{x[name]:.1f} ({x[f"{name} time"]:.2f})' for x in found)
            for name in names[1:])])
    return rows, figures, worst


def _left(
        shape: float, target: float, damping_ratio: float = _RATIO,
        names: Sequence[str] = ('step', 'paper', 'first', 'modal', 'modal 3'),
        mount: str = 'free') -> Iterator[tuple[str, float]]:
    """Yield names and vibrations in % of the step, and times in units of that of `_BASES`."""
    paper, block = blocks(shape, damping_ratio, mount)
    period = block.block.period / paper.block.time_unit
    first = {}
    for name, actuator, shaper, order in (
            ('step', paper, 'step', 2), ('paper', paper, 'two_step', 2),
            ('first', block, 'two_step', 2), ('modal', block, 'modal', 2),
            ('modal 3', block, 'modal', 3)):
        if name not in names:
            continue
        material = actuator.model.material
        request = MoveRequest(State(1.0), target, material, order=order)
        move = get_shaper(shaper)(request)
        if name == 'first':
            left = remaining(request, move)
            yield 'predicted', 0.0 if left is None else 100.0 * left.vibration
        move = _scaled(move, actuator.block, paper.block)
        first[name] = move
        yield name, _vibration(elements_of(shape, paper, mount), move, period, target)
    for name in names[-2:]:
        yield f'{name} time', first[name].duration / first[_BASES[mount]].duration


def blocks(
        shape: float, damping_ratio: float = _RATIO, mount: str = 'free'
) -> tuple[Actuator, Actuator]:
    """Return a block of some H/L as the paper has it, and with all modes as it is mounted."""
    with unquestioned():  # of flat blocks
        paper = Actuator(
            half_thickness=0.01 * shape, damping_ratio=damping_ratio, chain_limit=J_LIM)
        # The same coefficient: as from a data sheet, not from the ringing.
        return paper, paper.replace(mount=mount)


def elements_of(shape: float, paper: Actuator, mount: str = 'free') -> Block:
    """Return the elements of a block of some H/L."""
    material = paper.model.material
    height = 2.0 * shape if mount == 'glued' else shape
    return Block(
        height, J_LIM, material.zeta * material.c1 / 6.0, _MORE_SHAPES[height],
        glued=mount == 'glued')


def _scaled(move: Move, block: ActuatorParameters, paper: ActuatorParameters) -> Move:
    """Return a move of a block in the units of time and load of the paper's model."""
    time = block.time_unit / paper.time_unit
    load = block.flux_density_unit / paper.flux_density_unit
    return move._replace(
        duration=move.duration * time,
        levels=tuple(x._replace(time=x.time * time, load=x.load * load) for x in move.levels))


def _vibration(elements: Block, move: Move, period: float, target: float) -> float:
    """Return the peak to peak of the mean stretch in a period after the arrival, in %."""
    arrival = move.duration if math.isfinite(move.duration) else 0.5 * period
    ends = [*(x.time for x in move.levels[1:]), arrival + period]
    times, stretch = elements.follow([
        (end - x.time, x.load) for x, end in zip(move.levels, ends, strict=True)])
    return 100.0 * float(np.ptp(stretch[times >= arrival])) / abs(target - 1.0)


# Shapers whose predictions are compared, with the periods of a smooth move; and what minimum_time
# may command, in units of the load that holds the target. H/L and targets.
_PREDICTED = (('two_step', 1.0), ('zvd', 1.0), ('robust', 1.0), ('minimax', 1.0), ('smooth', 1.0),
              ('smooth', 2.0), ('minimum_time', 1.0))
_PUSH, _CASES = 2.0, ((0.5, 1.1), (1.0, 0.9), (1.0, 1.1), (2.0, 1.1))
# Largest factor between prediction and finite elements, where at least this is left in %.
_FACTOR, _NOTABLE = 2.5, 2.0


def predicted(*, quick: bool) -> Sheet:
    """Return what shapers that plan the first mode alone leave: predicted, and on elements."""
    rows, figures, worst = [], [], 1.0
    shapers = _PREDICTED[:2] if quick else _PREDICTED
    for shape, target in _CASES[2:3] if quick else _CASES:
        paper, block = blocks(shape)
        material = block.model.material
        held = _PUSH * abs(float(elastic_force(target, material)))
        cells = []
        for name, periods in shapers:
            request = MoveRequest(
                State(1.0), target, material, limits=Limits(-held, held),
                pace=SmoothLimits(periods))
            move = get_shaper(name)(request)
            left = remaining(request, move)
            told = 0.0 if left is None else 100.0 * left.vibration
            seen = _vibration(
                elements_of(shape, paper), _scaled(move, block.block, paper.block),
                block.block.period / paper.block.time_unit, target)
            if max(told, seen) >= _NOTABLE:
                worst = max(worst, told / max(seen, 1e-9), seen / max(told, 1e-9))
            figures.append({'shape': shape, 'target': target, 'shaper': name, 'periods': periods,
                            'predicted': told, 'elements': seen})
            cells.append(f'{told:.1f} / {seen:.1f}')
        rows.append([f'{shape:g}, to {target:g}', *cells])
    return Sheet(
        'continuum_predictions',
        'Vibration in % of the step of shapers that plan the first mode alone: predicted / on '
        f'finite elements; loads of minimum_time up to {_PUSH:g} times the holding load',
        ('H/L', *(f'`{x}`' if y == 1.0 else f'`{x}`, {y:g} periods' for x, y in shapers)), rows,
        {'rows': figures}, worst <= _FACTOR)


# Frequencies of waves in units of the first one, their amplitude, their cycles at that size, and
# the largest relative error of the amplitude that a plan with modes may leave.
_SHARES, _AMPLITUDE, _CYCLES, _WAVE_ERROR = (0.25, 0.5, 0.75), 0.05, 6.0, 0.04


def waves(*, quick: bool) -> Sheet:
    """Return the amplitudes of sine waves on finite elements, planned with several models."""
    rows, figures, worst = [], [], 0.0
    for shape in (1.0,) if quick else (0.3, 0.5, 1.0, 2.0):
        paper, block = blocks(shape)
        first = Actuator.from_parameters({
            x: y for x, y in block.parameters.items() if not x.startswith('modes.')})
        for share in _SHARES[1:2] if quick else _SHARES:
            found = [_amplitude(shape, paper, x, share * block.scales.frequency) / _AMPLITUDE
                     for x in (paper, first, block)]
            figures.append({'shape': shape, 'frequency': share, 'amplitudes': found})
            worst = max(worst, abs(found[-1] - 1.0))
            rows.append([f'{shape:g}, {share:g} f₁', *(f'{x:.3f}' for x in found)])
    return Sheet(
        'continuum_waves',
        f'Amplitude of sine waves of {_AMPLITUDE:g} on finite elements, over the requested one',
        ('H/L, frequency', "paper's model", 'first mode alone', 'with its modes'), rows,
        {'rows': figures}, worst <= _WAVE_ERROR)


def _amplitude(shape: float, paper: Actuator, actuator: Actuator, frequency: float) -> float:
    """Return the amplitude of the mean stretch in the middle of a wave that an actuator plans."""
    plan = actuator.wave('sine', frequency, _AMPLITUDE, cycles=_CYCLES)
    unit, elements = paper.block.time_unit, elements_of(shape, paper)
    loads = paper.model.units.of_level(plan.flux_densities[:-1])
    times, stretch = elements.follow([*zip(
        (np.diff(plan.times) / unit).tolist(), loads.tolist(), strict=True)])
    middle = np.abs(times / times[-1] - 0.5) < 0.15
    angle = 2.0 * math.pi * frequency * unit * times[middle]
    found, *_ = np.linalg.lstsq(np.column_stack([
        np.ones(len(angle)), np.sin(angle), np.cos(angle)]), stretch[middle])
    return float(np.hypot(*found[1:]))


# Feedback: H/L, factor of the given shear modulus, whether the modes are given; targets, noise,
# bias, and samples in a time scale. Largest error after the first move with modes, and largest
# excess over open loop without, in % of the step.
_FOLLOWED = ((0.5, 1.15, True), (1.0, 0.85, True), (2.0, 1.15, True), (1.0, 1.0, False))
_MOVES, _SHOWN, _BIAS, _DENSE = (1.1, 1.2, 1.05), 5e-4, 1e-3, 12.0
_CORRECTED, _WORSE = 5.0, 0.5


class _Elements(Plant):
    """A block on finite elements as a plant."""

    def __init__(self, shape: float, paper: Actuator, _: Bench, time: int) -> None:
        self._elements = elements_of(shape, paper)
        self._units, self.time, self._level, self._stretch = paper.model.units, time, 0.0, 1.0
        self.applied, self._levels = [], []

    def _begin_with(self, level: float) -> None:
        self._level = level

    def _go_on(self, time: int) -> float:
        if time > self.time and (self._level or self.applied):
            _, stretch = self._elements.follow([(
                1e-9 * (time - self.time) / self._units.time,
                float(self._units.of_level(self._level)))])
            self._stretch = float(stretch[-1])
        self.time = time
        return self._stretch


def followed(*, quick: bool) -> Sheet:
    """Return what moves leave in open loop and with feedback, with modes given or not."""
    rows, figures, passed = [], [], True
    for shape, factor, given in _FOLLOWED[1:2] if quick else _FOLLOWED:
        paper, block = blocks(shape)
        known = (block if given else paper).block
        bench = replace(
            drawn(0), given=replace(known, shear_modulus=factor * known.shear_modulus),
            block=known, noise=_SHOWN, bias=_BIAS, period=paper.block.time_unit / _DENSE,
            dropouts=0.0, targets=_MOVES)
        left = {way: [100.0 * x.size for x in bench_harm.run(
            bench, way, partial(_Elements, shape, paper), 'modal' if given else 'two_step')]
            for way in bench_harm.WAYS}
        plain, *corrected = left.values()
        passed &= max(max(x[1:]) for x in corrected) <= _CORRECTED if given else (
            float(np.max(np.subtract(corrected, plain))) <= _WORSE)
        rows.append([
            f'{shape:g}, {"its modes" if given else "none"}, {100.0 * (factor - 1.0):+.0f} %',
            *(', '.join(f'{x:.1f}' for x in y) for y in left.values())])
        figures.append({'shape': shape, 'factor': factor, 'modes': given, **left})
    return Sheet(
        'continuum_feedback',
        'Vibration and steady-state error together, in % of the step, of three moves on finite '
        f'elements, damping ratio {_RATIO:g}: to ' + ', '.join(f'{x:g}' for x in _MOVES),
        ('H/L, given modes, error of G', *bench_harm.WAYS), rows, {'rows': figures}, passed)


# Recordings for identification: targets of unshaped steps, periods on each, duration in s, rate in
# Hz, noise of the stretch, seeds of it, and targets of the plans.
_STEPS, _DWELL, _DURATION = (1.1, 1.0, 1.2, 1.1, 0.9, 1.0, 1.15, 1.0), 8.0, 2.0
_RATE, _NOISE, _SEEDS = 1000.0, 1e-3, 2
# Largest share of the step that plans from identified modes may leave on average, least part of
# the recordings to be identified and to have their second mode named, and ends of the coverage.
_LEFT, _IDENTIFIED, _NAMED, _COVERED = 2.0, 27 / 30, 0.9, (0.93, 0.97)
# Parameters of one recording are correlated: of ten recordings alone, 86 % were inside.
_OWN = 30


def recorded(shape: float) -> tuple[Actuator, Measurement]:
    """Return the paper's model of a block, and samples of its finite elements without noise."""
    paper, _ = blocks(shape)
    block = paper.block
    dwell, count = _DWELL * block.period, int(_DURATION / (_DWELL * block.period))
    times = np.append(0.0, 2.0 * block.period + dwell * np.arange(count))
    loads = np.append(0.0, elastic_force(np.resize(_STEPS, count), paper.model.material))
    unit = block.time_unit
    moved, stretch = elements_of(shape, paper).follow([*zip(
        np.diff(np.append(times, _DURATION)) / unit, loads.tolist(), strict=True)])
    samples = np.arange(int(_DURATION * _RATE)) / _RATE
    return paper, Measurement(
        samples, np.interp(samples, np.append(0.0, moved) * unit, np.append(1.0, stretch)), times,
        loads * block.flux_density_unit)


def advised(
        recording: Measurement, actuator: ActuatorParameters
) -> tuple[Identification, Identification]:
    """Return the identification with default options, and after its advice was followed."""
    plain = found = identify(recording, actuator=actuator)
    free = check_free(DEFAULT_FREE, actuator.law)
    for _ in range(4):
        remedy = next((x.remedy for x in found.signatures if x.found and x.remedy), '')
        if found.verdict != 'model_rejected' or not remedy:
            break
        found = identify(recording, (*free, *remedy.split(',')), actuator=actuator)
    return plain, found


def identified(*, quick: bool) -> Sheet:
    """Return how modes are identified from recordings of finite elements."""
    seeds = 1 if quick else _SEEDS
    rows, figures = [], list[dict[str, Any]]()
    for shape in [1.0] if quick else [*SHAPES]:
        paper, clean = recorded(shape)
        named, good, wrong, left, ratios = 0, 0, 0, list[float](), list[float]()
        for seed in range(seeds):
            random = np.random.default_rng(seed)
            recording = replace(clean, stretch=clean.stretch + _NOISE * random.standard_normal(
                len(clean.time)))
            plain, found = advised(recording, paper.block)
            named += 'second mode' in plain.reason
            remains = [
                _planned(shape, paper, found, target)
                for target in (TARGETS if seed == 0 else TARGETS[1:2])]
            good += found.verdict == 'identified'
            wrong += found.verdict == 'identified' and max(remains) > 2.0 * _LEFT
            left += remains
            ratios.append(found.modes[0].ratio[0] if found.modes else math.nan)
        rows.append([
            f'{shape:g}', f'{named} of {seeds}', f'{good} of {seeds}', f'{wrong} of {seeds}',
            f'{np.mean(left):.1f}', f'{np.max(left):.1f}', f'{np.nanmean(ratios):.2f}'])
        figures.append({
            'shape': shape, 'seeds': seeds, 'named': named, 'identified': good, 'wrong': wrong,
            'left': left, 'ratios': ratios})
    total = seeds * len(rows)
    sums = {x: sum(y[x] for y in figures) for x in ('named', 'identified', 'wrong')}
    every = np.concatenate([x['left'] for x in figures])
    rows.append([
        'all', *(f'{sums[x]} of {total}' for x in sums), f'{np.mean(every):.1f}',
        f'{np.max(every):.1f}', ''])
    return Sheet(
        'continuum_identification',
        f'Recordings of {_DURATION:g} s of unshaped steps on finite elements, noise '
        f'{_NOISE:g}: second mode named, then identified with the options that were advised; '
        'vibration in % of the step that `modal` leaves with these values, to 0.9, 1.1 and 1.2',
        ('H/L', 'second mode named', 'identified', 'identified and wrong', '`modal` leaves, mean',
         'most', 'f2/f1'), rows, {'rows': figures},
        bool(sums['identified'] >= _IDENTIFIED * total and sums['named'] >= _NAMED * total
             and sums['wrong'] == 0 and np.mean(every) <= _LEFT))


def _planned(shape: float, paper: Actuator, found: Identification, target: float) -> float:
    """Return what a plan with identified values leaves, in % of the step."""
    block = found.actuator
    move = get_shaper('modal')(MoveRequest(State(1.0), target, block.nondimensional))
    return _vibration(
        elements_of(shape, paper), _scaled(move, block, paper.block),
        block.period / paper.block.time_unit, target)


def covered(*, quick: bool) -> Sheet:
    """Return the coverage of the intervals of modes, for actuators that have these modes."""
    rows, figures, passed = [], [], True
    for count in (1, 2):
        runs = 2 if quick else _OWN
        good, inside, all_inside = 0, list[bool](), dict[str, list[bool]]()
        for seed in range(runs):
            known, true, recording = _drawn(count, seed)
            found = identify(
                recording, (*DEFAULT_FREE, MODES), actuator=known, known={'stretch_gain': 1.0})
            good += found.verdict == 'identified'
            values = values_of(true)
            for name in found.names:
                x = found.parameters[name]
                inside.append(x.low <= _true(name, found, values) <= x.high)
                all_inside.setdefault(name, []).append(inside[-1])
        rows.append([
            str(count), f'{good} of {runs}',
            f'{100.0 * np.mean(inside):.1f} % of {len(inside)}'])
        figures.append({
            'modes': count, 'runs': runs, 'identified': good, 'inside': float(np.mean(inside)),
            'by_name': {x: float(np.mean(y)) for x, y in all_inside.items()}})
        passed = passed and good >= _IDENTIFIED * runs
    return Sheet(
        'continuum_coverage',
        'Actuators of random shape, damping, mass factor and modes, simulated by the package: '
        f'recordings of {_DURATION:g} s, noise {_NOISE:g}, `--free +modes`',
        ('secondary modes', 'identified', 'values inside their 95 % intervals'), rows,
        {'rows': figures}, passed)


def _true(name: str, found: Identification, values: dict[str, Any]) -> float:
    """Return the true value of a parameter, for a mode that of the nearest frequency."""
    if not name.startswith('modes.'):
        return values[name]
    own = next(x for x in SECONDARY if name in x)
    ratio = found.values[own[0]]
    near = min(
        (x for x in SECONDARY if values[x[1]]), key=lambda x: abs(math.log(values[x[0]] / ratio)))
    return values[near[own.index(name)]]


def _drawn(count: int, seed: int) -> tuple[ActuatorParameters, ActuatorParameters, Measurement]:
    """Return a block as in a data sheet, the true one with modes, and a noisy recording."""
    random = np.random.default_rng((count, seed))
    ratio = random.uniform(0.03, 0.1)
    with unquestioned():
        known = Actuator(
            half_thickness=0.01 * random.uniform(0.5, 2.0), damping_ratio=ratio,
            chain_limit=random.uniform(3.0, 8.0)).block
    first = random.uniform(1.2, 2.2)
    ratios = (first, first * random.uniform(1.4, 2.0))[:count]
    true = replace(
        known, mass_factor=random.uniform(1.05, 1.5), remanence=0.1 * random.uniform(0.9, 1.1),
        modes=Modes(
            ratios, (random.uniform(0.08, 0.25), random.uniform(0.03, 0.1))[:count],
            tuple(min(ratio * x * random.uniform(0.7, 1.3), 0.4) for x in ratios)))
    dwell = _DWELL * known.period
    steps = int(_DURATION / dwell)
    times = np.append(0.0, 2.0 * known.period + dwell * np.arange(steps))
    levels = known.flux_density_unit * np.append(0.0, elastic_force(
        np.resize(_STEPS, steps), known.nondimensional))
    simulation = ActuatorSimulation(true)
    for time, level in zip(times.tolist(), levels.tolist(), strict=True):
        simulation.command(round(1e9 * time), level)
    samples = np.arange(int(_DURATION * _RATE)) / _RATE
    stretch = np.empty(len(samples))
    for i, time in enumerate(samples.tolist()):
        simulation.advance(round(1e9 * time))
        stretch[i] = simulation.stretch
    return known, true, Measurement(
        samples, stretch + _NOISE * random.standard_normal(len(samples)), times, levels)
