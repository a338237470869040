"""
Repeats that `hmsa learn` corrects, on plants that share no equation with the package.

    python -m benchmarks repeats [--quick]

The paper's model, or one with the modes, plans a sequence for a block on finite elements, and for
a beam that is an exact rod; each further repeat has the levels learnt from those before it.
Vibration is that in the first period after the learnt moves, peak to peak, the larger of two
setpoints, in % of the step.
"""

from collections.abc import Callable
from functools import partial
import math

import numpy as np

from benchmarks.beam_rod import FIRST, Rod
from benchmarks.bench_continuum import blocks, elements_of
from benchmarks.sheet import Sheet
from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.identification.learning import learn, SequenceRepeat, TargetWindow
from hmsa.model.equations import Array, natural_frequency
from hmsa.model.laws.elastica import FIRST_SHARE

#: Repeats after the first one, H/L of free blocks and of those glued with a face, and words for a
#: plan without modes.
REPEATS, BLOCKS, GLUED, UNKNOWN = 6, (0.1, 0.5, 1.0, 2.0), (0.25, 0.5, 1.0), 'modes unknown'
_BEAM_RATIO = 0.03  # damping ratio of the beam
# Periods that a setpoint is held, samples in each, and their noise relative to the step.
_HOLD, _SAMPLES, _NOISE = 10, 60, 1e-3
# What may be left at the end, in %.
_MOST = 1.0

Plant = Callable[[Array, Array, Array], Array]


def compare(*, quick: bool) -> Sheet:
    """Return what each repeat leaves; passed if the last one leaves little."""
    cases: dict[str, Callable[[], list[float]]] = {
        f'block, H/L {x:g}, {UNKNOWN}': partial(_block, x, 'free', known=False)
        for x in ((1.0,) if quick else BLOCKS)}
    if not quick:
        for x in GLUED:
            cases |= {
                f'glued block, H/L {x:g}': partial(_block, x, 'glued'),
                f'glued block, H/L {x:g}, {UNKNOWN}': partial(_block, x, 'glued', known=False)}
        cases['beam, 0.3 and back'] = _beam
    found = {name: case() for name, case in cases.items()}
    return Sheet(
        'repeats', 'Vibration in % of the step in repeats that `hmsa learn` corrects',
        ('plant', 'planned', *map(str, range(1, REPEATS + 1))),
        [[name, *(f'{x:.2f}' for x in left)] for name, left in found.items()],
        {'rows': found}, all(
            y[-1] <= _MOST for x, y in found.items() if not (UNKNOWN in x and 'glued' in x)))


def _block(shape: float, mount: str, *, known: bool = True) -> list[float]:
    """Return what repeats of a block leave, of which the plan knows the modes or does not."""
    paper, mounted = blocks(shape, mount=mount)
    unit = paper.block.time_unit

    def play(times: Array, levels: Array, samples: Array) -> Array:
        ends = np.append(times[1:], samples[-1]) / unit
        seen, stretch = elements_of(shape, paper, mount).follow(list(zip(
            (ends - times / unit).tolist(), paper.model.units.of_level(levels).tolist(),
            strict=True)))
        return np.interp(samples / unit, seen, stretch, left=1.0)

    # The first frequency of a glued block is down to half of that of the paper's model.
    periods = 2.0 * _HOLD if mount == 'glued' and not known else _HOLD
    return _left(mounted if known else paper, (1.1, 1.0), play, periods,
                 'modal' if known else 'two_step')


def _beam() -> list[float]:
    with unquestioned():  # of its weight
        beam = Actuator.beam(
            length=25e-3, thickness=1e-3, width=5e-3, youngs_modulus=1e6, density=2000.0,
            damping_ratio=_BEAM_RATIO)
    unit, load = beam.block.time_unit * FIRST / math.sqrt(3.0), 1.0 / FIRST_SHARE

    def play(times: Array, levels: Array, samples: Array) -> Array:
        ends = np.append(times[1:], samples[-1]) / unit
        period = 2.0 * math.pi / FIRST
        seen, bent = Rod(_BEAM_RATIO).follow(0.0, list(zip(
            (ends - times / unit).tolist(), (load * beam.model.units.of_level(levels)).tolist(),
            strict=True)), round(_SAMPLES * ends[-1] / period))
        return np.interp(samples / unit, seen, bent, left=0.0)

    return _left(beam, (0.3, 0.0), play)


def _left(
        actuator: Actuator, setpoints: tuple[float, ...], play: Plant,
        periods: float = _HOLD, shaper: str = 'two_step') -> list[float]:
    """Return the vibration of each repeat in %."""
    block, random = actuator.block, np.random.default_rng(7)
    period = 2.0 * math.pi * block.time_unit / float(
        natural_frequency(block.rest, actuator.model.material))
    hold = periods * period
    steps = np.abs(np.diff((block.rest, *setpoints)))
    plan = np.asarray(actuator.plan([(x, hold) for x in setpoints], shaper).levels)
    times, levels = plan[plan[:, 0] < hold * len(setpoints) * (1.0 - 1e-9)].T
    targets = [TargetWindow(x, i * hold, (i + 1) * hold) for i, x in enumerate(setpoints)]
    samples: Array = np.arange(
        0.0, hold * len(setpoints), period / _SAMPLES, dtype=np.float64)
    played: list[Array] = []
    repeats: list[SequenceRepeat] = []
    for _ in range(REPEATS + 1):
        played.append(play(times, levels, samples))
        repeats.append(SequenceRepeat(
            samples, played[-1] + _NOISE * float(np.min(steps)) * random.standard_normal(
                len(samples)), times, levels))
        found = learn(repeats, targets, block, (-0.5, 0.5))
        times, levels = found.level_times, found.levels
    return [max(
        100.0 * float(np.ptp(x[(samples >= rest) & (samples < rest + period)])) / float(step)
        for rest, step in zip(found.rests, steps, strict=True)) for x in played]
