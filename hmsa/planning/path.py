"""
Paths of the stretch to follow, such as a dense trajectory with velocities.

The stretch is a flat output (`hmsa.model.simulation`). Commands are steps of the load
(zero-order hold) or ramps. The double integral of a sequence of steps is a quadratic spline, and
the error of the stretch follows from the error of this double integral. The levels are therefore
those whose spline is nearest, in the mean square, to the double integral of the load (of the
amplifier output if the field lags). They are as long as the tolerance allows. The last ones are
corrected to end exactly at rest.

This inverts the first mode. If the actuator has secondary modes, what all modes together leave is
added to the path of the first one, and the levels are computed again, for as long as that helps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
import math
from typing import Any

import numpy as np

from hmsa import motion
from hmsa.model import law
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move, State
from hmsa.model.simulation import (
    branches_of,
    follow,
    held_along,
    loads_for,
    observed,
    sampled,
)
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import TOLD
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.shooting import Attempt, solve, Template, within_limits
from hmsa.planning.shapers.two_step import two_step

#: Stretch, rate and acceleration, shape (n,) each, at times from the start.
Course = Callable[[Array], tuple[Array, Array, Array]]

# Steps of height a and duration h cause a ripple of a h^2/(72 sqrt(3) m) in stretch.
_RIPPLE = 1.0 / (72.0 * math.sqrt(3.0))
# Fraction of the tolerance for this ripple, which is larger next to a jump of the load.
_SHARE = 0.15
# Minimum and maximum number of levels of a path, minimum number per natural period, levels of a
# block, overlap of blocks, and maximum number of corrected levels at the end.
_FEWEST, _MOST, _OF_EACH, _BLOCK, _OVERLAP, _LAST = 24, 200_000, 6, 200, 12, 240
# Knots of a return to a path.
_JOINT = 9
# Maximum number of iterations that account for ramps, and the change of load that ends them.
_RAMPED, _SETTLED = 60, 1e-9
#: Deviation of the stretch up to which the actuator is on a path.
ON_PATH = 1e-5
# Minimum range of stretch of a path.
_LEAST_RANGE = 1e-3
# If limits are active: speeds of the return to the path to try, in natural frequencies.
_RETURN = (3.0, 1.0)
# Duration at the end in which levels are corrected, in natural periods.
_ENDING = 0.6
# Maximum number of corrections for secondary modes, and the decrease of the deviation below which
# there is no further one: they converge up to about the first natural frequency.
_CORRECTED, _DECREASE = 10, 0.85
# Weight of the vibration after the end beside the deviation from the path.
_AFTER = 4.0
# Samples per period of the fastest mode; standard deviation of the filter of corrections, over the
# first angular frequency; durations of their onset, in natural periods and as a fraction of the
# path at most. Faster changes of the path of the first mode excite the others, also after the end
# (test_a_wave_of_a_continuum_is_that_of_all_its_modes).
_SEEN, _FILTER, _ONSET, _PART = 16, 1.2, 2.0, 0.25

# Gauss points of an interval of unit length, and matrices that integrate polynomials through them
# once and twice, up to each point and to the end, or evaluate them at the end.
_POINTS, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(6))
_POINTS = _POINTS + 0.5
_ORDERS = np.arange(6)
_INVERSE = np.linalg.inv(_POINTS[:, np.newaxis] ** _ORDERS)
_AT = np.append(_POINTS, 1.0)[:, np.newaxis]
_VALUE = (_AT ** _ORDERS) @ _INVERSE
_ONCE = (_AT ** (_ORDERS + 1) / (_ORDERS + 1)) @ _INVERSE
_TWICE = (_AT ** (_ORDERS + 2) / ((_ORDERS + 1) * (_ORDERS + 2))) @ _INVERSE


@dataclass(frozen=True)
class Path:
    """A dimensionless path of the stretch that starts at time 0."""

    #: Knots of the path, increasing, shape (n,), from 0 to its end.
    breaks: Array
    course: Course

    @classmethod
    def through(
            cls, times: Array, stretches: Array, rates: Array,
            accelerations: Array | None = None) -> 'Path':
        """
        Return the path through points, shape (n,) each, as joint_trajectory_controller defines it.

        The path is a cubic Hermite spline, or one of degree 5 if accelerations are given.
        """
        from scipy.interpolate import CubicHermiteSpline, PPoly  # slow to import

        if accelerations is None:
            spline = CubicHermiteSpline(times, stretches, rates)
        else:
            spline = PPoly(_quintic(np.diff(times), stretches, rates, accelerations), times)
        return cls._of(spline, times)

    @classmethod
    def smooth(cls, times: Array, stretches: Array) -> 'Path':
        """Return the smoothest path through stretches, shape (n,), from rest to rest."""
        from scipy.interpolate import make_interp_spline  # slow to import

        ends = [(1, 0.0), (2, 0.0)]
        return cls._of(make_interp_spline(times, stretches, 5, bc_type=(ends, ends)), times)

    @classmethod
    def _of(cls, spline: Any, times: Array) -> 'Path':
        slope, curve = spline.derivative(), spline.derivative(2)
        return cls(times, lambda t: (spline(t), slope(t), curve(t)))

    def since(self, time: float) -> 'Path':
        """Return the rest of the path from a time on, which becomes time 0."""
        begins = np.searchsorted(self.breaks, time, side='right')
        return Path(
            np.append(0.0, self.breaks[begins:] - time),
            lambda t: self.course(t + time))

    def scaled(self, unit: float) -> 'Path':
        """Return the path with its times divided by a unit."""
        scale = np.array([[1.0], [unit], [unit * unit]])

        def course(t: Array) -> tuple[Array, Array, Array]:
            stretch, rate, change = scale * self.course(t * unit)
            return stretch, rate, change

        return Path(self.breaks / unit, course)

    def corrected(self, times: Array, by: Array) -> 'Path':
        """Return the path with a spline through corrections added, shape (n,) each."""
        from scipy.interpolate import make_interp_spline  # slow to import

        more = Path._of(make_interp_spline(times, by, 5), times)

        def course(t: Array) -> tuple[Array, Array, Array]:
            own, other = self.course(t), more.course(t)
            return own[0] + other[0], own[1] + other[1], own[2] + other[2]

        return Path(self.breaks, course)

    def joined(self, stretch: float, rate: float, span: float) -> 'Path':
        """Return the path with a start at another state, from which it returns in a given time."""
        here = self.course(np.zeros(1))
        off, fast = stretch - float(here[0][0]), rate - float(here[1][0])
        back = np.polynomial.Polynomial([
            off, fast * span, 0.0, -10.0 * off - 6.0 * fast * span,
            15.0 * off + 8.0 * fast * span, -6.0 * off - 3.0 * fast * span])
        slope, curve = back.deriv(), back.deriv(2)

        def course(t: Array) -> tuple[Array, Array, Array]:
            share = np.minimum(t / span, 1.0)
            more = back(share), slope(share) / span, curve(share) / span ** 2
            wanted = self.course(t)
            return wanted[0] + more[0], wanted[1] + more[1], wanted[2] + more[2]

        joint = np.linspace(0.0, span, _JOINT)
        return Path(np.union1d(self.breaks, joint), course)


def _quintic(spans: Array, x: Array, v: Array, a: Array) -> Array:
    """Return the coefficients of polynomials of degree 5 between points, highest order first."""
    move = x[1:] - x[:-1] - spans * (v[:-1] + 0.5 * spans * a[:-1])
    gain = (v[1:] - v[:-1] - spans * a[:-1]) * spans
    bend = (a[1:] - a[:-1]) * spans ** 2
    found: Array = np.array([
        (6.0 * move - 3.0 * gain + 0.5 * bend) / spans ** 5,
        (-15.0 * move + 7.0 * gain - bend) / spans ** 4,
        (10.0 * move - 4.0 * gain + 0.5 * bend) / spans ** 3,
        0.5 * a[:-1], v[:-1], x[:-1]])
    return found


def along(
        request: MoveRequest, path: Path, tolerance: float,
        check: Callable[[], None] = lambda: None) -> Move:
    """
    Follow a path to rest at its end, the target of the request.

    ``check`` is called every few ms of work, and abandons it by raising.

    The tolerance is the deviation that levels may leave, as a fraction of the range of the path;
    if the maximum is larger, the reason of the move reports it. Raise `RefusedError` if the path
    leaves the range of the model, or has no rest at its end.
    """
    request.holding_load()
    fit = _fitted(request, path, tolerance, check)
    move = fit.move()
    if not request.material.modes.ratios:
        return move
    return _with_modes(request, path, tolerance, fit, move, check)


def _with_modes(
        request: MoveRequest, path: Path, tolerance: float, fit: '_PathFit', move: Move,
        check: Callable[[], None]) -> Move:
    """Return the move whose secondary modes leave least to a path; another one fits the first."""
    from scipy.ndimage import gaussian_filter1d  # slow to import

    material, end = request.material, float(path.breaks[-1])
    period = 2.0 * math.pi / request.frequency
    fastest = max((material.modes.ratios[i] for i in material.modes.ringing), default=1.0)
    count = max(len(fit.edges), math.ceil(_SEEN * end * fastest / period))
    # The last period is after the end.
    times = end / count * np.arange(count + math.ceil(count * period / end), dtype=float)

    def left(move: Move) -> Array:
        seen, _ = observed(sampled(
            move.levels, request.start, times, material, request.delivery), material)
        off: Array = path.course(np.minimum(times, end))[0] - seen
        return off

    off = left(move)
    onset = min(_ONSET * period, _PART * end)
    share = np.clip(np.minimum(times, end - times) / onset, 0.0, 1.0)
    window = share ** 3 * (10.0 + share * (6.0 * share - 15.0))
    weights, by = np.where(times > end, _AFTER, 1.0), np.zeros(len(times))
    for _ in range(_CORRECTED):
        least = np.max(weights * np.abs(off))
        if least <= fit.allowed:
            break
        by += window * gaussian_filter1d(
            off, _FILTER / (request.frequency * times[1]), mode='constant')
        try:
            after = _fitted(request, path.corrected(times, by), tolerance, check)
            tried = after.move()
        except RefusedError:
            break  # the first mode would leave the range of the model
        remaining = left(tried)
        largest = np.max(weights * np.abs(remaining))
        if largest < least:
            fit, move, off = after, tried, remaining
        if not largest <= _DECREASE * least:
            break
    most = int(np.argmax(np.abs(off)))
    return move._replace(reason='' if abs(off[most]) <= TOLD * fit.range else fit.words(
        float(abs(off[most])), float(times[most]), 'its secondary modes'))


def _fitted(
        request: MoveRequest, path: Path, tolerance: float, check: Callable[[], None]
) -> '_PathFit':
    fit = _PathFit(request, path, tolerance)
    while fit.done < len(fit.edges) - 1:
        fit.advance()
        check()
    return fit


class _PathFit:
    """Computation of the levels of a path, block by block."""

    def __init__(self, request: MoveRequest, path: Path, tolerance: float) -> None:
        self._request, self._path = request, path
        self.range, self.edges = _edges(request, path, tolerance)
        self.allowed = tolerance * self.range
        self.done = 0  # intervals with known levels
        self._levels: list[Level] = []
        self._states = [request.start]
        self._followed = branches_of(request.state, request.material)
        # Errors of the integral and double integral of the command, and the present load.
        inertia = law.mass(request.state.stretch, request.material.packed)
        begin = self._course(np.zeros(1))
        self._lack = np.array([
            inertia * (request.state.rate - begin[1][0]),
            inertia * (request.state.stretch - begin[0][0])])
        self._reached = request.field
        self._times: list[Array] = []
        self._away: list[Array] = []
        self._limited: set[Code] = set()

    def _course(self, times: Array) -> tuple[Array, Array, Array]:
        """Return stretch, rate and acceleration of the path, which is at rest after its end."""
        end = self._path.breaks[-1]
        stretch, rate, change = self._path.course(np.minimum(times, end))
        return stretch, np.where(times > end, 0.0, rate), np.where(times > end, 0.0, change)

    def advance(self) -> None:
        """Compute the levels of the next block."""
        first, last = self.done, min(self.done + _BLOCK, len(self.edges) - 1)
        fitted = min(last + _OVERLAP, len(self.edges) - 1)
        edges, keep = self.edges[first:fitted + 1], last - first
        stretch, loads = self._inverse(edges, keep)
        levels = self._fit(edges, loads, keep)
        limits = self._request.limits
        clipped = np.clip(levels, limits.minimum, limits.maximum)
        state = self._states[-1]
        away = abs(state.stretch - float(self._course(edges[:1])[0][0]))
        if np.any(clipped != levels):
            self._limited.add(Code.FLUX_LIMIT)
            self._lack = np.zeros(2)
        ways = [clipped]
        if np.any(clipped != levels) or away > 10.0 * self.allowed:
            ways += [self._returning(edges[:keep + 1], clipped, x) for x in _RETURN]
        self._take(edges[:keep + 1], ways, stretch[:keep])
        self.done = last

    def _inverse(self, edges: Array, keep: int) -> tuple[Array, Array]:
        """Return stretch and load of the path at the Gauss points between edges, (n, 6) each."""
        material = self._request.material
        spans = np.diff(edges)
        times: Array = (edges[:-1, np.newaxis] + spans[:, np.newaxis] * _POINTS).ravel()
        stretch, rate, wanted = self._course(times)
        loads = loads_for(stretch, rate, wanted, material)
        if material.creeps:
            # Include the edges, since the next block starts with the branch states at one of them.
            every = np.append(np.column_stack([edges[:-1], times.reshape(-1, 6)]), edges[-1])
            held, behind = held_along(
                every, self._course(every)[0], self._followed, material)
            loads = loads + held[:-1].reshape(-1, 7)[:, 1:].ravel()
            self._followed = tuple(behind[7 * keep].tolist())
        return stretch.reshape(-1, 6), loads.reshape(-1, 6)

    def _fit(self, edges: Array, loads: Array, keep: int) -> Array:
        """Return the levels of a block."""
        from scipy.interpolate import BSpline  # slow to import
        from scipy.sparse.linalg import spsolve

        delivery, start = self._request.delivery, self._states[-1].ramps_from
        lag, slew, inner = delivery.lag, delivery.slew, np.diff(edges)[:, np.newaxis]
        since: Array = edges[:-1, np.newaxis] - edges[0] + inner * _AT.T
        # The amplifier also supplies the change of the field: lag times rate.
        once, twice, values = _integrals(loads, inner)
        twice += lag * (once - self._reached * since)
        once += lag * (values - self._reached)
        target = twice - self._lack[1] - self._lack[0] * since
        knots = np.concatenate([[edges[0]] * 2, edges, [edges[-1]] * 2])
        weights = np.sqrt(inner * _WEIGHTS).ravel()
        design = BSpline.design_matrix(
            (edges[:-1, np.newaxis] + inner * _POINTS).ravel(), knots, 2).multiply(
                weights[:, np.newaxis]).tocsc()
        # The first two coefficients are value and slope at the start, both 0; the last two are
        # value and slope at the end, prescribed where the path ends.
        free = slice(2, -2 if edges[-1] == self.edges[-1] else None)
        normal = (design[:, free].T @ design[:, free]).tocsc()
        coefficients = np.zeros(len(edges) + 1)
        more: Array = np.zeros_like(target)
        gained: Array = np.zeros(len(loads))
        levels = np.full(len(loads), math.inf)
        for _ in range(1 if math.isinf(slew) else _RAMPED):
            before = levels
            wanted = target - more
            if free.stop is not None:
                # The final field holds the end of the path, regardless of the field before.
                slope = once[-1, -1] - self._lack[0] - gained[-1] + lag * (
                    self._request.balance(self._followed) - values[-1, -1])
                coefficients[-2:] = wanted[-1, -1] - 0.5 * inner[-1, 0] * slope, wanted[-1, -1]
            coefficients[free] = 0.0
            coefficients[free] = spsolve(normal, design[:, free].T @ (
                weights * wanted[:, :-1].ravel() - design @ coefficients))
            spline = BSpline(knots, coefficients, 2)
            levels = spline.derivative(2)(edges[:-1] + 0.5 * inner[:, 0])
            if math.isfinite(slew):
                more, gained = _ramped(levels, start, inner, slew)
            if np.max(np.abs(levels - before)) <= _SETTLED:
                break
        end = keep - 1
        self._lack = np.array([
            self._lack[0] + levels[:keep] @ inner[:keep, 0] + gained[end] - once[end, -1],
            float(spline(edges[keep])) + more[end, -1] - target[end, -1]])
        self._reached = float(values[end, -1])
        return levels[:keep]

    def _take(self, edges: Array, ways: Sequence[Array], stretch: Array) -> None:
        """Keep the candidate levels between edges whose motion stays nearest to the path."""
        request, start = self._request, self._states[-1]
        times = np.column_stack([
            edges[:-1, np.newaxis] + np.diff(edges)[:, np.newaxis] * _POINTS, edges[1:]])
        least = math.inf
        for tried in ways:
            course = sampled(
                tuple(map(Level, edges[:-1].tolist(), tried.tolist())), start, times.ravel(),
                request.material, request.delivery)
            off = np.abs(course[motion.STRETCH].reshape(times.shape)[:, :-1] - stretch)
            if not float(np.max(off)) >= least:
                least, levels, found, away = float(np.max(off)), tried, course, off
        self._times.append(times[:, :-1])
        self._away.append(away)
        output = start.ramps_from
        for level, span, row in zip(
                levels.tolist(), np.diff(edges).tolist(), found[:, 6::7].T.tolist(), strict=True):
            most = request.delivery.slew * span
            if abs(level - output) > most:
                self._limited.add(Code.SLEW_LIMIT)
            output += min(max(level - output, -most), most)
            lags = request.delivery.lag > 0.0
            self._states.append(State(
                row[0], row[1], row[2] if lags else output, output if lags else None,
                tuple(row[3:])))
        self._levels += map(Level, edges[:-1].tolist(), levels.tolist())

    def _returning(self, edges: Array, levels: Array, speed: float) -> Array:
        """Return levels within the limits that lead back to the path at a speed of `_RETURN`."""
        request = self._request
        limits, delivery, material = request.limits, request.delivery, request.material
        packed, state, found = material.packed, self._states[-1], levels.copy()
        stretch, rate, wanted = self._course(edges)
        field = loads_for(stretch, rate, wanted, material)
        for i, span in enumerate(np.diff(edges).tolist()):
            inertia = float(law.mass(state.stretch, packed))
            quick = speed * float(law.natural_frequency(state.stretch, packed))
            off, fast = state.stretch - stretch[i], state.rate - rate[i]
            if delivery.lag > 0.0:
                more = (state.load - field[i]) / inertia
                push = more - delivery.lag * quick * (
                    quick * quick * off + 3.0 * quick * fast + 3.0 * more)
            else:
                push = -quick * (quick * off + 2.0 * fast)
            found[i] = min(max(levels[i] + inertia * push, limits.minimum), limits.maximum)
            state = follow((Level(0.0, float(found[i])),), state, span, material, delivery)
        return found

    def move(self) -> Move:
        """Return the move of the known levels, with the last ones corrected to end at rest."""
        request, edges = self._request, self.edges
        end = float(edges[-1])
        begin = int(np.searchsorted(edges, end - _ENDING * 2.0 * math.pi / request.frequency))
        begin = max(min(begin, len(edges) - 1 - _FEWEST // 2), len(edges) - 1 - _LAST, 0)
        rest = replace(request, state=self._states[begin])
        found = within_limits(self._ended(rest, begin), request)
        if found is None:
            # The actuator is off the path at its end: add a move to rest.
            begin = len(edges) - 1
            last = two_step(replace(request, state=self._states[-1]))
            found = last.levels, last.duration
        since = float(edges[begin])
        levels = (*self._levels[:begin], *(Level(since + x.time, x.load) for x in found[0]))
        times = since + np.linspace(
            0.0, max(end - since, found[1]), 20 * (1 + len(found[0])), dtype=np.float64)[1:]
        wanted = np.where(
            times < end, self._course(np.minimum(times, end))[0], request.target)
        stretch = sampled(
            found[0], self._states[begin], times - since, request.material,
            request.delivery)[motion.STRETCH]
        times = np.append(np.concatenate(self._times)[:begin], times)
        away = np.append(np.concatenate(self._away)[:begin], np.abs(stretch - wanted))
        return Move(Code.PATH, levels, since + found[1], self.words(
            float(np.max(away)), float(times[np.argmax(away)])))

    def _ended(self, request: MoveRequest, begin: int) -> Attempt:
        """Return the last levels, from edge ``begin`` on, corrected to end at rest."""
        edges, delivery = self.edges[begin:] - self.edges[begin], request.delivery
        levels = np.array([x.load for x in self._levels[begin:]])
        middle = 0.5 * (edges[:-1] + edges[1:]) / edges[-1]
        angle = request.frequency * edges[-1] * (1.0 - middle)
        window = 4.0 * middle * (1.0 - middle) * (
            (request.limits.minimum < levels) & (levels < request.limits.maximum))
        changes = [window * np.sin(angle), window * np.cos(angle)]
        if delivery.lag > 0.0:
            changes.append(np.exp((middle - 1.0) * edges[-1] / (edges[-1] - edges[-2])))
        d_loads = np.zeros((len(edges), len(changes)))
        d_loads[:-1] = np.array(changes).T
        rounded = np.array([delivery.rounded(x) for x in edges.tolist()])
        levels = np.append(levels, self._request.balance(self._followed))
        return solve(Template(rounded, levels, np.zeros_like(d_loads), d_loads), request)

    def words(self, largest: float, when: float, other: str = '') -> str:
        """
        Return the largest deviation as text if it exceeds the tolerance, else an empty text.

        Another cause is named if the limits have no part in it.
        """
        if largest <= self.allowed:
            return ''
        request = self._request
        units, limits = request.units, request.limits
        why = [f'flux densities of {units.load_text(limits.minimum)} to '
               f'{units.load_text(limits.maximum)}'] * (Code.FLUX_LIMIT in self._limited)
        why += [f'ramps of {units.slew_text(request.delivery.slew)}'] * (
            Code.SLEW_LIMIT in self._limited)
        why += [other] * bool(not why and other)
        why += [f'a command period of {units.time_text(request.delivery.period)}'] * (
            not why and request.delivery.period > 0.0)
        return (
            f'the {units.coordinate} leaves the path by up to {largest:.3g} '
            f'({100.0 * largest / self.range:.2g} % of its range), at '
            f'{units.time_text(when)}' + f'; the limit is {" and ".join(why)}' * bool(why))


def prepare() -> None:
    """Import the modules that the first path needs, which takes up to some seconds."""
    for name in ('interpolate', 'sparse.linalg'):
        import_module(f'scipy.{name}')


def _integrals(loads: Array, spans: Array) -> tuple[Array, Array, Array]:
    """Return integral, double integral and value of a load (n, 6) at points and ends, (n, 7)."""
    once, twice = spans * (loads @ _ONCE.T), spans ** 2 * (loads @ _TWICE.T)
    first = np.append(0.0, np.cumsum(once[:, -1]))[:-1, np.newaxis]
    second = np.append(0.0, np.cumsum(
        twice[:, -1] + spans[:, 0] * first[:, 0]))[:-1, np.newaxis]
    return once + first, twice + first * spans * _AT.T + second, loads @ _VALUE.T


def _ramped(levels: Array, load: float, spans: Array, slew: float) -> tuple[Array, Array]:
    """
    Return the differences in double integral and integral between ramps to levels and steps.

    The double integral is at points and ends of intervals, (n, 7), the integral at the ends, (n,).
    """
    changes = np.empty(len(levels))
    for i, (level, span) in enumerate(zip(levels.tolist(), spans[:, 0].tolist(), strict=True)):
        changes[i] = level - load
        load += min(max(changes[i], -slew * span), slew * span)
    ramp = np.abs(changes)[:, np.newaxis] / slew
    times = np.minimum(spans * _AT.T, ramp)
    share = np.divide(times, ramp, out=np.zeros_like(times), where=ramp > 0.0)
    once = -changes[:, np.newaxis] * times * (1.0 - 0.5 * share)
    twice = -changes[:, np.newaxis] * times ** 2 * (0.5 - share / 6.0) + once * (
        spans * _AT.T - times)
    first = np.append(0.0, np.cumsum(once[:, -1]))
    second = np.append(0.0, np.cumsum(twice[:, -1] + spans[:, 0] * first[:-1]))[:-1, np.newaxis]
    return twice + first[:-1, np.newaxis] * spans * _AT.T + second, first[1:]


def _edges(request: MoveRequest, path: Path, tolerance: float) -> tuple[float, Array]:
    """Return the range of a path, the start times of its levels and its end."""
    material, delivery, breaks = request.material, request.delivery, path.breaks
    packed = material.packed
    spans = np.diff(breaks)[:, np.newaxis]
    times = (breaks[:-1, np.newaxis] + spans * _POINTS).ravel()
    stretch, rate, wanted = path.course(times)
    outside = ~((packed[law.LOWER] < stretch) & (stretch < packed[law.UPPER]))
    if np.any(outside):
        raise RefusedError(
            Code.OUT_OF_RANGE,
            f'the path goes to {request.units.coordinate} {stretch[outside][0]:.6g} at '
            f'{request.units.time_text(times[outside][0])}: expected a path between '
            f'{packed[law.LOWER]:.6g} and {packed[law.UPPER]:.6g}')
    span = max(float(np.ptp(np.append(stretch, request.target))), _LEAST_RANGE)
    loads = loads_for(stretch, rate, wanted, material).reshape(-1, 6)
    gaps = spans * np.diff(_POINTS)
    slopes = np.diff(loads) / gaps
    steep = np.max(np.abs(slopes), axis=1)
    if delivery.lag > 0.0:
        bends = np.diff(slopes) / (0.5 * (gaps[:, 1:] + gaps[:, :-1]))
        steep = steep + delivery.lag * np.max(np.abs(bends), axis=1)
    inertia = law.mass(request.target, packed)
    # A lag attenuates most of the ripple.
    cube = _SHARE * tolerance * span * inertia / (_RIPPLE * np.maximum(steep, 1e-12))
    longest = np.maximum(np.cbrt(cube), (cube * delivery.lag) ** 0.25)
    longest = np.minimum(longest, min(
        breaks[-1] / _FEWEST, 2.0 * math.pi / request.frequency / _OF_EACH))
    if delivery.period > 0.0:
        longest = np.maximum(longest, delivery.period)
    each = np.ceil(spans[:, 0] / longest)
    if not np.sum(each) <= _MOST:
        gap = float(np.median(spans))
        apart = gap * request.frequency / (2.0 * math.pi)
        raise RefusedError(
            Code.TOO_LONG,
            f'the path takes {np.sum(each):.3g} levels: expected at most {_MOST}; ' + (
                f'its points are {request.units.time_text(gap)}, {apart:.3g} natural periods '
                'apart: check that its times are in s; ' if apart > 1.0 else '') +
            'send it in parts, or allow a larger deviation from it (path_tolerance of the '
            'planner, tolerance in Python)')
    edges = np.append(np.concatenate([
        begin + length * np.arange(count) / count for begin, length, count in zip(
            breaks[:-1].tolist(), spans[:, 0].tolist(), each.astype(int).tolist(),
            strict=True)]), breaks[-1])
    grid = delivery.period or delivery.resolution
    if grid > 0.0:
        edges[-1] = grid * np.ceil(edges[-1] / grid * (1.0 - 1e-12))
        edges = grid * np.unique(np.round(edges / grid))
    return span, edges
