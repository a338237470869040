"""
Compare verdicts on random runs with the truth.

    python -m benchmarks judge [--runs N] [--quick]

The held stretch of a setpoint is given in closed form: an offset, a vibration that decays or
persists, and creep. Its samples are noisy, sparse, late or broken. A verdict is wrong if it is
``arrived`` where offset or vibration exceed their tolerance, or ``off_target`` or ``vibrating``
where neither does; where the sensor hides the truth, any other verdict is right. The seed of a
run is its number, so each can be drawn again.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from benchmarks.sheet import Sheet
from hmsa.judge.judging import judge
from hmsa.judge.records import RequestedSetpoint, Tolerances
from hmsa.model.equations import Array

#: Runs of each kind.
RUNS = 200
KINDS = {
    'white': 'white noise', 'coloured': 'coloured noise', 'jitter': 'jitter of the timestamps',
    'dropouts': 'dropouts', 'quantised': 'quantised', 'creep': 'creep after the arrival',
    'undamped': 'no damping', 'rare': '4 to 8 samples a period',
    'short': '1.5 to 3 periods', 'frozen': 'sensor frozen on the way',
    'nan': 'sensor not a number', 'out': 'sensor out of range',
    'unordered': 'in no order, repeated', 'edge': 'within 20 % of the tolerance',
    'transient': 'pushed once during the hold',
    'second': 'second mode, 1.25 to 2 tolerances', 'both': 'first and second mode',
    'damped': 'the same second mode, damping ratio 0.03 to 0.1'}
#: Kinds in which some or all samples do not show the stretch.
BROKEN = ('frozen', 'nan', 'out')
TOLERANCES = Tolerances(arrival=0.02, vibration=0.02, stretch=1e-3)
ARRIVED, MISSED = ('arrived',), ('off_target', 'vibrating')
# A verdict is required where the truth is at least this many standard deviations of the best
# possible estimate away from the tolerance.
_CLEAR = 15.0
# Periods at the start and at the end of a creeping setpoint over which its rest is averaged.
_SLICE = 6
_FINE = 400
# Second modes: range of their frequencies relative to the first, samples in a period of the first,
# and noise relative to the step.
_RATIOS, _SAMPLES, _NOISE = (1.2, 6.5), 60, 0.003
# Kinds of these, with the range of their damping ratios; the last two are second modes alone.
_DAMPED = {'both': (0.0, 0.03), 'second': (0.0, 0.03), 'damped': (0.03, 0.1)}
# Multiple of the tolerance from which a push counts as beyond it.
_BEYOND = 1.2
# Peak-to-peak noise in a period that is rarely exceeded, in standard deviations.
_PEAKS = 7.0
_ARRIVAL = 10**18


@dataclass(frozen=True)
class Trial:
    """A setpoint with its samples; times in ns."""

    seed: int
    kind: str
    setpoint: RequestedSetpoint
    time: np.ndarray  # (n,): timestamps, with those of the move and of the setpoint before
    stretch: np.ndarray  # (n,)
    within: bool | None  # None where either answer is acceptable
    clarity: float  # distance of the truth from the tolerance, in standard deviations
    words: str  # description of the draw


@dataclass(frozen=True)
class Truth:
    """How a setpoint is held; times in s from the planned arrival, stretches about the target."""

    offset: float
    amplitude: float
    phase: float
    omega: float
    decay: float
    creep: float
    slow: float
    second: float = 0.0  #: amplitude of a second mode
    ratio: float = 1.0  #: frequency and decay of it, relative to the first

    def rests(self, time: np.ndarray) -> np.ndarray:
        """Return the mean over periods."""
        return np.asarray(self.offset + self.creep * np.exp(-time / self.slow))

    def vibrates(self, time: np.ndarray) -> np.ndarray:
        """Return the vibration about the mean."""
        return np.asarray(sum(
            size * np.exp(-x * self.decay * time) * np.cos(x * self.omega * time + x * self.phase)
            for size, x in ((self.amplitude, 1.0), (self.second, self.ratio))))

    def stretch(self, time: np.ndarray, step: float, move: float) -> np.ndarray:
        """Return the stretch from ``step`` before the setpoint, in a move of duration ``move``."""
        share = np.clip(1.0 + time / move, 0.0, 1.0)
        smooth = 0.5 - 0.5 * np.cos(np.pi * share)
        after = np.maximum(time, 0.0)
        return np.asarray(
            -step * (1.0 - smooth) + smooth * (self.rests(after) + self.vibrates(after)))


def draw(seed: int, kind: str) -> Trial:
    """Draw a run."""
    random = np.random.default_rng([seed, list(KINDS).index(kind)])

    def spread(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    size = spread(0.02, 0.5)
    step = size * float(random.choice([-1.0, 1.0]))
    start = random.uniform(0.8, 1.3) + (size if step < 0.0 else 0.0)
    model = 2.0 * math.pi * spread(2.0, 100.0)
    decay = model * spread(0.01, 0.3)
    period = 2.0 * math.pi / model
    hold = period * (random.uniform(1.5, 3.0) if kind == 'short' else spread(1.5, 40.0))
    interval = period / (random.uniform(4.0, 8.0) if kind == 'rare' else spread(4.0, 200.0))
    noise = size * spread(1e-5, 0.05)
    limit = max(0.02 * size, 1e-3)
    creeps = kind == 'creep'
    truth = Truth(
        size * float(random.choice([0.0, random.uniform(-0.1, 0.1)])),
        0.5 * size * float(random.choice([0.0, random.uniform(0.0, 0.1)])),
        random.uniform(0.0, 2.0 * math.pi), model * random.uniform(0.6, 1.6),
        0.0 if kind == 'undamped' else decay * random.uniform(0.0, 2.0),
        size * random.uniform(-0.06, 0.06) if creeps else 0.0,
        hold * spread(0.1, 3.0) if creeps else 1.0)
    if kind == 'edge':
        share, off = limit * random.uniform(0.8, 1.2), random.uniform() < 0.5
        truth = replace(truth, offset=share * off, amplitude=0.5 * share * (not off))
    if kind in _DAMPED:
        interval, noise, hold = period / _SAMPLES, _NOISE * size, max(hold, 6.0 * period)
        if kind == 'both':
            noise = size * spread(1e-5, 0.01)
        first = limit * random.uniform(0.0, 2.0) * (kind == 'both')
        second = limit * (random.uniform(0.0, 2.0) if kind == 'both'
                          else random.uniform(1.25, 2.0))
        truth = Truth(
            0.0, 0.5 * first, random.uniform(0.0, 2.0 * math.pi),
            model * random.uniform(0.85, 1.1), model * random.uniform(*_DAMPED[kind]), 0.0, 1.0,
            0.5 * second, spread(*_RATIOS))
        if kind != 'both':
            # Peak to peak, whatever its phase and decay.
            shown = np.ptp(truth.vibrates(np.linspace(0.0, hold, 40 * _SAMPLES)))
            truth = replace(truth, second=0.5 * second**2 / float(shown))
    move = 0.6 * period
    time: Array = np.arange(
        -random.uniform(1.0, 2.0) * period - move, hold, interval, dtype=np.float64)
    stamps = time
    if kind == 'dropouts':
        left = random.uniform(size=len(time)) > random.uniform(0.05, 0.7)
        left &= np.abs(time - random.uniform(0.0, hold)) > 0.15 * hold * random.uniform()
        time = stamps = time[left]
    if kind == 'jitter':
        stamps = time + interval * random.uniform(0.0, 0.2) * random.standard_normal(len(time))
    white, correlation, quantum = random.standard_normal(len(time)), 0.0, 0.0
    if kind == 'coloured':
        from scipy.signal import lfilter  # slow to import
        correlation = random.uniform(0.3, 0.97)
        white[1:] *= math.sqrt(1.0 - correlation ** 2)
        white = lfilter([1.0], [1.0, -correlation], white)
    target = start + step
    push = 0.0
    if kind == 'transient':
        # A push without vibration, at times as short as a tenth of a period.
        push = size * random.uniform(-0.15, 0.15)
        width, middle = period * spread(0.05, 1.5), random.uniform(0.0, hold)
        truth = replace(truth, amplitude=0.0, offset=0.1 * truth.offset)
    stretch = target + truth.stretch(time, step, move) + noise * white
    if push:
        stretch += _bump(time, push, width, middle)
    if kind == 'quantised':
        quantum = size * spread(1e-3, 0.03)
        stretch = quantum * np.round(stretch / quantum)
    if kind == 'frozen':
        # During the move or during the hold.
        begin = int(np.searchsorted(time, random.choice([
            random.uniform(-move, 0.0), random.uniform(0.0, hold)])))
        stretch[begin:] = stretch[min(begin, len(stretch) - 1)]
    elif kind in BROKEN:
        broken = random.uniform(size=len(stretch)) < random.choice([1.0, random.uniform()])
        stretch[broken] = math.nan if kind == 'nan' else random.choice([0.0, -1.0, 7.2, 1e6])
    if kind == 'unordered':
        order = random.integers(len(time), size=3 * len(time))
        time, stamps, stretch = time[order], stamps[order], stretch[order]
    fine = np.linspace(0.0, hold, max(2, math.ceil(hold / period) * _FINE))
    means = [float(np.mean(truth.rests(x))) for x in (
        fine[fine <= _SLICE * period], fine[fine >= hold - _SLICE * period], fine)]
    vibration = float(np.ptp(truth.vibrates(fine)))
    if push:
        # As far as samples cover it.
        after = time[time >= 0.0]
        vibration = float(np.ptp(_bump(after, push, width, middle))) if len(after) else 0.0
    error = math.sqrt(
        noise ** 2 * (1.0 + correlation) / (1.0 - correlation) + quantum ** 2 / 12.0)
    within: bool | None = vibration <= limit and max(map(abs, means)) <= limit
    if not within and vibration <= limit and min(map(abs, means)) <= limit:
        # Creep crosses the tolerance.
        within = None
    if push and limit < vibration < _BEYOND * limit + _PEAKS * noise:
        # Too close to the tolerance to distinguish from noise.
        within = None
    setpoint = RequestedSetpoint(
        target, start, _ARRIVAL - round(1e9 * move), _ARRIVAL, _ARRIVAL + round(1e9 * hold),
        model, decay, possible=(0.1, 3.0))
    return Trial(
        seed, kind, setpoint, _ARRIVAL + np.rint(1e9 * stamps).astype(np.int64), stretch, within,
        # A single push is not the vibration that is estimated.
        0.0 if push else _clarity(
            np.unique(time[time >= 0.0]), truth, error, means, vibration, limit),
        f'step {step:.3g}, offset {100 * truth.offset / size:.3g} %, vibration '
        f'{100 * vibration / size:.3g} %, frequency {truth.omega / model:.3g} and decay '
        f'{truth.decay / decay:.3g} of the model (decay/frequency {decay / model:.3g}), noise '
        f'{100 * noise / size:.3g} %, {period / interval:.3g} samples a period, '
        f'{hold / period:.3g} periods'
        + (f', quantum {100 * quantum / size:.3g} %' if quantum else '')
        + (f', correlation {correlation:.3g}' if correlation else '')
        + (f', creep {100 * truth.creep / size:.3g} % in {truth.slow / period:.3g} periods'
           if creeps else ''))


def _bump(time: np.ndarray, size: float, width: float, middle: float) -> np.ndarray:
    """Return a push that starts and ends at rest."""
    return np.asarray(size * np.exp(-0.5 * np.square((time - middle) / (0.25 * width))))


def _clarity(
        time: np.ndarray, truth: Truth, error: float, means: Sequence[float], vibration: float,
        limit: float) -> float:
    """Return the distance of the truth from the tolerance, given frequency and decay."""
    if len(time) < 4:
        return 0.0
    fading, phase = np.exp(-truth.decay * time), truth.omega * time
    basis = np.stack([
        np.ones_like(time), fading * np.cos(phase), fading * np.sin(phase)], axis=1)
    if truth.second:
        fading = np.exp(-truth.ratio * truth.decay * time)
        basis = np.column_stack((basis[:, :1 if not truth.amplitude else 3], fading * np.cos(
            truth.ratio * phase), fading * np.sin(truth.ratio * phase)))
    gram = basis.T @ basis
    if np.linalg.cond(gram) > 1e10:
        return 0.0
    variance = np.diag(np.linalg.inv(gram))
    offset_std = error * math.sqrt(variance[0])
    vibration_std = 2.0 * error * math.sqrt(max(variance[1:]))
    apart = [(max(map(abs, means)) - limit) / offset_std, (vibration - limit) / vibration_std]
    return max(apart) if max(apart) > 0.0 else -max(apart)


def verdict_of(trial: Trial) -> str:
    """Return the judge's verdict."""
    found = judge(trial.time, trial.stretch, trial.setpoint, TOLERANCES)
    return str(found.verdict)


def wrong(trial: Trial, verdict: str) -> str:
    """Return what is wrong with a verdict; empty if it is right."""
    if trial.within is False and verdict in ARRIVED:
        return 'wrong arrived'
    if trial.within and verdict in MISSED:
        return 'wrong missed'
    return ''


def compare(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Judge all runs; passed if no verdict is wrong."""
    rows, failures = [], []
    figures: dict[str, dict[str, float]] = {}
    for kind, name in KINDS.items():
        counts: Counter[str] = Counter()
        for seed in range(min(runs, 10) if quick else runs):
            trial = draw(seed, kind)
            verdict = verdict_of(trial)
            shown = verdict in ARRIVED or verdict in MISSED
            said = wrong(trial, verdict)
            if said:
                failures.append(f'{said}: kind {kind}, seed {seed}: {verdict}; {trial.words}')
            clear = kind not in BROKEN and trial.clarity > _CLEAR and trial.within is not None
            counts.update({
                'runs': 1, 'arrived': verdict in ARRIVED, 'missed': verdict in MISSED,
                'undecided': not shown, 'clear': clear, 'clear_undecided': clear and not shown,
                said: 1})
        figures[kind] = {x: counts[x] for x in (
            'runs', 'arrived', 'wrong arrived', 'missed', 'wrong missed', 'undecided', 'clear',
            'clear_undecided')}
        rows.append([
            name, *(str(counts[x]) for x in (
                'runs', 'arrived', 'wrong arrived', 'missed', 'wrong missed')),
            _share(counts['undecided'], counts['runs']),
            _share(counts['clear_undecided'], counts['clear'])])
    whole = Counter({x: sum(y[x] for y in figures.values()) for x in figures['white']})
    rows.append(['all', *(f'{whole[x]:,}' for x in (
        'runs', 'arrived', 'wrong arrived', 'missed', 'wrong missed')),
        _share(whole['undecided'], whole['runs']),
        _share(whole['clear_undecided'], whole['clear'])])
    return Sheet(
        'judge', 'Verdicts on simulated setpoints, with the truth beside them', (
            'samples', 'runs', 'arrived', 'of these wrong', 'missed', 'of these wrong',
            'undecided', 'undecided of the clear ones'), rows,
        {'kinds': figures, 'failures': failures},
        not whole['wrong arrived'] and not whole['wrong missed'])


def _share(part: int, whole: int) -> str:
    return f'{100.0 * part / whole:.0f} %' if whole else '-'
