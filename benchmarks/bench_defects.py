"""
Evaluate `hmsa identify` on actuators that deviate from the model.

    python -m benchmarks defects [--runs N] [--quick]

Recordings come from `benchmarks.defects`: SciPy integrates actuators with random damping, J_lim,
modulus and remanence. Each has one defect of random size and a sensor with white, coloured,
quantised or jittered noise, at 4 to 60 samples a period. Others have no defect but few samples
with large noise, or samples at rest alone. The fit starts from a data sheet with errors up to
30 %. A result is wrong if it is ``identified`` and an interval does not cover the true value.
Without a defect, one interval in twenty does not by design: there a result is wrong if an error
is more than twice what the interval allows.
"""

from dataclasses import replace
import math
from typing import Any

import numpy as np

from benchmarks.defects import away, measured, motion, PERIOD, plants, Sensor, sequence
from benchmarks.sheet import Sheet
from hmsa.errors import HmsaError
from hmsa.identification.identify import identify
from hmsa.identification.quantities import DEFAULT_FREE
from hmsa.identification.result import Estimate

#: Recordings of each defect, and the factor for those without one.
RUNS, _EXACT = 30, 4
_SENSORS = ('white', 'coloured', 'quantised', 'jittered')
#: Description of each kind of recording, and the range of size of its defect.
KINDS: dict[str, tuple[str, dict[str, tuple[float, float]]]] = {
    'exact': ('nothing', {}),
    'friction': ('Coulomb friction, 0.3 to 3 % of G', {'friction': (0.003, 0.03)}),
    'drag': ('damping by the square of the rate', {'drag': (0.1, 1.0)}),
    'second': ('a second mode, 0.5 to 3 %', {'second': (0.005, 0.03), 'higher': (2.5, 6.0)}),
    'gain': ('sensor gain with a 2 % error', {'gain': (0.02, 0.0200001)}),
    'hysteresis': ('hysteresis of the coil, 0.5 to 2 %', {'hysteresis': (0.005, 0.02)}),
    'law': ('another hyperelastic model, 10 to 50 % of it', {'foreign': (0.1, 0.5)}),
    'latency': ('latency, 0.2 to 3 % of the time unit', {'latency': (0.002, 0.03)}),
    'one': ('one step, 16 to 61 samples, 1.5 to 4 a period, noise 0.001 to 0.03', {}),
    'slow': ('0.7 to 2 samples a period', {}),
    'rest': ('16 samples, all of them at rest', {})}
_SEED = 1
# For a step, whose stretch cannot determine J_lim.
_WITHOUT_LIMIT = tuple(x for x in DEFAULT_FREE if x != 'chain_limit')
# Allowed wrong results of a kind; where the model is right, the minimum fraction identified, the
# range of the coverage of the intervals, and the chance of missing it.
_WRONG, _IDENTIFIED, _COVERAGE, _CHANCE = 1, 0.97, (0.93, 0.97), 0.01


def drawn(kind: str, count: int, seed: int = _SEED) -> list[tuple[str, list[float]]]:
    """Identify recordings of a kind; return verdicts, and errors relative to their intervals."""
    found: list[tuple[str, list[float]]] = []
    given = plants(count, seed, **KINDS[kind][1])
    layout = {'one': sequence(given, (1.3,), 1, 110.0), 'rest': sequence(
        given, (1.1, 1.3, 0.9, 1.4, 1.2, 1.5, 1.0, 1.25), 1, 100.0)}.get(kind, sequence(given))
    seen = motion(given, *layout)
    for i in range(count):
        random = np.random.default_rng((seed, i, 7))
        block, start = given.block(i), away(given.block(i), random)
        free: tuple[str, ...] = DEFAULT_FREE
        at: Any = None

        def between(low: float, high: float, random: np.random.Generator = random) -> float:
            return math.exp(random.uniform(math.log(low), math.log(high)))

        sensor = Sensor(
            between(4.0, 60.0), between(3e-4, 2e-3), _SENSORS[i % len(_SENSORS)])
        if kind == 'one':
            sensor = Sensor(between(1.5, 4.2), between(1e-3, 3e-2))
            at = 0.05 + PERIOD / sensor.per_period * np.arange((16, 30, 61)[i % 3])
            free, start = _WITHOUT_LIMIT, replace(start, chain_limit=block.chain_limit)
        elif kind == 'slow':
            sensor = Sensor(between(0.7, 2.0), sensor.noise, sensor.kind)
        elif kind == 'rest':
            at = np.sort(np.append(*(
                layout[0][1:] + 100.0 * random.uniform(0.6, 0.99, 8) for _ in range(2))))
        try:
            answer = identify(
                measured(i, given, seen, *layout, sensor, seed, at), actuator=start, free=free)
        except HmsaError as error:
            found.append((f'refused: {error}', []))
            continue
        found.append((answer.verdict, [
            _reach(answer.parameters[x], getattr(block, x))
            for x in answer.names if hasattr(block, x)]))
    return found


def _reach(found: Estimate, true: float) -> float:
    """Return the error of a value relative to the half of its interval on that side."""
    end = found.high if true > found.value else found.low
    return (true - found.value) / (end - found.value)


def compare(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Identify recordings of all kinds; passed if the goals are met."""
    rows, figures, passed = [], {}, True
    for kind, (words, _) in KINDS.items():
        answers = drawn(kind, (4 if quick else runs) * (_EXACT if kind == 'exact' else 1))
        verdicts = [x for x, _ in answers]
        sure = [y for x, y in answers if x == 'identified']
        right = not KINDS[kind][1]
        wrong = sum(max(x) > (2.0 if right else 1.0) for x in sure)
        inside = [y <= 1.0 for x in sure for y in x]
        cover = sum(inside) / len(inside) if inside else math.nan
        counts = {x: verdicts.count(x) for x in (
            'identified', 'model_rejected', 'not_identifiable')}
        counts['refused'] = len(verdicts) - sum(counts.values())
        figures[kind] = {**counts, 'runs': len(answers), 'wrong': wrong, 'coverage': cover}
        rows.append([words, str(len(answers)), *map(str, counts.values()),
                     str(wrong), f'{100.0 * cover:.1f} %' if inside else '-'])
        if kind == 'exact':
            from scipy.stats import binom  # slow to import
            passed &= counts['identified'] >= _IDENTIFIED * len(answers) and (
                binom.ppf(_CHANCE, len(inside), _COVERAGE[0]) <= sum(inside)
                <= binom.ppf(1.0 - _CHANCE, len(inside), _COVERAGE[1]))
        else:
            passed &= wrong <= _WRONG * max(len(answers) / RUNS, 1.0)
    return Sheet(
        'defects', 'Identification of actuators with a defect that the model lacks, and of few '
        'samples', (
            'wrong', 'recordings', 'identified', 'model_rejected', 'not_identifiable', 'refused',
            'identified and wrong', 'coverage of 95 %'), rows, figures, quick or passed)
