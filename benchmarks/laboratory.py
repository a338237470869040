"""
Random laboratories in virtual time: actuator, coil and sensor differ from the planner's model.

The motion follows Eq. 10 with a coil that lags, a viscoelastic branch and a constant force,
integrated by SciPy. Of the package, only the class of a block's parameters is used.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray
from scipy.constants import mu_0
from scipy.integrate import OdeSolution, solve_ivp

from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.sensor import Sample

Array = NDArray[np.float64]
#: Possible deviations, by name.
KINDS = {
    'modulus': 'G and damping', 'remanence': 'remanence', 'lag': 'lag of the coil',
    'stamps': 'late timestamps', 'gain': 'gain of the sensor', 'creep': 'creep',
    'force': 'constant force'}
#: What may change in operation, by name.
CHANGES = {
    'bias': 'bias of the sensor', 'gain': 'gain of the sensor', 'force': 'constant force',
    'modulus': 'G'}
#: All groups drawn: no deviation, one, or several.
GROUPS = {'none': 'nothing', **KINDS, 'several': 'several of these'}
# Time scales that are integrated at once, and samples per time scale.
_AHEAD, _SAMPLES = 3.0, (4.4, 25.0)
# Points of the true stretch per time scale, for judging moves: what samples show of a move that
# ends late depends on when they are taken.
_LOOKS = 100.0
# Every second bench has several deviations, each with this probability.
_LIKELY = 0.5
_TARGETS = (1.08, 1.45)  # range of stretches
_LEAST_STEP = 0.1
_PAPER = paper_actuator()


# Smallest and largest size of each of `CHANGES`, as that of the deviation, and the parts of a move
# in which it comes: halfway to its arrival, halfway to its end, or before it.
_SIZES = {
    'bias': (1e-3, 5e-3), 'gain': (5e-3, 0.02), 'force': (2e-3, 0.01), 'modulus': (0.02, 0.1)}
_PARTS = ('before', 'in', 'after')


@dataclass(frozen=True)
class Change:
    """A sudden change of a laboratory."""

    kind: str  # of `CHANGES`
    size: float  # added to the bias, or to a force of 1 = G times the area; relative to others
    move: int  # index of the move
    part: str  # before it, in it, or after its arrival


@dataclass(frozen=True)
class Bench:
    """One laboratory; times in s unless stated otherwise."""

    group: str  # of `GROUPS`
    seed: int
    given: ActuatorParameters  # the planner's parameters
    block: ActuatorParameters  # the true parameters
    lag: float  # of the coil
    late: float  # delay of timestamps after the motion they belong to
    delay: float  # transport delay of samples
    gain: float  # of the sensor about rest without field
    bias: float  # of the sensor
    ratio: float  # of a viscoelastic branch
    relaxation: float
    force: float  # in N
    noise: float
    period: float  # of samples
    dropouts: float  # fraction of samples that are lost, in bursts
    targets: tuple[float, ...]
    kinds: tuple[str, ...] = ()  # of `KINDS`: the deviations
    iron: 'Iron | None' = None  # the core of the coil
    change: Change | None = None  # in operation

    @property
    def unit(self) -> float:
        """Time scale of the planner's parameters."""
        return self.given.time_unit

    def shown(self, stretch: Array) -> Array:
        """Return the sensor's reading without noise and bias."""
        return 1.0 + self.gain * (stretch - 1.0)

    @property
    def wrong(self) -> str:
        """The deviations in words."""
        unit, found = self.unit, []
        for name in ('shear_modulus', 'damping_coefficient', 'remanence'):
            ratio = getattr(self.block, name) / getattr(self.given, name)
            if ratio != 1.0:
                found.append(f'{name} {100.0 * (ratio - 1.0):+.1f} %')
        found += [f'{name} {100.0 * x:+.1f} %' for name, x in (
            ('lag', self.lag / unit), ('stamps', self.late / unit), ('gain', self.gain - 1.0),
            ('creep', self.ratio), ('force', self.force * self.given.load_per_newton)) if x]
        if self.change is not None:
            found.append(f'{self.change.kind} changes by {100.0 * self.change.size:+.2g} % '
                         f'{self.change.part} move {self.change.move + 1}')
        return ', '.join(found) or 'nothing'

    def changed(self) -> 'Bench':
        """Return the laboratory after its change."""
        change = self.change
        if change is None:
            return self
        if change.kind == 'modulus':
            return replace(self, block=replace(
                self.block, shear_modulus=(1.0 + change.size) * self.block.shear_modulus))
        if change.kind == 'force':
            return replace(self, force=self.force + change.size / self.given.load_per_newton)
        if change.kind == 'gain':
            return replace(self, gain=(1.0 + change.size) * self.gain)
        return replace(self, bias=self.bias + change.size)


def drawn(seed: int, targets: int = 3, *, changes: bool = False) -> Bench:
    """Return the laboratory of a seed; groups alternate, and with ``changes`` a third changes."""
    random = np.random.default_rng((27, seed))
    names = list(GROUPS)
    group = 'several' if seed % 2 else names[(seed // 2) % (len(names) - 1)]
    wrong = {x for x in KINDS if random.random() < _LIKELY} if group == 'several' else {group}

    def log(low: float, high: float) -> float:
        return math.exp(random.uniform(math.log(low), math.log(high)))

    size = log(1.0, 200.0 / 4.4)
    given = replace(
        _PAPER, half_length=size * _PAPER.half_length,
        half_thickness=size * _PAPER.half_thickness,
        damping_coefficient=size ** 2 * _PAPER.damping_coefficient)
    unit = given.time_unit
    # Draw all quantities, used or not, so that one seed is one sequence of numbers.
    modulus, damping = random.uniform(0.8, 1.25), log(0.5, 2.0)
    remanence, lag, late, gain = (
        random.uniform(0.92, 1.08), random.uniform(0.0, 0.1), random.uniform(0.0, 0.1),
        random.uniform(0.97, 1.03))
    ratio, relaxation = random.uniform(0.0, 0.06), log(0.5, 10.0)
    force, bias = random.uniform(-0.015, 0.015), random.uniform(-3e-3, 3e-3)
    delay, noise = random.uniform(0.0, 0.1), log(1e-4, 3e-3)
    per_unit, dropouts = log(*_SAMPLES), random.uniform(0.0, 0.2) * (random.random() < 0.3)
    stretches: list[float] = []
    while len(stretches) < targets:
        stretch = round(random.uniform(*_TARGETS), 3)
        if abs(stretch - (stretches[-1] if stretches else 1.0)) >= _LEAST_STEP:
            stretches.append(stretch)
    block = given
    if 'modulus' in wrong:
        block = replace(
            block, shear_modulus=modulus * block.shear_modulus,
            damping_coefficient=damping * block.damping_coefficient)
    if 'remanence' in wrong:
        block = replace(block, remanence=remanence * block.remanence)
    late = late * unit if 'stamps' in wrong else 0.0
    return Bench(
        group, seed, given, block, lag * unit if 'lag' in wrong else 0.0, late,
        # A timestamp is never ahead of the clock.
        max(delay * unit, late), gain if 'gain' in wrong else 1.0, bias,
        ratio if 'creep' in wrong else 0.0, relaxation * unit,
        force / given.load_per_newton if 'force' in wrong else 0.0, noise, unit / per_unit,
        dropouts, tuple(stretches), tuple(x for x in KINDS if x in wrong),
        change=_change(seed, targets) if changes and seed % 3 == 2 else None)


def _change(seed: int, targets: int) -> Change:
    """Return the change of a seed, in its second move or later; kinds alternate."""
    random = np.random.default_rng((30, seed))
    kind = list(CHANGES)[seed // 3 % len(CHANGES)]
    return Change(
        kind, float(random.choice([-1.0, 1.0]) * random.uniform(*_SIZES[kind])),
        int(random.integers(1, targets)), str(random.choice(_PARTS)))


class Iron:
    """
    A core whose field lags behind the current, after Coleman and Hodgdon (1986).

    The field is the current's, in T, less a part that approaches ``half`` with a rising current
    and its negative with a falling one; over ``reach`` T its remainder falls by a factor of e.
    """

    def __init__(self, half: float, reach: float) -> None:
        self._half, self._reach = half, reach
        self._from, self._before = 0.0, 0.0  # since the last reversal or level

    def field(self, current: float) -> float:
        """Return the field at a current approached from the start of the last change."""
        return current - self._part(current)

    def _part(self, current: float) -> float:
        way = current - self._from
        most = math.copysign(self._half, way)
        return most + (self._before - most) * math.exp(-abs(way) / self._reach)

    def turn(self, current: float) -> None:
        """Start a new change at the current reached."""
        self._from, self._before = current, self._part(current)


class Plant:
    """The actuator of a bench; times in ns, levels in T."""

    def __init__(self, bench: Bench, time: int) -> None:
        self._set(bench)
        self._lag, self._ratio, self._relaxation = bench.lag, bench.ratio, bench.relaxation
        self._ahead = round(1e9 * _AHEAD * bench.unit)
        self.time = self._begin = self._since = self._until = time
        self._levels: list[tuple[int, float]] = []
        # The field without a core decays from the previous level to the one in force.
        self._free = self._level = 0.0
        self._iron = bench.iron
        self._motion: OdeSolution | None = None  # from `_since` until `_until`
        self.applied: list[tuple[int, float]] = []
        state = 1.0
        # Rest under the force, with branches relaxed.
        for _ in range(50):
            slope = (self._elastic(state + 1e-6) - self._elastic(state - 1e-6)) / 2e-6
            state -= (self._elastic(state) - self._force / self._stiffness) / slope
        self.state = np.array([state, 0.0, self._elastic(state)])  # at `_since`

    def _set(self, bench: Bench) -> None:
        """Take the coefficients of Eq. 10 in SI units, divided by the area of the block."""
        block = bench.block
        inertia = block.density * block.half_length ** 2
        self._stiffness = block.shear_modulus / inertia
        self._drive = block.remanence / mu_0 / inertia
        self._damping = block.damping_coefficient * block.half_thickness / (
            8.0 * block.half_length ** 2) / inertia
        self._limit = block.chain_limit
        self._c1 = 2.0 * (block.half_thickness / block.half_length) ** 2
        self._force = bench.force * block.load_per_newton * block.shear_modulus / inertia

    def change(self, bench: Bench) -> None:
        """Go on with the block and the force of a bench, from the present state."""
        if self._motion is not None:
            self.state = self._motion(1e-9 * (self.time - self._since))
        self._since, self._motion = self.time, None
        self._set(bench)

    def command(self, stamp: int, level: float) -> None:
        """Set a level from a timestamp on; it replaces all at or after that time."""
        stamp = max(stamp, self.time)
        self._levels = [*(x for x in self._levels if x[0] < stamp), (stamp, level)]

    def advance(self, time: int) -> float:
        """Simulate up to a time; return the stretch then."""
        while self._levels and self._levels[0][0] <= time:
            stamp, level = self._levels.pop(0)
            self._go_on(stamp)
            self._begin_with(level)
            self.applied.append((stamp, level))
        return self._go_on(time)

    def _begin_with(self, level: float) -> None:
        if self._motion is not None:
            self.state = self._motion(1e-9 * (self.time - self._since))
        self._free, self._level = self._free_at(self.time), level
        if self._iron is not None:
            self._iron.turn(self._free)
        self._begin, self._since, self._motion = self.time, self.time, None

    def _free_at(self, time: float) -> float:
        """Return the field without a core in T at a time in ns while a level is in force."""
        if not self._lag:
            return self._level
        return self._level + (self._free - self._level) * math.exp(
            -1e-9 * (time - self._begin) / self._lag)

    @property
    def field(self) -> float:
        """The field in T now."""
        return self._field_at(self.time)

    def _field_at(self, time: float) -> float:
        free = self._free_at(time)
        return free if self._iron is None else self._iron.field(free)

    def _elastic(self, stretch: float) -> float:
        """Return psi' of the Gent model."""
        return (stretch - stretch ** -2) / (
            1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / self._limit)

    def _slope(self, time: float, state: Array) -> tuple[float, float, float]:
        stretch, rate, relaxed = state.tolist()
        elastic, cube = self._elastic(stretch), stretch ** -3
        total = self._drive * self._field_at(
            self._since + 1e9 * time) + self._force - self._damping * rate - self._stiffness * (
            elastic + self._ratio * (elastic - relaxed)) + 0.25 * rate * rate * cube / stretch
        return rate, 6.0 * total / (cube + self._c1), (elastic - relaxed) / self._relaxation

    def _go_on(self, time: int) -> float:
        """Simulate under the level in force; return the stretch."""
        while self._motion is None or time > self._until:
            if self._motion is not None:
                self.state = self._motion(1e-9 * (self._until - self._since))
                self._since = self._until
            self._until = self._since + self._ahead
            self._motion = solve_ivp(
                self._slope, (0.0, 1e-9 * self._ahead), self.state, 'DOP853', rtol=1e-8,
                atol=1e-9, dense_output=True).sol
        self.time = time
        return float(self._motion(1e-9 * (time - self._since))[0])


class Device:
    """Actuator and sensor of a bench, for `hmsa_ros.runtime.loop.Loop`."""

    def __init__(
            self, bench: Bench, time: int, plant: Callable[[Bench, int], Plant] = Plant) -> None:
        self.bench, self.time = bench, time
        self.plant = plant(bench, time)
        self._random = np.random.default_rng((28, bench.seed))
        self._measured = time  # of the last measurement
        self._period = round(1e9 * bench.period)
        self._silent = 0  # number of samples still to be lost
        # Arrival time, timestamp and value of each sample.
        self._wire: list[tuple[int, int, float]] = []
        # The stretch at times that do not depend on samples.
        self.truth: list[tuple[int, float]] = []
        self._look = round(1e9 * bench.unit / _LOOKS)

    @property
    def next_sample(self) -> int:
        """Time of the sensor's next event."""
        due = self._measured + self._period
        return min(due, self._wire[0][0]) if self._wire else due

    def change(self) -> None:
        """Change what changes in operation, now."""
        self.bench = self.bench.changed()
        self._go_on(self.time)
        self.plant.change(self.bench)

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Set a level from a timestamp on."""
        self.plant.command(stamp, level)

    def advance(self, time: int) -> None:
        """Do what is due up to a time."""
        while self._measured + self._period <= time:
            self._measured += self._period
            self._measure()
        self.time = time

    def _go_on(self, time: int) -> float:
        """Simulate up to a time; return the stretch then."""
        first = self.plant.time // self._look + 1
        self.truth += [(x, self.plant.advance(x)) for x in range(
            first * self._look, time + 1, self._look)]
        return self.plant.advance(time)

    def _measure(self) -> None:
        bench, now = self.bench, self._measured
        stretch = self._go_on(now)
        noise = bench.noise * float(self._random.standard_normal())
        lucky = float(self._random.random())
        if self._silent:
            self._silent -= 1
            return
        if bench.dropouts and lucky < bench.dropouts / 5.0:
            # Five in a row on average.
            self._silent = int(lucky / bench.dropouts * 5.0 * 10.0)
            return
        self._wire.append((
            now + round(1e9 * bench.delay), now + round(1e9 * bench.late),
            1.0 + bench.gain * (stretch - 1.0) + bench.bias + noise))

    def changes(self) -> Sequence[tuple[int, int, float]]:
        """Return the levels that took effect."""
        self._go_on(self.time)
        found, self.plant.applied = self.plant.applied, []
        return [(0, *x) for x in found]

    def samples(self) -> Sequence[Sample]:
        """Return samples that have arrived: timestamp, stretch, and NaN for rate and field."""
        found = []
        nothing = np.array([math.nan])
        while self._wire and self._wire[0][0] <= self.time:
            _, stamp, value = self._wire.pop(0)
            found.append(Sample(stamp, np.array([value]), nothing, nothing))
        return found
