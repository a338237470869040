"""
Check at small levels whether a class of hardware meets the requirements of a driver.

The trial operates it like a driver, on a `Bench`, and evaluates its return values and its sensor.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import json
import math
import signal
import subprocess
import sys
from threading import Event
from time import monotonic, sleep, time_ns
from typing import Any, cast, IO, NamedTuple

import numpy as np

from hmsa.errors import check_number
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa_lab.bench.bench import Bench, matched, PhaseResults, SILENCE
from hmsa_ros.device.hardware import Calls, Instrument, load
from hmsa_ros.device.watchdog import StateLostError

# In s: duration of a phase of the trial, and limit for an end.
_PHASE, _END = 0.6, 3.0
# Number of timed levels, the time between them in s, and attempts if the host disturbs the timing.
_TIMED, _APART, _TRIES = 30, 0.03, 4
# Limits: of a call in s, of the median lateness of a level in s, of the error of a clock in s, and
# of the fraction of samples that repeat the previous one.
_CALL, _LATE, _CLOCK, _REPEATED = 0.02, 2e-3, 1e-3, 0.6
# Temperature limit of a coil after small levels, in degrees Celsius.
_HOTTEST = 150.0
# Fraction of calls that may exceed their limit, on a host that is never busy, and standard
# deviations of the number of those that do: of 30 calls, 1 or 2 are expected and 3 prove nothing.
_FEW, _CHANCE = 0.05, 2.0
# Standard deviations of its mean from which a response is significant, so that noise cannot make
# the coil seem on or off, and minimum fraction of the response between rest and either level for
# 0 T to count as off.
_SEEN, _DISTINCT = 50.0, 0.3
# Largest distance of the reading without a field from that of an actuator.
_AT_REST = 0.3


class Check(NamedTuple):
    """One property of hardware: whether a figure keeps its limit."""

    name: str
    passed: bool
    figure: float
    unit: str
    limit: float
    sentence: str


class Conformance(NamedTuple):
    """Results of a trial: checks, reasons for skipped checks, and durations in s."""

    name: str
    checks: tuple[Check, ...]
    untried: tuple[str, ...]
    durations: dict[str, Array]

    @property
    def passed(self) -> bool:
        """Whether all checks were passed."""
        return all(x.passed for x in self.checks)

    def as_json(self) -> dict[str, object]:
        """Return the results for JSON."""
        return {
            'passed': self.passed, 'checks': [x._asdict() for x in self.checks],
            'untried': list(self.untried)}


class _TimedCalls(Calls):
    """Record the duration of each call, and make reading fail on request."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.durations: dict[str, list[float]] = {}
        self.read_fails = False

    def __call__(self, name: str, act: Callable[[], Any]) -> Any:
        """Call a method of hardware."""
        method = name.partition(' ')[0].rpartition('.')[2]
        if self.read_fails and method == 'read':
            raise RuntimeError('raised by the trial')
        begun = monotonic()
        try:
            return super().__call__(name, act)
        finally:
            self.durations.setdefault(method, []).append(monotonic() - begun)


class ConformanceTrial:
    """
    A trial of a class of hardware.

    Parameters
    ----------
    name : str
        MODULE:NAME of the class or function that creates the hardware.
    joint : str
        Joint name passed to it.
    settings : mapping
        Its keyword arguments.
    level : float
        Largest flux density in T that is set.
    rate : float
        Sampling rate in Hz, 1 to 10,000.

    Raises
    ------
    BadInputError
        If a number is out of range.

    """

    def __init__(
            self, name: str, joint: str, settings: Mapping[str, Any], *, level: float,
            rate: float) -> None:
        check_number('limit', level, 'T', above=0.0)
        check_number('rate', rate, 'Hz', least=1.0, most=1e4)
        self.name, self._joint, self._settings = name, joint, settings
        self._level, self._rate = level, rate
        self._checks: list[Check] = []
        self._untried: list[str] = []
        self._calls = _TimedCalls()
        # Mean stretch at rest, and smallest response to a level, if the sensor shows it.
        self._rest = self._apart = math.nan
        # Tolerance of a level in T.
        self._tolerance = 1e-3 * level

    def run(self, progress: Callable[[str, float], None]) -> Conformance:
        """
        Try the hardware.

        Parameters
        ----------
        progress : callable
            Called with the name of the current trial and the completed fraction.

        Returns
        -------
        Conformance
            The result of each check.

        Raises
        ------
        BadInputError
            If the hardware does not exist, or does not start.
        HmsaError
            If it fails at the first levels.

        """
        progress('levels and samples', 0.0)
        with self._bench() as bench:
            instrument = bench.coil.instrument
            self._tolerance = max(instrument.resolution or 0.0, 1e-3 * self._level)
            rest = bench.hold(_PHASE, [0.0])
            up, down = (bench.hold(_PHASE, [x * self._level]) for x in (1.0, -1.0))
            progress('timing', 0.3)
            timed = self._timed(bench)
            self._check_levels([rest, up, down, timed], timed)
            self._check_lateness(_lateness(timed), bench.slept)
            self._check_samples([rest, up, down, timed], timed, bench.slept)
            self._check_response(rest, up, down)
            progress('silence and ends', 0.6)
            self._check_silence(bench)
        self._check_end('off_at_close', 'after close', bench.worker.failure is None, str(
            bench.worker.failure or ''))
        durations = {x: np.array(y) for x, y in self._calls.durations.items()}
        self._check_calls(durations, bench.slept)
        if (known := instrument.clock_map) is not None:
            self._note(
                'clock', known.error, 's', _CLOCK,
                f'its clock is known to {known.error * 1e6:.3g} us, and drifts by '
                f'{known.drift * 1e6:.3g} ppm', 'clock() must answer at once')
        if instrument.has('temperature'):
            found = bench.coil.temperature
            self._note(
                'temperature', abs(found), 'deg C', _HOTTEST,
                f'the coil is at {found:g} degrees Celsius',
                'return the temperature of the coil in degrees Celsius')
        self._check_exception()
        progress('SIGTERM', 0.8)
        self._check_sigterm()
        return Conformance(
            self.name, tuple(self._checks), tuple(self._untried),
            {**durations, 'lateness': np.array(_lateness(timed))})

    def _bench(self) -> Bench:
        return Bench(
            self.name, self._settings, self._level, self._rate, self._joint, self._calls)

    def _timed(self, bench: Bench) -> PhaseResults:
        """Time a series of levels, repeated a few times if the host overslept."""
        for _ in range(_TRIES):
            bench.slept.clear()
            seen = bench.hold(_TIMED * _APART, [
                (0.5 if i % 2 else 1.0) * self._level for i in range(_TIMED)])
            if len(matched(seen)) == _TIMED or max(bench.slept) < _APART / 2:
                break
        return seen

    def _note(
            self, name: str, figure: float, unit: str, limit: float, text: str,
            mend: str) -> None:
        passed = bool(figure <= limit)
        self._checks.append(Check(
            name, passed, float(figure), unit, limit, text if passed else f'{text}: {mend}'))

    # -- levels --------------------------------------------------------------------------------

    def _check_levels(self, phases: Sequence[PhaseResults], timed: PhaseResults) -> None:
        wrong = max((
            abs(change.level - asked[1]) for x in phases for change, asked in matched(x)),
            default=math.inf)
        self._note(
            'level_reached', wrong, 'T', self._tolerance,
            f'levels of {self._level:g} T were set to within {wrong:g} T',
            'return the level that was really set, and give resolution (T) if it is coarse')
        missing = len(timed.asked) - len(matched(timed))
        self._note(
            'levels_applied', float(missing), 'levels', 0.0,
            f'{missing} of {len(timed.asked)} levels, {_APART * 1e3:g} ms apart, did not take '
            'effect', 'write must return sooner, or the device take levels ahead (schedule)')

    def _check_lateness(self, late: Sequence[float], host: Sequence[float]) -> None:
        median, most = (float(f(late)) if late else math.inf for f in (np.median, np.max))
        self._note(
            'lateness', max(abs(median) - float(np.median(host)), 0.0), 's', _LATE,
            f'levels took effect {median * 1e3:.3g} ms after their time (median; at most '
            f'{most * 1e3:.3g})', 'make write faster, or have the device keep levels (schedule)')

    # -- samples -------------------------------------------------------------------------------

    def _check_samples(
            self, phases: Sequence[PhaseResults], timed: PhaseResults,
            host: Sequence[float]) -> None:
        samples = [y for x in phases for y in x.samples]
        if not any(np.isfinite(x.stretch[0]) for x in samples):
            self._untried.append('samples: read returned none')
            return
        stamps = np.array([x.time for x in samples])
        falling = int(np.count_nonzero(np.diff(stamps) <= 0))
        self._note(
            'stamps_rise', float(falling), 'samples', 0.0,
            f'{falling} of {len(stamps)} samples do not have later timestamps than the one before',
            'return each sample once, with the time of its exposure')
        ahead = max(0.0, (int(stamps[-1]) - time_ns()) / NANOSECONDS)
        self._note(
            'stamps_past', ahead, 's', 0.0, f'timestamps are {ahead:.3g} s ahead',
            'take timestamps by the clock of now, or have clock() return that of the device')
        moving = timed.stretch
        changed = int(np.count_nonzero(np.diff(moving)))
        repeated = 1.0 - changed / (len(moving) - 1) if len(moving) > 1 else 0.0
        # The values of a sensor with few steps recur; changes of a slow one bring new values.
        if repeated > _REPEATED and 2 * len(np.unique(moving)) < changed:
            self._untried.append(
                f'samples_new: +-{self._level:g} T are a few steps of the sensor; a larger '
                '--limit shows more')
        else:
            self._note(
                'samples_new', repeated, '', _REPEATED,
                f'{repeated:.0%} of the samples repeat the value before',
                'return [] where nothing is new, and batches as a list with a timestamp each')
        rate = 1e9 * (len(stamps) - 1) / max(int(stamps[-1] - stamps[0]), 1)
        # A busy host delays each call as it does the waits of this trial.
        apart = 1.0 / self._rate + float(np.mean(host))
        self._note(
            'samples_lost', max(1.0 - rate * apart, 0.0), '', 0.5,
            f'{rate:.3g} samples a second, read at {self._rate:g} Hz',
            'read must return sooner, or --rate be that of the sensor')

    def _check_response(self, rest: PhaseResults, up: PhaseResults, down: PhaseResults) -> None:
        means = [float(np.mean(x)) if len(x) else math.nan for x in (
            y.stretch[len(y.stretch) // 2:] for y in (rest, up, down))]
        if len(rest.stretch):
            # A stretch is 1 without a field, and the deflection of a beam 0.
            self._note(
                'rest', min(abs(means[0] - 1.0), abs(means[0])), '', _AT_REST,
                f'the sensor shows {means[0]:.4g} without a field',
                'expected about 1, or 0 for a beam: correct gain, offset and rest_length of the '
                'sensor, or zero it')
        spread = float(np.std(rest.stretch)) if len(rest.stretch) else math.nan
        apart = means[1] - means[2]
        resolved = _SEEN * spread / math.sqrt(max(len(rest.stretch) // 2, 1))
        if not abs(apart) > max(resolved, 1e-9):
            self._untried.append(
                f'polarity, and whether the coil is off: +-{self._level:g} T cannot be seen in '
                'the samples; a larger --limit shows them')
            return
        self._note(
            'polarity', -apart, '', 0.0,
            f'{self._level:g} T lengthens the actuator by {apart / 2:.3g} of its length',
            'turn the leads of the coil, or the sign of the sensor')
        # If 0 T responds like a level, the coil is never off.
        near = min(abs(means[1] - means[0]), abs(means[2] - means[0]))
        self._rest, self._apart = means[0], near if near > _DISTINCT * abs(apart) else 0.0

    # -- ends ----------------------------------------------------------------------------------

    def _check_silence(self, bench: Bench) -> None:
        bench.hold(0.2, [self._level])
        begun, bench.beats = time_ns(), False
        seen = bench.run(SILENCE + 0.5)
        off = [x.stamp for x in seen.changes if abs(x.level) <= self._tolerance]
        after = (off[0] - begun) / NANOSECONDS if off else math.inf
        self._note(
            'off_after_silence', after, 's', SILENCE + 0.25,
            f'without commands the coil was off after {after:.3g} s', 'write(0.0) must be obeyed')

    def _off(self) -> bool | None:
        """Return whether the sensor of new hardware shows rest; None if undetermined."""
        if math.isnan(self._apart):
            return None
        instrument = Instrument(
            load(self.name, self._joint, self._settings), self._joint, Calls(1.0))
        instrument.synchronise(time_ns)
        found: list[float] = []
        until = monotonic() + 2.0 * _PHASE
        while monotonic() < until:
            with suppress(StateLostError):
                found += [x.stretch for x in instrument.read(time_ns())]
            sleep(1.0 / self._rate)
        instrument.close()
        found = [x for x in found if math.isfinite(x)]
        if not found:
            return None
        last = float(np.mean(found[len(found) // 2:]))
        return abs(last - self._rest) < 0.3 * self._apart

    def _check_end(self, name: str, when: str, orderly: bool, why: str) -> None:
        off = self._off()
        if off is None:
            self._untried.append(f'{name}: the sensor does not show whether the coil is off')
        good = orderly and off is not False
        self._note(
            name, 0.0 if good else 1.0, '', 0.0,
            f'{when} the coil is off' if good else
            f'{when} the coil is NOT off' if off is False else f'{when}: {why}',
            'write(0.0) and close must leave it without a current')

    def _check_exception(self) -> None:
        with self._bench() as bench:
            bench.run(0.2, [self._level])
            self._calls.read_fails = True
            bench.run(0.5)
            failure = str(bench.worker.failure or 'not noticed')
        self._check_end('off_at_exception', 'after an exception', 'is switched off' in failure,
                        failure)

    def _check_sigterm(self) -> None:
        with subprocess.Popen(
                [sys.executable, '-m', __name__, self.name, self._joint,
                 json.dumps(self._settings), repr(self._level), repr(self._rate)],
                stdout=subprocess.PIPE, text=True) as child:
            ready = cast(IO[str], child.stdout).readline()
            begun = monotonic()
            child.send_signal(signal.SIGTERM)
            try:
                status = child.wait(_END)
            except subprocess.TimeoutExpired:
                child.kill()
                status = child.wait()
        self._check_end(
            'off_at_sigterm', 'after SIGTERM', bool(ready) and status == 0,
            f'a driver ended with status {status} after {monotonic() - begun:.1f} s')

    # -- calls ---------------------------------------------------------------------------------

    def _check_calls(self, durations: Mapping[str, Array], host: Sequence[float]) -> None:
        # A busy host slows down calls as it does the waits of this trial.
        few = _FEW + float(np.mean(np.array(host) > _CALL))
        for name, found in durations.items():
            some = few + _CHANCE * math.sqrt(few / len(found))
            self._note(
                f'{name}_time', float(np.quantile(found, max(1.0 - some, 0.5))), 's',
                # Waiting at the end delays no level.
                _END if name == 'close' else _CALL,
                f'{name} takes {np.median(found) * 1e3:.3g} ms (at most {found.max() * 1e3:.3g})',
                'give calls a time limit of their own; nothing else is written meanwhile')


def _lateness(seen: PhaseResults) -> list[float]:
    """Return the lateness of levels in s."""
    return [(x.stamp - stamp) / NANOSECONDS for x, (stamp, _) in matched(seen)]


def _serve(name: str, joint: str, settings: str, level: str, rate: str) -> int:
    """Hold a level, as a driver does, until SIGTERM."""
    ended = Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    with Bench(name, json.loads(settings), float(level), float(rate), joint) as bench:
        bench.run(0.3, [float(level)])
        print('ready', flush=True)
        while not ended.is_set() and bench.worker.failure is None:
            bench.run(0.02)
    return int(bench.worker.failure is not None)


if __name__ == '__main__':
    sys.exit(_serve(*sys.argv[1:]))
