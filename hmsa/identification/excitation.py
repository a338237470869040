"""
Design of a recording: the sequence of levels with the most information on the parameters.

D-optimal design (V. V. Fedorov, "Theory of Optimal Experiments", Academic Press 1972): among all
sequences of a duration within the limits of coil, slew and stretch, find one with a large
determinant of the information matrix, hence a small confidence ellipsoid. A pattern of levels and
dwells is repeated; levels and dwells are drawn at random and improved one by one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING

import numpy as np

from hmsa.errors import BadInputError, check_number
from hmsa.identification import quantities
from hmsa.identification.measurement import FEWEST, UncheckedMeasurement
from hmsa.identification.response import respond, Response
from hmsa.model import equations
from hmsa.model.delivery import Delivery
from hmsa.model.equations import Array
from hmsa.model.modes import Modes
from hmsa.model.moves import Limits, Setpoint, State
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters
from hmsa.model.status import RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers.request import MoveRequest

if TYPE_CHECKING:
    from hmsa.identification.files import Belief

_PATTERN = 5  # number of levels in the repeated pattern
# Attempts to scale a pattern to the limits, target of the scaling, and sufficient scale.
_SCALINGS, _AIM, _ALMOST = 5, 0.99, 0.97
# Number of random patterns, number of the best to improve, steps for each, and for the winner.
_FIRST, _KEPT, _FEW, _STEPS = 150, 5, 60, 300
_LEAST_DWELL, _MOST_DWELL = 0.2, 6.0  # range of the time on a level, in periods
_MODAL_DWELL = 1.5  # its minimum with secondary modes
_BEGIN = 0.2  # rest before the first level, in periods
_LAST = 3.0  # duration of the last move and its rest, in periods
_SHORTEST = 3.0  # minimum duration of a sequence, in periods
_PERIODS = 180.0  # default duration
_MARGIN = 0.95  # fraction of the range to the limits of the chains
#: The sequence of the paper, and one of unshaped steps; from rest.
PAPER = (0.1, 0.2, 0.4)
PLAIN = (0.1, 0.4, 0.0)
_WEIGHT = 4.0  # weight of the worst parameter relative to the volume
_WINDOW = 30.0  # periods over which patterns are compared
#: Modes that are expected where none are given.
EXPECTED = Modes((1.4, 2.2), (0.15, 0.08), (0.1, 0.15))
# Range of the motion that shows modes, about rest.
_SMALL = -0.12, 0.15
# Maximum deviation from rest at the end, stretch, without secondary modes and with them.
_REST, _MODAL_REST = 1e-3, 5e-3


def modal_free(actuator: ActuatorParameters, free: Sequence[str]) -> tuple[str, ...]:
    """Return what ``modes`` frees of an actuator with modes, and the rest without J_lim."""
    return (
        *('mass_factor' if x == 'shear_modulus' else x for x in free
          if x not in (quantities.MODES, 'chain_limit')),
        *(x for i in actuator.modes.ringing for x in quantities.SECONDARY[i][:3]))


@dataclass(frozen=True)
class Bounds:
    """Limits of a sequence."""

    flux_density_min: float = -0.5  # in T
    flux_density_max: float = 0.5  # in T
    slew_limit: float = math.inf  # in T/s; infinite for steps
    # Range of the motion; default 0.6 to 2, for the deflection of a beam -0.6 to 0.6.
    stretch_min: float | None = None
    stretch_max: float | None = None

    def __post_init__(self) -> None:
        if not self.flux_density_min <= 0.0 < self.flux_density_max < math.inf:
            raise BadInputError(
                f'flux densities from {self.flux_density_min:g} to {self.flux_density_max:g} T: '
                'expected a range with 0 T in it')
        check_number('slew limit', self.slew_limit, 'T/s', above=0.0, endless=True)

    @classmethod
    def of(
            cls, belief: 'Belief', stretch_min: float | None,
            stretch_max: float | None) -> 'Bounds':
        """Return the limits of the coil in a parameter file and those of the motion."""
        return cls(
            belief.number('flux_density_min', -0.5), belief.number('flux_density_max', 0.5),
            belief.number('slew_limit', 0.0) or math.inf, stretch_min, stretch_max)

    def of_motion(self, actuator: ActuatorParameters) -> tuple[float, float]:
        """Return the range of an actuator's motion; raise `BadInputError` if it excludes rest."""
        what, rest = actuator.coordinate, actuator.rest
        least = what.usual[0] if self.stretch_min is None else self.stretch_min
        most = what.usual[1] if self.stretch_max is None else self.stretch_max
        if not -math.inf < least < rest < most < math.inf:
            raise BadInputError(
                f'{what.plural} from {least:g} to {most:g}: expected a range with {rest:g} inside')
        if actuator.energy is None:
            return least, most
        # Beyond the ends of a table the force is unknown.
        ends = [rest + _MARGIN * (x - rest) for x in actuator.energy.limits]
        return max(least, ends[0]), min(most, ends[1])


@dataclass(frozen=True, eq=False)
class Program:
    """A sequence of levels and its information."""

    level_times: Array  # in s
    levels: Array  # flux density in T from each time on
    std: dict[str, float]  # expected standard deviations, relative unless the value is 0
    information: float  # logarithm of the determinant of the information matrix
    reach: tuple[float, float]  # minimum and maximum stretch
    ends_at_rest: bool  # whether the motion ends at rest


@dataclass(frozen=True, eq=False)
class Excitation:
    """The sequence to record, and others of the same duration for comparison."""

    duration: float  # in s
    best: Program
    plain: Program  # steps to 0.1 and 0.4 from rest and back
    paper: Program  # the paper's shaped sequence

    @property
    def gains(self) -> dict[str, float]:
        """
        Ratio of the standard deviations after unshaped steps to those of the best, by parameter.

        The bias of the sensor is omitted: it is the noise over the square root of the number of
        samples for any motion.
        """
        return _ratios(self.plain.std, self.best.std)

    @property
    def improvement(self) -> float:
        """Smallest of the gains."""
        return min(self.gains.values())


def _ratios(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    """Return the ratios of standard deviations, except for the bias of the sensor."""
    names = [x for x in one if x != 'stretch_bias'] or list(one)
    return {x: one[x] / other[x] for x in names}


class Designer:
    """
    Search for the best sequence for an actuator.

    The duration is in s (default 180 periods of the block), the rate in samples per second, and
    ``noise`` the standard deviation of a sample. Raise `BadInputError` if the duration is too
    short.
    """

    def __init__(
            self, actuator: ActuatorParameters, bounds: Bounds, duration: float | None, *,
            rate: float = 1000.0, noise: float = 1e-3,
            free: Sequence[str] = quantities.DEFAULT_FREE) -> None:
        least, most = bounds.of_motion(actuator)
        self._free = quantities.check_free(free, actuator.law)
        if quantities.MODES in self._free:
            actuator = actuator if actuator.modes.ratios else replace(actuator, modes=EXPECTED)
            self._free = modal_free(actuator, self._free)
            # Modes change with the stretch, so that large motion would blur them.
            low, high = (x * abs(actuator.rest or 1.0) for x in _SMALL)
            least, most = max(least, actuator.rest + low), min(most, actuator.rest + high)
            bounds = replace(bounds, stretch_min=least, stretch_max=most)
        # The last move brings the first mode to rest, and the others fade. Short dwells would
        # feed the modes that nobody expects.
        self._last, self._still, self._shortest = (
            _LAST, _REST, _LEAST_DWELL) if not actuator.modes.ratios else (
            2.0 * _LAST, _MODAL_REST, _MODAL_DWELL)
        self._actuator, self._bounds, self._noise = actuator, bounds, noise
        self._values = quantities.values_of(actuator)
        self._group = actuator.nondimensional
        self.period = actuator.period
        check_number('rate', rate, 'Hz', above=0.0)
        check_number('noise', noise, above=0.0)
        duration = _PERIODS * self.period if duration is None else duration
        if not (_SHORTEST + self._last) * self.period <= duration < math.inf:
            raise BadInputError(
                f'duration is {duration:g} s: expected at least '
                f'{(_SHORTEST + self._last) * self.period:.3g} s, '
                f'{_SHORTEST + self._last:g} periods')
        if not FEWEST <= duration * rate <= 1e6:
            raise BadInputError(
                f'{duration:g} s at {rate:g} Hz are ' + (
                    'more than a million samples: expected a shorter sequence'
                    if duration * rate > 1e6 else f'{int(duration * rate)} samples: expected '
                    f'{FEWEST} or more'))
        self.duration, self._rate = duration, rate
        self._reference = dict.fromkeys(self._free, 1.0)
        self.point: Array = np.zeros(2 * _PATTERN)
        count = int(duration * rate)
        self._times: Array = np.arange(count) / rate
        self._dense: Array = np.linspace(
            0.0, duration, max(int(40.0 * duration / self.period), 200), dtype=np.float64)
        lower, upper = equations.stretch_limits(self._group)
        if math.isinf(upper):
            upper = 10.0
        rest = self._group.rest
        low = max(least, rest - _MARGIN * (rest - lower))
        high = min(most, rest + _MARGIN * (upper - rest))
        self._reach = least, most
        self._range = (
            max(bounds.flux_density_min, self._holding(low)),
            min(bounds.flux_density_max, self._holding(high)))

    def _holding(self, stretch: float) -> float:
        return float(equations.elastic_force(stretch, self._group)
                     ) * self._actuator.flux_density_unit

    def _respond(
            self, times: Array, level_times: Array, levels: Array, rtol: float,
            free: Sequence[str] = ()) -> Response | None:
        course = UncheckedMeasurement(times, level_times, levels, self._bounds.slew_limit)
        return respond(course, self._values, free, rtol=rtol)

    def judge(self, level_times: Array, levels: Array) -> Program | None:
        """Return a sequence with its information, None if its motion cannot be simulated."""
        coarse = self._respond(self._dense, level_times, levels, 1e-6)
        if coarse is None:
            return None
        reach = float(np.min(coarse.stretch)), float(np.max(coarse.stretch))
        late = self._dense > self.duration - 0.5 * self.period
        rest = float(np.ptp(coarse.stretch[late])) < self._still
        response = self._respond(self._times, level_times, levels, 1e-6, self._free)
        if response is None:
            return None
        matrix = response.jacobian.T @ response.jacobian / self._noise ** 2
        sign, size = np.linalg.slogdet(matrix)
        variances = np.diag(np.linalg.inv(matrix)) if sign > 0.0 else np.zeros(len(matrix))
        # Variances of a matrix that is singular except for rounding may be negative.
        deviations = np.sqrt(np.where(variances > 0.0, variances, math.inf))
        std = {}
        for name, deviation in zip(self._free, deviations.tolist(), strict=True):
            value = self._values[name]
            absolute = abs(quantities.derivative(name, value)) * deviation
            std[name] = absolute / abs(value) if value else absolute
        return Program(
            level_times, levels, std, float(size) if sign > 0.0 else -math.inf, reach, rest)

    def _ended(self, level_times: Array, levels: Array) -> tuple[Array, Array]:
        """Return a sequence with a final move to rest without field."""
        end = self.duration - self._last * self.period
        keep = level_times < end
        level_times, levels = level_times[keep], levels[keep]
        # Ramps have to end before the last move starts.
        state = self._respond(
            np.linspace(0.0, end, 50, dtype=np.float64), level_times, levels, 1e-9)
        time, unit = self._actuator.time_unit, self._actuator.flux_density_unit
        move = None if state is None else self._planned(
            [Setpoint(self._group.rest, math.inf)], end, MoveRequest.of(
                self._group, State(float(state.stretch[-1]), float(state.rate[-1]) * time,
                                   float(levels[-1]) / unit),
                limits=Limits(self._bounds.flux_density_min / unit,
                              self._bounds.flux_density_max / unit),
                delivery=Delivery(slew=self._bounds.slew_limit / unit * time)))
        if move is None or not np.all(np.isfinite(move)):
            move = np.array([[end, 0.0]])
        return np.append(level_times, move[:, 0]), np.append(levels, move[:, 1])

    def _planned(
            self, setpoints: Sequence[Setpoint], begin: float,
            request: MoveRequest | NondimensionalParameters) -> Array | None:
        """Return times in s, from a begin on, and levels in T of a plan; None if there is none."""
        time, unit = self._actuator.time_unit, self._actuator.flux_density_unit
        try:
            segments = plan_sequence(setpoints, request)
        except (RefusedError, BadInputError):
            return None
        return np.array([(begin + x.begin * time + y.time * time, y.load * unit)
                         for x in segments for y in x.move.levels])

    def _pattern(self, targets: Array, dwells: Array) -> tuple[Array, Array]:
        """Return the levels of a repeated pattern; the first is rest without field."""
        spans = dwells * self.period
        most = math.ceil(self.duration / float(np.min(spans)))
        times = np.cumsum(np.append(_BEGIN * self.period, np.resize(spans, most)))
        times = times[times < self.duration]
        levels = np.resize(np.clip(targets, *self._range), len(times))
        return np.append(0.0, times), np.append(0.0, levels)

    def _excess(self, level_times: Array, levels: Array) -> float:
        """Return the largest motion from rest relative to its limits."""
        response = self._respond(self._dense, level_times, levels, 1e-4)
        if response is None:
            return math.inf
        rest, (low, high) = self._group.rest, self._reach
        return max(
            (rest - float(np.min(response.stretch))) / (rest - low),
            (float(np.max(response.stretch)) - rest) / (high - rest))

    def _score(self, found: Program | None) -> float:
        """Return the score of a sequence within the limits that ends at rest."""
        low, high = self._reach
        if found is None or not found.ends_at_rest or (
                found.reach[0] < low or found.reach[1] > high):
            return -math.inf
        # The volume, and with a weight the worst parameter relative to unshaped steps.
        worst = min(_ratios(self._reference, found.std).values())
        return found.information + _WEIGHT * len(self._free) * math.log(max(worst, 1e-300))

    def _judged(self, point: Array) -> tuple[float, Program | None]:
        """Return score and program of a pattern, scaled to the limits of the stretch."""
        small, share = 0.0, 1.0
        for _ in range(_SCALINGS):
            excess = self._excess(*self._pattern(share * point[:_PATTERN], point[_PATTERN:]))
            if excess <= 1.0:
                small = max(small, share)
            if _ALMOST <= excess <= 1.0 or small == 1.0:
                break
            # Scale in proportion to the excess, and by much less if the motion cannot be
            # simulated.
            share = min(share * max(_AIM / excess, 0.3), 1.0)
        if not small:
            return -math.inf, None
        found = self.judge(*self._ended(*self._pattern(
            small * point[:_PATTERN], point[_PATTERN:])))
        return self._score(found), found

    def search(self, seed: int = 0) -> Program:
        """
        Return the best sequence found; the result is reproducible for a seed.

        Raise `BadInputError` if no sequence is within the limits.
        """
        if self.duration > _WINDOW * self.period >= FEWEST / self._rate:
            # The best pattern for a long time is already found over some tens of periods.
            part = Designer(
                self._actuator, self._bounds, _WINDOW * self.period, rate=self._rate,
                noise=self._noise, free=self._free)
            part.search(seed)
            score, found = self._judged(part.point)
            if found is not None and score > -math.inf:
                return found
        plain = self.plain()
        if plain is not None and all(math.isfinite(x) for x in plain.std.values()):
            self._reference = plain.std
        random = np.random.default_rng(seed)
        low, high = self._range
        # Large steps to both sides, each with time to ring; and random long and short ones.
        points: list[Array] = [
            np.append([0.5 * high, high, low, 0.0, 0.3 * high], np.full(_PATTERN, 4.0)),
            *(np.append(random.uniform(low, high, _PATTERN), np.exp(
                random.uniform(math.log(self._shortest), math.log(_MOST_DWELL), _PATTERN)))
              for _ in range(_FIRST))]
        tried = sorted(((*self._judged(x), x) for x in points), key=lambda x: -x[0])[:_KEPT]
        for steps in (_FEW, _STEPS):
            tried = sorted((self._improved(*x, steps, random) for x in tried),
                           key=lambda x: -x[0])[:1]
        score, best, self.point = tried[0]
        if best is None or score == -math.inf:
            raise BadInputError(
                f'no sequence keeps within {self._actuator.coordinate.plural} of '
                f'{self._reach[0]:g} to {self._reach[1]:g} and ends at rest: expected wider '
                'limits or a longer duration')
        return best

    def _improved(
            self, score: float, best: Program | None, point: Array, steps: int,
            random: np.random.Generator) -> tuple[float, Program | None, Array]:
        """Change the values of a pattern one by one, and keep improvements."""
        low, high = self._range
        width = 0.5
        for i in range(steps):
            trial = point.copy()
            place = i % len(trial)
            size = (high - low) if place < _PATTERN else 2.0
            trial[place] += width * size * random.standard_normal()
            trial[:_PATTERN] = np.clip(trial[:_PATTERN], low, high)
            trial[_PATTERN:] = np.clip(trial[_PATTERN:], self._shortest, _MOST_DWELL)
            value, found = self._judged(trial)
            if value > score:
                best, score, point = found, value, trial
            elif place == len(trial) - 1:
                width = max(0.8 * width, 0.02)
        return score, best, point

    def plain(self, targets: Sequence[float] = PLAIN) -> Program | None:
        """Return a sequence of unshaped steps, smaller if they would exceed the limits."""
        span = self.duration / len(targets)
        times = np.append(0.0, span * (np.arange(len(targets)) + 1e-3))
        for share in np.linspace(1.0, 0.1, 19).tolist():
            levels = np.append(0.0, [self._holding(self._group.rest + share * x) for x in targets])
            if np.all(np.isfinite(levels)) and self._excess(times, levels) <= 1.0:
                return self.judge(times, levels)
        return None

    def paper(self) -> Program | None:
        """Return the paper's shaped sequence; None if it cannot be planned."""
        span = self.duration / len(PAPER)
        levels = self._planned(
            [Setpoint(self._group.rest + x, span / self._actuator.time_unit) for x in PAPER],
            1e-3 * span, self._group)
        return None if levels is None else self.judge(
            np.append(0.0, levels[:, 0]), np.append(0.0, levels[:, 1]))


def excite(
        actuator: ActuatorParameters, bounds: Bounds | None = None, *,
        duration: float | None = None, rate: float = 1000.0, noise: float = 1e-3,
        free: Sequence[str] = quantities.DEFAULT_FREE) -> Excitation:
    """
    Design the sequence to record for identification, and two others to compare it with.

    The others are unshaped steps and the sequence of the paper. The actuator contains prior
    values, the duration is in s (default 180 periods of the block), the rate in samples per
    second, and ``noise`` is the standard deviation of a sample. Raise `BadInputError` if bounds or
    numbers allow no sequence.
    """
    designer = Designer(actuator, bounds or Bounds(), duration, rate=rate, noise=noise, free=free)
    best = designer.search()
    nothing = Program(
        np.zeros(1), np.zeros(1), dict.fromkeys(best.std, math.inf), -math.inf,
        (actuator.rest, actuator.rest), True)
    return Excitation(
        designer.duration, best, designer.plain() or nothing, designer.paper() or nothing)
