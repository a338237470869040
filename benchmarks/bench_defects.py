"""
What `hmsa identify` says of actuators that are not as the model has them.

    python -m benchmarks defects [--runs N] [--quick]

Recordings come from `benchmarks.defects`: SciPy integrates actuators with damping, chain limit,
modulus and remanence drawn at random, each with one defect of a size drawn at random, and a sensor
with white, coloured, quantised or jittered noise, at 4 to 60 samples a period. The fit begins from
a data sheet that is up to 30 % off. An answer is wrong if it is ``identified`` and an interval
does not hold the true value.
"""

import math

import numpy as np

from benchmarks.defects import away, measured, motion, plants, Sensor, sequence
from benchmarks.sheet import Sheet
from hmsa_ros.errors import HmsaError
from hmsa_ros.identification import identify

#: Recordings of each defect, and how many times as many without one.
RUNS, _EXACT = 30, 4
_SENSORS = ('white', 'coloured', 'quantised', 'jittered')
#: Size of each defect, low and high, and what is recorded.
KINDS: dict[str, tuple[str, dict[str, tuple[float, float]]]] = {
    'exact': ('nothing', {}),
    'friction': ('Coulomb friction, 0.3 to 3 % of G', {'friction': (0.003, 0.03)}),
    'drag': ('damping by the square of the rate', {'drag': (0.1, 1.0)}),
    'second': ('a second mode, 0.5 to 3 %', {'second': (0.005, 0.03), 'higher': (2.5, 6.0)}),
    'gain': ('gain of the sensor 2 % off', {'gain': (0.02, 0.0200001)}),
    'hysteresis': ('hysteresis of the coil, 0.5 to 2 %', {'hysteresis': (0.005, 0.02)}),
    'law': ('another elastic law, 10 to 50 % of it', {'foreign': (0.1, 0.5)}),
    'latency': ('latency, 0.2 to 3 % of the time unit', {'latency': (0.002, 0.03)}),
    'few': ('0.7 to 4 samples a period, one or three steps', {})}
_SEED, _FEW = 1, (0.7, 1.5, 4.0)
# What may be wrong of a kind, the least share that is identified where the model is right, and
# between what the coverage of its intervals lies.
_WRONG, _IDENTIFIED, _COVERAGE = 1, 0.97, (0.93, 0.97)


def drawn(kind: str, count: int, seed: int = _SEED) -> list[tuple[str, list[bool]]]:
    """Identify recordings of a kind; return verdicts, and which intervals hold the truth."""
    found = []
    given = plants(count, seed, **KINDS[kind][1])
    layouts = [((1.3,), 1), ((1.1, 1.4, 1.0), 1)] if kind == 'few' else [((1.1, 1.4, 1.0), 9)]
    for place, (targets, repeats) in enumerate(layouts):
        switches, levels, end = sequence(given, targets, repeats)
        seen = motion(given, switches, levels, end)
        for i in range(place, count, len(layouts)):
            random = np.random.default_rng((seed, i, 7))
            sensor = Sensor(
                _FEW[i % len(_FEW)] if kind == 'few' else math.exp(
                    random.uniform(math.log(4.0), math.log(60.0))),
                math.exp(random.uniform(math.log(3e-4), math.log(2e-3))),
                _SENSORS[i % len(_SENSORS)])
            try:
                answer = identify(
                    measured(i, given, seen, switches, levels, end, sensor, seed),
                    actuator=away(given.block(i), random))
            except HmsaError as error:
                found.append((f'refused: {error}', []))
                continue
            found.append((answer.verdict, [
                answer.parameters[x].low <= getattr(given.block(i), x) <= answer.parameters[x].high
                for x in answer.names if hasattr(given.block(i), x)]))
    return found


def compare(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Identify all of them; passed if the goals hold."""
    rows, figures, passed = [], {}, True
    for kind, (words, _) in KINDS.items():
        answers = drawn(kind, (4 if quick else runs) * (_EXACT if kind == 'exact' else 1))
        verdicts = [x for x, _ in answers]
        sure = [y for x, y in answers if x == 'identified']
        wrong = sum(not all(x) for x in sure)
        inside = [y for x in sure for y in x]
        cover = sum(inside) / len(inside) if inside else math.nan
        counts = {x: verdicts.count(x) for x in (
            'identified', 'model_rejected', 'not_identifiable')}
        counts['refused'] = len(verdicts) - sum(counts.values())
        figures[kind] = {**counts, 'runs': len(answers), 'wrong': wrong, 'coverage': cover}
        rows.append([words, str(len(answers)), *map(str, counts.values()),
                     '-' if kind == 'exact' else str(wrong),
                     f'{100.0 * cover:.1f} %' if inside else '-'])
        if kind == 'exact':
            passed &= counts['identified'] >= _IDENTIFIED * len(answers) and (
                _COVERAGE[0] <= cover <= _COVERAGE[1])
        else:
            passed &= wrong <= _WRONG * max(len(answers) / RUNS, 1.0)
    return Sheet(
        'defects', 'Identification of actuators that are not as the model has them', (
            'wrong', 'recordings', 'identified', 'model_rejected', 'not_identifiable', 'refused',
            'identified and not covered', 'coverage of 95 %'), rows, figures, quick or passed)
