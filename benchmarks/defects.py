"""
Recordings of actuators that deviate from the model, integrated by SciPy alone.

Many actuators of one kind are integrated at once, in units of their own time scale L sqrt(rho/G)
and modulus. Of the package, only the block's parameters and the `Measurement` class are used.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import mu_0
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from hmsa.identification.measurement import Measurement
from hmsa.model.parameters import ActuatorParameters, paper_actuator

Array = NDArray[np.float64]
BLOCK = paper_actuator()
_C1 = 2.0 * (BLOCK.half_thickness / BLOCK.half_length) ** 2
_MASS = (1.0 + _C1) / 6.0
#: Period at rest, in time scales.
PERIOD = 2.0 * math.pi * math.sqrt(_MASS / 3.0)
_GRID = 0.01  # sampling interval of the motion that samples are interpolated from
# Rate below which friction is smoothed, so that the integration continues; and tolerances.
_SOFT, _RTOL, _ATOL = 2e-4, 1e-8, 1e-10
_STEPS, _DWELL, _REPEATS = (1.1, 1.4, 1.0), 10.0, 9


@dataclass(frozen=True, eq=False)
class Plants:
    """Actuators and their defects; arrays of shape (n,)."""

    damping: Array  # fraction of critical damping at rest
    limit: Array  # J_lim
    modulus: Array  # G in Pa
    remanence: Array  # Br in T
    friction: Array  # force in G
    drag: Array  # force by the square of the rate, relative to the damping
    second: Array  # of another mode, fraction of its motion in the sensor's reading
    higher: Array  # its frequency relative to the first
    hysteresis: Array  # of the coil, fraction of the largest level
    foreign: Array  # fraction of the elastic force by another hyperelastic model
    gain: Array  # of the sensor
    latency: Array  # of the sensor in time scales

    def block(self, i: int) -> ActuatorParameters:
        """Return the parameters of one actuator that the model includes."""
        block = replace(
            BLOCK, shear_modulus=float(self.modulus[i]), remanence=float(self.remanence[i]),
            chain_limit=float(self.limit[i]))
        # A damping of 1 in units of G and the time scale, in N s/m.
        unit = 8.0 * block.half_length ** 2 / block.half_thickness * block.shear_modulus * (
            block.time_unit)
        return replace(
            block, damping_coefficient=float(self.damping[i]) * 2.0 * math.sqrt(3.0 * _MASS)
            * unit)


def plants(count: int, seed: int, **defects: tuple[float, float]) -> Plants:
    """Draw actuators; ``defects`` gives the range of each defect's size."""
    random = np.random.default_rng(seed)

    def drawn(low: float, high: float) -> Array:
        return np.exp(random.uniform(math.log(low), math.log(high), count))

    common = {
        'damping': drawn(0.05, 0.25), 'limit': drawn(3.0, 8.0),
        'modulus': BLOCK.shear_modulus * drawn(0.7, 1.4),
        'remanence': BLOCK.remanence * drawn(0.8, 1.25)}
    zero = {x: np.zeros(count) for x in (
        'friction', 'drag', 'second', 'hysteresis', 'foreign', 'latency')}
    sizes = {x: drawn(*y) for x, y in defects.items()}
    sign = np.where(random.uniform(size=count) < 0.5, -1.0, 1.0)
    gain = 1.0 + sign * sizes.pop('gain', np.zeros(count))
    return Plants(**{**common, **zero, 'higher': np.full(count, 4.0), **sizes, 'gain': gain})


def _force(plants: Plants, stretch: Array) -> Array:
    """Return the elastic force: Gent's, and a fraction of a model with a softer middle range."""
    square = 2.0 / stretch + stretch ** 2 - 3.0
    base = stretch - stretch ** -2
    own = base / (1.0 - square / plants.limit)
    other = base * (0.55 + 0.45 / stretch ** 3 + 0.15 * square ** 2)
    found: Array = own + plants.foreign * (other - own)
    return found


def motion(plants: Plants, switches: Array, levels: Array, end: float) -> Callable[
        [int, Array], Array]:
    """
    Return a function of the index of a plant and times that returns the sensor's stretch.

    ``levels``, shape (n, m), are loads in G in force from each of m switches on; all times are
    in the plants' own time scales.
    """
    count = len(plants.damping)
    damped = plants.damping * 2.0 * math.sqrt(3.0 * _MASS)
    omega = plants.higher * 2.0 * math.pi / PERIOD
    reach = np.max(np.abs(levels), axis=1)
    width = plants.hysteresis * reach
    field = np.empty_like(levels)
    played = levels[:, 0]
    for i in range(len(switches)):
        # Play model of an iron core: the field lags the current by half its width.
        played = np.clip(played, levels[:, i] - width, levels[:, i] + width)
        field[:, i] = played
    state = np.zeros((4, count))
    state[0] = 1.0
    times, rows = [], []
    for i, begin in enumerate(switches):
        stop = switches[i + 1] if i + 1 < len(switches) else end
        grid = np.linspace(begin, stop, max(int((stop - begin) / _GRID), 4))
        drive = field[:, i]

        def slope(_: float, flat: Array, drive: Array = drive) -> Array:
            stretch, rate, other, fast = flat.reshape(4, count)
            rubbed = plants.friction * rate / np.sqrt(rate ** 2 + _SOFT ** 2)
            total = (
                drive - _force(plants, stretch) - damped * rate - rubbed
                - plants.drag * damped * np.abs(rate) * rate
                + 0.25 * rate ** 2 / stretch ** 4)
            return np.concatenate([
                rate, total * 6.0 / (stretch ** -3 + _C1), fast,
                omega ** 2 * (plants.second * drive / 3.0 - other) - 0.06 * omega * fast])

        stiff = bool(np.any(plants.friction))
        solved = solve_ivp(
            slope, (begin, stop), state.ravel(), method='LSODA' if stiff else 'DOP853',
            t_eval=grid, rtol=_RTOL, atol=_ATOL)
        found = solved.y.reshape(4, count, -1)
        times.append(grid[:-1])
        rows.append(found[:, :, :-1])
        state = found[:, :, -1]
    time = np.concatenate(times)
    whole = np.concatenate(rows, axis=2)

    def seen(place: int, at: Array) -> Array:
        stretch, rate, other, fast = whole[:, place]
        spline = CubicHermiteSpline(time, stretch + other, rate + fast)
        found: Array = plants.gain[place] * spline(at - plants.latency[place])
        return found

    return seen


def sequence(plants: Plants, targets: tuple[float, ...] = _STEPS, repeats: int = _REPEATS,
             dwell: float = _DWELL) -> tuple[Array, Array, float]:
    """Return switches, loads and the end of unshaped steps to targets as the model holds them."""
    held: list[Array] = [np.zeros(len(plants.damping))]
    for target in targets * repeats:
        square = 2.0 / target + target ** 2 - 3.0
        held.append((target - target ** -2) / (1.0 - square / plants.limit))
    switches = np.append(0.0, 2.0 + dwell * np.arange(len(held) - 1))
    return switches, np.stack(held, axis=1), 2.0 + dwell * (len(held) - 1)


@dataclass(frozen=True)
class Sensor:
    """Sensor and sampling of a recording."""

    per_period: float = 20.0  # samples
    noise: float = 1e-3
    kind: str = 'white'  # or coloured, quantised, jittered


def measured(place: int, given: Plants, seen: Callable[[int, Array], Array], switches: Array,
             levels: Array, end: float, sensor: Sensor, seed: int, at: Array | None = None
             ) -> Measurement:
    """Return the recording of one plant in SI; evenly sampled unless times are given."""
    random = np.random.default_rng((seed, place))
    block = given.block(place)
    unit = block.time_unit
    if at is None:
        at = np.arange(
            0.05, end - 0.05, PERIOD / sensor.per_period, dtype=np.float64)
    noise: Array = sensor.noise * random.standard_normal(len(at))
    true: Array = at
    if sensor.kind == 'jittered':
        true = np.clip(at + 0.002 * PERIOD * random.standard_normal(len(at)), 0.02, end - 0.03)
    if sensor.kind == 'coloured':
        from scipy.signal import lfilter  # others need not wait for it
        noise = lfilter([math.sqrt(1.0 - 0.8 ** 2)], [1.0, -0.8], noise)
    stretch = seen(place, true) + noise
    if sensor.kind == 'quantised':
        step = 2.0 * sensor.noise
        stretch = np.round(stretch / step) * step
    per_load = block.shear_modulus * mu_0 / block.remanence
    return Measurement(at * unit, stretch, switches * unit, levels[place] * per_load)


def away(block: ActuatorParameters, random: np.random.Generator, most: float = 0.3
         ) -> ActuatorParameters:
    """Return a block as in a data sheet, changed by up to a factor of exp(``most``)."""
    factors: Any = np.exp(random.uniform(-most, most, 4))
    return replace(
        block, shear_modulus=block.shear_modulus * factors[0],
        remanence=block.remanence * factors[1], chain_limit=block.chain_limit * factors[2],
        damping_coefficient=block.damping_coefficient * factors[3])
