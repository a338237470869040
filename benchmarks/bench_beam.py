"""
Commands for a beam on an exact rod, which has every mode.

    python -m benchmarks beam [--quick] [--runs N]

Material, size and damping are known exactly. Of each move from rest to rest, the vibration of the
deflection in the first period of the first mode after arrival, peak to peak, and in brackets where
it rests beside the target, both in % of the step; and the move time of modal in units of that of
the two-step command.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from benchmarks.beam_rod import FIRST, Rod
from benchmarks.bench_continuum import advised
from benchmarks.sheet import Sheet
from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.identification.measurement import Measurement
from hmsa.model.equations import elastic_force
from hmsa.model.laws.bending import deflection
from hmsa.model.laws.elastica import FIRST_SHARE
from hmsa.model.moves import Move, State
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

#: Random sequences of angles.
RUNS = 4
# Angles of the tip in the first mode, in degrees, and damping ratios.
_ANGLES = (0.0, 5.0, 0.0, 30.0, 70.0, 45.0, 30.0, 0.0, 70.0, 5.0, 70.0, -70.0)
_RATIOS = (0.02, 0.05)
_MOVES, _LARGEST = 6, 70.0
# Limits of what modal may leave, and of where it may rest, in %; and of its time.
_MOST, _MOST_BESIDE, _LONGEST = 1.0, 0.1, 1.35
# Periods of the first mode after arrival that are followed, and samples in them.
_PERIODS, _SAMPLES = 4, 800
# Moves of a recording, periods on each, points that the rod computes between two levels, samples
# in a period and their noise; error of the remanence from which an identification is wrong.
_STEPS, _DWELL, _RECORDED, _RATE, _NOISE, _WRONG = 8, 12.0, 400, 18.0, 1e-3, 0.01
_SWINGS = 30.0  # largest angle, of which steps overshoot
# Smallest move of a random sequence in degrees, of which the rod still tells 0.1 %.
_SMALLEST = 3.0


@dataclass(frozen=True)
class _Found:
    """What a command leaves, in % of the step, and its duration."""

    vibration: float
    beside: float
    duration: float

    def __str__(self) -> str:
        return f'{self.vibration:.2f} ({self.beside:+.2f})'


@dataclass(frozen=True)
class _Laboratory:
    """A rod, and commands that know its data."""

    ratio: float

    def actuator(self, mount: str) -> Actuator:
        """Return the strip as the package has it."""
        with unquestioned():  # of its weight
            return Actuator.beam(
                length=25e-3, thickness=1e-3, width=5e-3, youngs_modulus=1e6, density=2000.0,
                damping_ratio=self.ratio, mount=mount)

    def move(self, start: float, target: float, mount: str, shaper: str) -> Move:
        """Return the command of a move between two deflections."""
        return get_shaper(shaper)(
            MoveRequest(State(start), target, self.actuator(mount).model.material))

    def moved(self, start: float, target: float, mount: str, shaper: str) -> _Found:
        """Return what a move between two deflections leaves."""
        material, rod = self.actuator(mount).model.material, Rod(self.ratio)
        # Tables and rod: first frequencies of sqrt(3) and FIRST, loads over FIRST_SHARE and 1.
        unit, load = FIRST / math.sqrt(3.0), 1.0 / FIRST_SHARE
        move = self.move(start, target, mount, shaper)
        holding = rod.load_for(target)
        period = 2.0 * math.pi / float(rod.frequencies(holding)[0])
        ends = [x.time / unit for x in move.levels[1:]]
        pieces = [(end - x.time / unit, load * x.load) for x, end in zip(
            move.levels, [*ends, move.duration / unit + _PERIODS * period], strict=True)]
        begin = load * float(elastic_force(start, material))
        times, bent = rod.follow(begin, pieces, _SAMPLES)
        after = times - move.duration / unit
        first = bent[(after >= 0.0) & (after <= period)]
        last = bent[after >= (_PERIODS - 1) * period]
        step = target - start
        return _Found(
            100.0 * float(np.ptp(first)) / abs(step),
            100.0 * (0.5 * float(np.max(last) + np.min(last)) - target) / step, move.duration)


def compare(*, quick: bool) -> Sheet:
    """Return what is left between some bent states."""
    rows, figures, passed = [], [], True
    for ratio in _RATIOS[:1] if quick else _RATIOS:
        laboratory = _Laboratory(ratio)
        for start, target in _pairs(_ANGLES[:3] if quick else _ANGLES):
            begin, end = _of_degrees(start), _of_degrees(target)
            mode, two, modal = (laboratory.moved(begin, end, *x) for x in (
                ('paper', 'two_step'), ('clamped', 'two_step'), ('clamped', 'modal')))
            time = modal.duration / two.duration
            passed = passed and _kept(modal, time)
            rows.append([
                f'{ratio:g}: {start:g} to {target:g}', str(mode), str(two), str(modal),
                f'{time:.2f}'])
            figures.append({
                'ratio': ratio, 'start': start, 'target': target, 'time': time,
                **{x: (y.vibration, y.beside) for x, y in (
                    ('mode', mode), ('two_step', two), ('modal', modal))}})
    return Sheet(
        'beam', 'Vibration (steady-state error) in % of the step on an exact rod',
        ('damping ratio: degrees', "`two_step`, mode's shape", '`two_step`, elastica', '`modal`',
         'time'), rows, {'rows': figures}, passed)


def sequences(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Return the largest of what modal leaves in random sequences."""
    random = np.random.default_rng(48)
    rows, figures, passed = [], [], True
    for ratio in _RATIOS[:1] if quick else _RATIOS:
        found, times = [], []
        for _ in range(1 if quick else runs):
            angles = _random(random, 2 if quick else _MOVES)
            for start, target in _pairs(angles):
                begin, end = _of_degrees(start), _of_degrees(target)
                move = _Laboratory(ratio).moved(begin, end, 'clamped', 'modal')
                two = _Laboratory(ratio).move(begin, end, 'clamped', 'two_step')
                found.append(move)
                times.append(move.duration / two.duration)
                passed = passed and _kept(move, times[-1])
        most, beside = max(x.vibration for x in found), max(abs(x.beside) for x in found)
        rows.append([
            f'{ratio:g}', str(len(found)),
            f'{float(np.median([x.vibration for x in found])):.2f}', f'{most:.2f}',
            f'{beside:.3f}', f'{max(times):.2f}'])
        figures.append({
            'ratio': ratio, 'moves': len(found), 'vibration': most, 'beside': beside,
            'time': max(times)})
    return Sheet(
        'beam-sequences', f'`modal` in random sequences of angles to {_LARGEST:g} degrees',
        ('damping ratio', 'moves', 'vibration, median', 'largest', 'steady-state error, largest',
         'time, longest'), rows, {'rows': figures}, passed)


def identified(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Return how recordings of random angles identify the beam, whose mode's shape is given."""
    rows, figures, sums = [], [], [0, 0, 0, 0]
    for ratio in _RATIOS[:1] if quick else _RATIOS:
        for shaper in ('step', 'two_step'):
            counts, errors = [0, 0, 0], list[float]()
            for seed in range(1 if quick else runs):
                strip, recording = _recorded(ratio, shaper, seed)
                plain, found = advised(recording, strip.block)
                counts[0] += 'second mode' in plain.reason
                if found.verdict == 'identified':
                    errors.append(found.actuator.remanence / strip.block.remanence - 1.0)
                    counts[1] += 1
                    counts[2] += abs(errors[-1]) > _WRONG
            total = 1 if quick else runs
            sums = [x + y for x, y in zip(sums, (*counts, total), strict=True)]
            worst = 100.0 * max(errors, key=abs, default=math.nan)
            rows.append([
                f'{ratio:g}, {shaper}', *(f'{x} of {total}' for x in counts), f'{worst:+.2f}'])
            figures.append({'ratio': ratio, 'shaper': shaper, 'counts': counts, 'errors': errors})
    rows.append(['all', *(f'{x} of {sums[3]}' for x in sums[:3]), ''])
    return Sheet(
        'beam-identification',
        f'Recordings of {_STEPS} moves on an exact rod, noise {_NOISE:g}: second mode named, then '
        'identified with the options that were advised; wrong: remanence more than '
        f'{100.0 * _WRONG:g} % off',
        ('damping ratio, moves', 'second mode named', 'identified', 'identified and wrong',
         'largest error of the remanence in %'),
        rows, {'rows': figures}, sums[2] == 0)


def _recorded(ratio: float, shaper: str, seed: int) -> tuple[Actuator, Measurement]:
    """Return the beam in its mode's shape, and a noisy recording of moves to random angles."""
    laboratory, random = _Laboratory(ratio), np.random.default_rng((seed, round(100.0 * ratio)))
    actuator, rod = laboratory.actuator('paper'), Rod(ratio)
    period = actuator.block.period
    angles = _random(random, _STEPS, _SWINGS)
    plan = actuator.plan([(_of_degrees(x), _DWELL * period) for x in angles[1:]], shaper)
    times = np.append(0.0, plan.times + period)
    fields = np.append(0.0, plan.flux_densities)
    scale = FIRST / math.sqrt(3.0) * actuator.block.time_unit
    ends = np.append(times[1:], period * (1.0 + _DWELL * _STEPS))
    moved, bent = rod.follow(0.0, [
        ((end - begin) / scale, float(actuator.model.units.of_level(level)) / FIRST_SHARE)
        for begin, end, level in zip(times, ends, fields, strict=True)], _RECORDED)
    samples = np.arange(0.0, ends[-1], period / _RATE)
    return actuator, Measurement(
        samples, np.interp(samples, moved * scale, bent) + _NOISE * random.standard_normal(
            len(samples)), times, fields, coordinate=actuator.block.coordinate)


def _kept(found: _Found, time: float) -> bool:
    return found.vibration <= _MOST and abs(found.beside) <= _MOST_BESIDE and time <= _LONGEST


def _pairs(angles: Sequence[float]) -> Iterator[tuple[float, float]]:
    return zip(angles, angles[1:], strict=False)


def _random(
        random: np.random.Generator, moves: int, largest: float = _LARGEST) -> list[float]:
    """Return angles in degrees, each some way from the one before."""
    angles = [0.0]
    while len(angles) <= moves:
        angle = round(float(random.uniform(-largest, largest)), 1)
        if abs(angle - angles[-1]) >= _SMALLEST:
            angles.append(angle)
    return angles


def _of_degrees(angle: float) -> float:
    return float(deflection(math.radians(angle)))
