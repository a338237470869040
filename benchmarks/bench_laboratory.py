"""
Tune laboratories unknown to the package: a serial board and deviations from the data sheet.

    python -m benchmarks laboratory [--runs N] [--page FILE] [--quick]

The shipped driver class communicates with the board's firmware over a line with delays. The board
has its own clock; behind it, SciPy integrates coil, actuator and sensor. All of it runs in
simulated time. The functions behind ``hmsa tune`` do the tuning: the initial moves, an excitation,
an identification, the choice of a shaper, and the moves again. So do those behind ``hmsa calibrate
coil --hysteresis`` where there is an iron core. The verdict is on the true motion, which nothing
else reads.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.laboratory import Bench, Iron, Plant
from benchmarks.sheet import Sheet
from hmsa.identification.files import read_belief
from hmsa.identification.learning import learn, TargetWindow
from hmsa.identification.learning import SequenceRepeat as Repeat
from hmsa.identification.measurement import Measurement
from hmsa.interfaces.actuator import planned_from
from hmsa.interfaces.topics import PLANNER
from hmsa.model.equations import natural_frequency
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.sensor import Sample
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa.planning.timeline import PlannedSegment
from hmsa.runs.record import ROUNDED
from hmsa_lab.bench import _board, line, serial_board
from hmsa_lab.bench.assembly import Assembly, CoilModel, fit_core, SensorScale
from hmsa_lab.bench.calibration import calibrate_coil, decay, loop
from hmsa_lab.bench.serial_board import REST_LENGTH, SimulatedBoard, TESLA_PER_AMPERE
from hmsa_lab.experiments.tuning import chosen, excitation, identified, Tuning
from hmsa_ros.device.coil import HardwareJoint
from hmsa_ros.device.watchdog import Fallback
from hmsa_ros.device.worker import HardwareDevice
from hmsa_ros.runtime.loop import Loop
from hmsa_ros.runtime.records import Output, Settings, StatusChanged, Trajectory

#: Laboratories of each kind, and the first seed without and with hysteresis; earlier seeds are for
#: development.
RUNS, SEEDS = 20, {False: 31_000, True: 34_000}
#: Allowed error of the last two moves, as a fraction of the step: without and with hysteresis.
GOALS = {False: 0.005, True: 0.015}
#: Fraction of laboratories that must reach that, and the increase that counts as worse.
REACH, WORSE = 0.9, 0.005
# Offset or vibration of a move, as a fraction of the step, above which a verdict must report it.
FAILED = 0.03
_MS = 1_000_000
_PERIOD = _MS  # of samples in ns
_LEVEL = 0.14  # T, required for the largest stretch
_NONE = ROUNDED * _LEVEL  # remanent field below which there is no level, as in hmsa learn
_LIMIT, _LEAD = 0.5, 200 * _MS
_TRIP = (150_000, 600_000)  # round trip of a request in ns
_JOINT = 'actuator'
# Calibration of a coil with a core: levels per quarter of the loop, ns at each level, ns between
# heartbeats, and noise of the probe in T.
_STEPS, _SETTLE, _BEAT, _PROBE = 6, 200 * _MS, 10 * _MS, 2e-5
# Repeats to learn from, fraction of the step that counts as small enough by the printed value,
# and fraction that counts as an arrival.
_REPEATS, _ENOUGH, _ARRIVED = 2, 0.005, 0.02


@dataclass(frozen=True)
class Laboratory:
    """A laboratory as drawn from a seed."""

    bench: Bench
    fast: float  # rate error of the board's clock, positive if fast
    constant: float  # of the coil, relative to its data sheet
    hysteresis: float  # fraction of the range

    @property
    def period(self) -> float:
        """Period of the actuator in s, by its data sheet."""
        given = self.bench.given
        return 2.0 * math.pi * given.time_unit / float(
            natural_frequency(given.rest, given.nondimensional))

    @property
    def words(self) -> str:
        """Deviations from the data sheet, in words."""
        bench = self.bench
        return (f'{bench.wrong}; lag {1e3 * bench.lag:.2f} ms, latency {1e3 * bench.late:.2f} ms, '
                f'clock {1e6 * self.fast:.0f} ppm, T/A {100.0 * (self.constant - 1.0):+.1f} %, '
                f'hysteresis {100.0 * self.hysteresis:.1f} %, noise {bench.noise:.1e}, '
                f'L sqrt(rho/G) {1e3 * bench.unit:.1f} ms')


def drawn(seed: int, *, iron: bool) -> Laboratory:
    """Return the laboratory of a seed, with a core in its coil or without."""
    random = np.random.default_rng((29, seed))

    def log(low: float, high: float) -> float:
        return math.exp(random.uniform(math.log(low), math.log(high)))

    size = log(1.0, 4.0)
    paper = paper_actuator()
    given = replace(
        paper, half_length=size * paper.half_length, half_thickness=size * paper.half_thickness,
        damping_coefficient=size**2 * paper.damping_coefficient)
    block = replace(
        given, shear_modulus=random.uniform(0.8, 1.2) * given.shear_modulus,
        damping_coefficient=log(0.7, 1.4) * given.damping_coefficient)
    lag, late = log(2e-4, 2e-3), log(5e-4, 5e-3)
    fast, constant = random.uniform(0.0, 1e-4), random.uniform(0.95, 1.05)
    ratio, relaxation = random.uniform(0.0, 0.06), log(0.5, 10.0) * given.time_unit
    noise, hysteresis = log(1e-4, 3e-3), random.uniform(0.0, 0.02)
    targets: list[float] = []
    while len(targets) < 4:
        stretch = round(random.uniform(1.08, 1.4), 2)
        if abs(stretch - (targets[-1] if targets else 1.0)) >= 0.1:
            targets.append(stretch)
    hysteresis *= iron
    return Laboratory(Bench(
        'several', seed, given, block, lag, late, late, 1.0, 0.0, ratio, relaxation, 0.0, noise,
        1e-9 * _PERIOD, 0.0, tuple(targets),
        iron=Iron(hysteresis * _LEVEL, 0.3 * _LEVEL) if iron else None),
        fast, constant, hysteresis)


class Board(SimulatedBoard):
    """The board of a laboratory in simulated time; ``motion`` is the truth in ns and stretch."""

    def __init__(self, lab: Laboratory) -> None:
        self.lab, self.fast = lab, lab.fast
        self.tesla_per_ampere = lab.constant * TESLA_PER_AMPERE
        self.motion: list[tuple[int, float]] = []
        self.now = 0  # of the host in ns
        self._draw = np.random.default_rng((30, lab.bench.seed))
        super().__init__(clock=self.time_ns)

    def time_ns(self) -> int:
        """Return the time of the host."""
        return self.now

    def _make_block(self) -> Any:
        return Plant(self.lab.bench, 0)

    @property
    def field(self) -> float:
        """The field in T now."""
        return self._block.field

    def write(self, text: bytes) -> None:
        """Send a request; half of the round trip passes before it arrives, half after."""
        trip = int(self._draw.uniform(*_TRIP))
        self.now += trip // 2
        super().write(text)
        self.now += trip - trip // 2

    def read(self, size: int) -> bytes:
        """Return bytes; time passes where there are none."""
        self.now += 0 if self._answer else _MS
        return super().read(size)

    def _shown(self, stretch: float) -> float | None:
        """Return the sensor's reading of a stretch; None where there is none."""
        return stretch

    def _sample(self, time: int) -> None:
        """Measure: the reading has the present timestamp but belongs to an earlier time."""
        then = self._host(time) - round(1e9 * self.lab.bench.late)
        if then >= 0:
            stretch = self._block.advance(max(then, self._block.time))
            self.motion.append((then, stretch))
            noise = self.lab.bench.noise * float(self._draw.standard_normal())
            shown = self._shown(stretch + noise)
            if shown is not None:
                _board.sample(self._board, time, round(1e6 * REST_LENGTH * shown))
        self._next_sample += _PERIOD // 1000


class Driver:
    """The shipped driver with a board, for `Loop`."""

    def __init__(self, board: Board, coil: CoilModel) -> None:
        self.board = board
        serial = type('Serial', (serial_board.Board,), {'simulate': lambda *_: board})
        # It waits for answers in simulated time too.
        for module in (line, serial_board):
            vars(module)['monotonic'] = lambda: 1e-9 * board.now
        hardware = Assembly(
            serial('sim'), coil, SensorScale(rest_length=REST_LENGTH))
        self.device = HardwareDevice(
            [HardwareJoint(hardware, _LIMIT, Fallback(0.0))], time=board.now, period=5 * _MS,
            clock=board.time_ns)
        self.device.switch_off(board.now)
        self.samples_seen: list[tuple[int, float]] = []
        self.changes_seen: list[tuple[int, float]] = []

    @property
    def time(self) -> int:
        """The host's time in ns."""
        return self.board.now

    @property
    def next_sample(self) -> int:
        """Time of the next call to `advance`."""
        return max(self.device.due or 0, self.board.now + _MS // 10)

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Receive a level."""
        self.device.receive(joint, stamp, level)

    def advance(self, time: int) -> None:
        """Do what is due; this takes time too."""
        self.board.now = max(self.board.now, time)
        self.device.advance(self.board.now)

    def changes(self) -> Sequence[tuple[int, int, float]]:
        """Return the levels that took effect."""
        found = [(x.joint, x.stamp, x.level) for x in self.device.changes()]
        self.changes_seen += [x[1:] for x in found]
        return found

    def samples(self) -> Sequence[Sample]:
        """Return the measured samples."""
        found = self.device.samples()
        self.samples_seen += [(x.time, float(x.stretch[0])) for x in found]
        return found


@dataclass(frozen=True)
class Left:
    """The true error after a move, as fractions of its step, and the verdict on it."""

    vibration: float
    offset: float
    verdict: str

    @property
    def size(self) -> float:
        """The larger of both errors."""
        return max(self.vibration, self.offset)


@dataclass(frozen=True)
class Outcome:
    """Result of tuning a laboratory."""

    lab: Laboratory
    verdict: str  # of the identification
    reason: str
    shaper: str
    before: list[Left]
    after: list[Left]  # empty if nothing was written
    learnt: list[Left]  # empty if there is nothing to learn

    @property
    def last(self) -> float:
        """The largest error of the last two moves."""
        return _last(self.learnt or self.after or self.before)

    @property
    def worse(self) -> float:
        """The largest increase of the error of a move over that before tuning."""
        return max((x.size - y.size for found in (self.after, self.learnt)
                    for x, y in zip(found, self.before, strict=False)), default=0.0)

    @property
    def silent(self) -> int:
        """Moves that failed with the verdict ``arrived``."""
        return sum(x.size > FAILED and x.verdict == 'arrived' for x in (
            *self.before, *self.after, *self.learnt))


def _last(moves: Sequence[Left]) -> float:
    return max(x.size for x in moves[2:])


class Trial:
    """A laboratory, its driver and a planner in one loop."""

    def __init__(self, driver: Driver, planner: Planner) -> None:
        self.lab, self.driver = driver.board.lab, driver
        self.loop = Loop(PlannerGroup({_JOINT: planner}), Settings(
            takeover_timeout=0, heartbeat_period=100 * _MS), self.driver, driver.device.guards)
        self.verdicts: dict[int, str] = {}
        self.loop.deliver = self._record
        self.loop.run(self.loop.now + 500 * _MS)

    def _record(self, output: Output) -> None:
        if isinstance(output, StatusChanged):
            self.verdicts |= {x.setpoint.number: str(x.verdict) for x in output.findings.values()}

    def request(self, points: Sequence[tuple[float, float]], *, raw: bool) -> int:
        """Execute setpoints or levels with their times in s; return the start time in ns."""
        self.verdicts.clear()
        self.loop.runtime.request(Trajectory(
            (_JOINT,), [((x,), round(1e9 * y)) for x, y in points], len(points), raw=raw))
        self._planned = self._segments
        begin = self.loop.now
        self.loop.run(begin + 2 * _LEAD + round(1e9 * (points[-1][1] + 5.0 * self.lab.period)))
        return begin

    @property
    def _segments(self) -> Sequence[PlannedSegment]:
        return self.loop.runtime.group.planners[_JOINT].plan.segments

    def moves(self, hold: float) -> list[Left]:
        """Execute the moves and one back to rest; return their true errors."""
        targets = (*self.lab.bench.targets, 1.0)
        self.begin = self.request([(x, hold * (i + 1)) for i, x in enumerate(targets)], raw=False)
        # A cut-off drops the plan. Replanned segments start later than the first level.
        segments = (self._segments or self._planned)[-len(targets):]
        first = self._first()
        self.targets = [
            TargetWindow(x, hold * i, hold * (i + 1), (
                None if y.arrival is None else 1e-9 * (y.arrival - first)))
            for i, (x, y) in enumerate(zip(targets, segments, strict=True))]
        return self._left([x.arrival or 0.0 for x in self.targets], [
            self.verdicts.get(i + 1, 'unobserved') for i in range(len(targets))])

    def _first(self) -> int:
        """Return when the first level of the last request took effect, or was to."""
        return next((
            x for x, y in self.driver.changes_seen if x >= self.begin and abs(y) > _NONE),
            self.begin + _LEAD)

    def _left(self, rests: Sequence[float], verdicts: Sequence[str]) -> list[Left]:
        """Return true errors of moves that come to rest at times in s after the first level."""
        time, stretch = np.array([x for x in self.driver.board.motion if x[0] >= self.begin]).T
        time = 1e-9 * (time - self._first())
        found, start, look = [], 1.0, self.lab.period
        for target, rest, verdict in zip(self.targets, rests, verdicts, strict=True):
            early = (time >= rest) & (time < rest + look)
            late = (time >= target.end - 2.0 * look) & (time < target.end)
            step, start = abs(target.stretch - start), target.stretch
            found.append(Left(
                float(np.ptp(stretch[early])) / step,
                abs(float(np.mean(stretch[late])) - target.stretch) / step, verdict))
        return found[:-1]

    def learnt(self, actuator: ActuatorParameters) -> list[Left]:
        """Repeat the moves as corrected by ``hmsa learn``; return the best repeat's errors."""
        repeats: list[Repeat] = []
        # Levels change until half the duration of a move after its end.
        rests = [x.begin + 1.5 * ((x.arrival or x.begin) - x.begin) for x in self.targets]
        true = []
        while True:
            zero = self._first()
            time, stretch = np.array([
                (1e-9 * (x - zero), y) for x, y in self.driver.samples_seen if x >= zero]).T
            since, levels = np.array([
                (1e-9 * (x - zero), y) for x, y in self.driver.changes_seen if x >= zero]).T
            repeats.append(Repeat(time, stretch, since, levels))
            found = learn(repeats, self.targets, actuator, (-_LIMIT, _LIMIT))
            most = [max(x.vibration, abs(x.offset)) for x in found.left[-1]]
            true.append(self._left(
                rests, ['arrived' if x <= _ARRIVED else 'off_target' for x in most]))
            if max(most) <= _ENOUGH or len(repeats) > _REPEATS:
                return true[found.best]
            self.begin = self.request(
                list(zip(found.levels.tolist(), found.level_times.tolist(), strict=True)),
                raw=True)

    def recorded(self, begin: int) -> Measurement:
        """Return the recording since ``begin``."""
        samples, changes = self.driver.samples_seen, self.driver.changes_seen
        first = max((i for i, x in enumerate(changes) if x[0] <= begin), default=0)
        time, stretch = np.array([(x - begin, y) for x, y in samples if x >= begin]).T
        since, levels = np.array([(x - begin, y) for x, y in changes[first:]]).T
        return Measurement(1e-9 * time, stretch, np.maximum(1e-9 * since, 0.0), levels)


def calibrated(lab: Laboratory) -> CoilModel:
    """Return the coil of a laboratory as ``hmsa calibrate coil --hysteresis`` estimates it."""
    driver = Driver(Board(lab), CoilModel(TESLA_PER_AMPERE))
    random, rows = np.random.default_rng((31, lab.bench.seed)), []
    levels = loop(_LEVEL, _STEPS)
    for level in (*levels, *decay(_LEVEL)):
        driver.receive(0, 0, level)
        for _ in range(round(_SETTLE / _BEAT)):
            driver.advance(driver.time + _BEAT)
            driver.receive(0, 0, level)
        rows.append((level / TESLA_PER_AMPERE, driver.board.field + _PROBE * float(
            random.standard_normal())))
    current, field = np.array(rows[:len(levels)]).T
    found = calibrate_coil(current, field)
    core, _ = fit_core(found.curve(current), field)
    settings = found.settings('')
    return CoilModel(
        **{x.removeprefix('hardware.coil.'): y for x, y in settings.items()},
        play_widths=core.widths, play_weights=core.weights)


def run(lab: Laboratory) -> Outcome:
    """Tune a laboratory; judge the moves before and after."""
    sheet = CoilModel(TESLA_PER_AMPERE)
    hold = max(0.4, 12.0 * lab.period)
    entries = [(PLANNER, f'actuator.{x}', getattr(lab.bench.given, x)) for x in (
        'half_length', 'half_thickness', 'damping_coefficient')]
    tuning = Tuning(
        Path(), tuple(((x,), hold) for x in lab.bench.targets), Path(), entries,
        accept=True)
    belief = read_belief(None, entries)
    trial = Trial(Driver(Board(lab), sheet), planner_of(belief.actuator))
    before = trial.moves(hold)
    if lab.hysteresis:
        trial = Trial(Driver(Board(lab), calibrated(lab)), planner_of(belief.actuator))
    trial.request([(1.0, hold)], raw=False)
    begin = trial.request(
        [(y, x) for x, y in excitation(tuning, belief, 1e9 / _PERIOD)], raw=True)
    found = identified(
        tuning, belief, trial.recorded(begin), belief.actuator, {'coil_time_constant': 0.0})
    if found.verdict != 'identified' and not found.acceptable:
        return Outcome(lab, found.verdict, found.reason, '', before, [], [])
    _, settings = chosen(tuning, belief, found)
    actuator = planned_from(settings)
    trial = Trial(trial.driver, planner_of(
        actuator, shaper=settings['shaper'],
        coil_time_constant=settings.get('coil_time_constant', 0.0)))
    after = trial.moves(hold)
    return Outcome(
        lab, found.verdict, found.reason, settings['shaper'], before, after,
        trial.learnt(actuator) if lab.hysteresis else [])


def planner_of(actuator: Any, **options: Any) -> Planner:
    """Return a planner for a laboratory's amplifier."""
    return Planner(actuator, Options(
        flux_density_min=-_LIMIT, flux_density_max=_LIMIT, lead_time=_LEAD, **options))


def run_one(seed: int, *, iron: bool) -> Outcome:
    """Tune the laboratory of a seed."""
    return run(drawn(seed, iron=iron))


def compare(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Tune laboratories without and with hysteresis; passed if all goals are met."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = {iron: list(pool.map(partial(run_one, iron=iron), range(
            seed, seed + (1 if quick else runs)))) for iron, seed in SEEDS.items()}
    return sheet(found, quick=quick)


def sheet(outcomes: Mapping[bool, Sequence[Outcome]], *, quick: bool = False) -> Sheet:
    """Return the results of laboratories without and with hysteresis."""
    rows, figures, passed = [], {}, True
    for iron, found in outcomes.items():
        left, tuned, before = ([x.last for x in found], [
            _last(x.after or x.before) for x in found], [_last(x.before) for x in found])
        reached = sum(x <= GOALS[iron] for x in left)
        worse, silent = sum(x.worse > WORSE for x in found), sum(x.silent for x in found)
        rows.append([
            '0 to 2 %' if iron else 'none', str(len(found)), _percent(float(np.median(before))),
            _percent(float(np.median(tuned))), _percent(max(tuned)),
            *([_percent(float(np.median(left))), _percent(max(left))] if iron else ['', '']),
            f'{reached} within {_percent(GOALS[iron])}', str(worse), str(silent)])
        figures['with hysteresis' if iron else 'without'] = [{
            'laboratory': x.lab.words, 'verdict': x.verdict, 'shaper': x.shaper, 'last': x.last,
            'worse': x.worse, 'silent': x.silent} for x in found]
        passed &= reached >= REACH * len(found) and not worse and not silent
    return Sheet(
        'laboratory', 'Random laboratories behind a serial board: the most that the last two of '
        'four moves leave, vibration or offset in % of the step', (
            'hysteresis', 'laboratories', 'before, median', 'tuned, median', 'tuned, largest',
            'learnt, median', 'learnt, largest', 'goal', 'worse than before', 'silent'), rows,
        figures, quick or passed)


def _percent(share: float) -> str:
    return f'{100.0 * share:.2g} %'
