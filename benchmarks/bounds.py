"""
Bound on the error of a laboratory's second move, by Cramer and Rao with priors.

The first move is planned with the given parameters. Its samples and the distributions in
`laboratory` determine how well parameters can be estimated; the second move is planned with the
most probable ones.
"""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.laboratory import Bench, KINDS
from hmsa.identification.quantities import complete, values_of
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Options, Planner
from hmsa_lab.adapt.motion import follow, Levels, rest

Array = NDArray[np.float64]
# Parameters that may deviate, and the width of each one's distribution: of the logarithm, or
# relative to the damping coefficient, the time scale or the unit of force.
_WIDTHS = {
    'modulus': {'shear_modulus': math.log(1.25 / 0.8), 'damping_coefficient': math.log(4.0)},
    'remanence': {'remanence': 0.16}, 'lag': {'coil_time_constant': 0.1},
    'stamps': {'sensor_latency': 0.1}, 'gain': {'stretch_gain': 0.06},
    'creep': {'viscoelastic_ratio': 0.06, 'viscoelastic_time': math.log(20.0)},
    'force': {'constant_force': 0.03}}
_BIAS = 6e-3
# Duration before the first move, after each, and of a look at its error, in time scales; number
# of points in a look.
_BEFORE, _HOLD, _LOOK, _TIMES = 15.0, 22.0, 3.0, 30
_DRAWS = 64


def bound(bench: Bench, kinds: Sequence[str] = tuple(KINDS)) -> float:
    """
    Return the median error of the second move, as a fraction of its step.

    The quantities of these kinds are uncertain, and so is the sensor's bias. Vibration follows
    from the samples of the first move, the final offset also from those of the second.
    """
    free = (*(y for x in kinds for y in _WIDTHS[x]), 'stretch_bias')
    begin, arrivals, levels = _planned(bench)
    second, end = arrivals[0] + _HOLD * bench.unit, arrivals[1] + _HOLD * bench.unit
    times: Array = np.arange(begin, end, bench.period, dtype=np.float64)
    look = np.linspace(0.0, _LOOK * bench.unit, _TIMES)
    shown, judged = _derivatives(
        bench, free, levels, begin, times, np.concatenate([
            arrivals[1] + look, end - look[::-1]]))
    random = np.random.default_rng((29, bench.seed))
    known = [_drawn(shown[times < x], bench, random) for x in (second, end)]
    early, late = judged[:_TIMES] @ known[0], judged[_TIMES:] @ known[0]
    vibration = np.maximum(np.ptp(early, axis=0), np.ptp(late, axis=0))
    offset = np.abs(np.mean(judged[_TIMES:] @ known[1], axis=0))
    return float(np.median(vibration + offset)) / abs(bench.targets[1] - bench.targets[0])


def _planned(bench: Bench) -> tuple[float, list[float], Levels]:
    """Return the start time, the arrivals of two moves, and their levels; times in s."""
    rows, arrivals, time = [(-100.0 * bench.unit, 0.0)], list[float](), 0.0
    for planner, target in zip((
            Planner(bench.given, Options(lead_time=0)),
            Planner(bench.block, Options(lead_time=0, coil_time_constant=bench.lag),
                    stretch=bench.targets[0])), bench.targets, strict=False):
        plan = planner.setpoint(target, 0)
        rows += [(time + x.stamp / NANOSECONDS, x.flux_density)
                 for x in plan.levels if x.stamp >= 0]
        arrivals.append(time + (plan.segments[-1].arrival or 0) / NANOSECONDS)
        time = arrivals[-1] + _HOLD * bench.unit
    return -_BEFORE * bench.unit, arrivals, Levels(*np.array(rows).T)


def _derivatives(
        bench: Bench, free: tuple[str, ...], levels: Levels, begin: float, times: Array,
        looks: Array) -> tuple[Array, Array]:
    """Return derivatives of readings at ``times`` and of the stretch at ``looks``, normalised."""
    values = complete(values_of(bench.block, {
        'coil_time_constant': bench.lag, 'stretch_gain': bench.gain,
        'constant_force': bench.force, 'viscoelastic_ratio': bench.ratio,
        'viscoelastic_time': bench.relaxation}), free)
    at = rest(values, free, 0.0)
    both = np.append(times, looks)
    order = np.argsort(both, kind='stable')
    motion = None if at is None else follow(
        values, free, (at[0], 0.0), levels, begin, both[order])
    if at is None or motion is None:
        raise ValueError(f'laboratory {bench.seed} cannot be followed')
    place = np.argsort(order)
    by = motion.by[place, :-2] + np.outer(motion.by[place, -2], at[2])
    columns = {'stretch_gain': motion.stretch[place] - 1.0, 'stretch_bias': np.ones(len(both)),
               'sensor_latency': -bench.gain * motion.rate[place]}
    shown = np.stack([columns.get(x, bench.gain * by[:, i]) for i, x in enumerate(free)], axis=1)
    shown *= _deviations(bench.given, free)
    judged: Array = shown[len(times):].copy()
    judged[:, [x in ('stretch_bias', 'sensor_latency') for x in free]] = 0.0
    return shown[:len(times)], judged


def _deviations(given: ActuatorParameters, free: Sequence[str]) -> Array:
    """Return the standard deviations of the uniform distributions, in SI."""
    units = {'damping_coefficient': given.damping_coefficient, 'sensor_latency': given.time_unit,
             'coil_time_constant': given.time_unit,
             'constant_force': 1.0 / given.load_per_newton}
    widths = {y: z for x in _WIDTHS.values() for y, z in x.items()} | {'stretch_bias': _BIAS}
    return np.array([widths[x] * units.get(x, 1.0) / math.sqrt(12.0) for x in free])


def _drawn(shown: Array, bench: Bench, random: np.random.Generator) -> Array:
    """Return random deviations consistent with the samples, one per column."""
    information = np.eye(shown.shape[1]) + (
        1.0 - bench.dropouts) * shown.T @ shown / bench.noise ** 2
    return np.linalg.solve(
        np.linalg.cholesky(information).T,
        random.standard_normal((len(information), _DRAWS)))
