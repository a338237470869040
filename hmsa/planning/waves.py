"""
Periodic motions of the stretch: shapes, paths and feasible frequencies.

A path starts and ends at rest: a polynomial with three zero derivatives at either end fades the
wave in and out. All quantities are dimensionless.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model import law
from hmsa.model.equations import Array, elastic_force
from hmsa.model.simulation import fade, loads_for
from hmsa.planning.path import Path
from hmsa.planning.shapers.request import MoveRequest

#: Value and two derivatives with respect to the phase, whose period is 1, shape (n,) each.
Shape = Callable[[Array], tuple[Array, Array, Array]]

# Harmonics of a triangle wave; they round its corners.
_HARMONICS: Array = np.arange(1.0, 11.0, 2.0, dtype=np.float64)
# Minimum number of cycles and of natural periods of each fade.
_FADE_CYCLES, _FADE_PERIODS = 1, 2.0
# Knots of a path per cycle, and phases at which limits are checked.
_BREAKS, _PHASES = 8, 128
# Fraction of the slew limit that ramps between levels may use.
_SLEW_SHARE = 0.55
# Frequencies to check, relative to the natural frequency, and ratio of the highest to the lowest.
_LOOK: Array = np.geomspace(1e-3, 30.0, 400).astype(np.float64)
_MOST = 1e12
# Precision of the ends of bands.
_EDGE = 1e-4


def sine(phase: Array) -> tuple[Array, Array, Array]:
    """Return a sine."""
    return _series(phase, np.ones(1), np.ones(1))


def triangle(phase: Array) -> tuple[Array, Array, Array]:
    """Return a triangle wave of five harmonics with Lanczos weights and peaks of 1."""
    signs = (-1.0) ** (_HARMONICS // 2)
    weights = np.sinc(_HARMONICS / (_HARMONICS[-1] + 2.0)) / _HARMONICS ** 2
    return _series(phase, _HARMONICS, signs * weights / weights.sum())


def _series(phase: Array, orders: Array, weights: Array) -> tuple[Array, Array, Array]:
    turns = 2.0 * math.pi * orders
    angle = phase[:, np.newaxis] * turns
    return (np.sin(angle) @ weights, np.cos(angle) @ (weights * turns),
            -np.sin(angle) @ (weights * turns ** 2))


def sampled_shape(times: Array, stretches: Array) -> Shape:
    """
    Return the shape of one period of samples, shape (n,), with zero mean and peaks of 1.

    Raise `BadInputError` if the samples do not end where they began, or are no wave.
    """
    from scipy.interpolate import CubicSpline  # slow to import

    if len(times) < 4 or np.any(np.diff(times) <= 0.0):
        raise BadInputError(
            f'a wave of {len(times)} samples: expected one period of at least 4 samples at '
            'increasing times')
    if not np.all(np.isfinite(times)) or not np.all(np.isfinite(stretches)):
        raise BadInputError('the samples of a wave contain nan or inf: expected finite numbers')
    size = float(np.ptp(stretches))
    if not size > 0.0 or abs(stretches[-1] - stretches[0]) > 1e-6 * size:
        raise BadInputError(
            f'the period of the wave goes from {stretches[0]:g} to {stretches[-1]:g}: expected '
            'stretches that vary, and a last sample equal to the first')
    spans = (times - times[0]) / (times[-1] - times[0])
    values = np.append(stretches[:-1], stretches[0])
    spline = CubicSpline(spans, values, bc_type='periodic')
    mean = float(spline.integrate(0.0, 1.0))
    dense = spline(np.linspace(0.0, 1.0, 2049)) - mean
    peak = float(np.max(np.abs(dense)))
    slope, curve = spline.derivative(), spline.derivative(2)

    def shape(phase: Array) -> tuple[Array, Array, Array]:
        phase = np.mod(phase, 1.0)
        return (spline(phase) - mean) / peak, slope(phase) / peak, curve(phase) / peak

    return shape


@dataclass(frozen=True)
class Wave:
    """A periodic motion about a mean."""

    shape: Shape
    mean: float  #: stretch
    amplitude: float  #: of the stretch, above 0

    def path(self, request: MoveRequest, frequency: float, last: float, cycles: float) -> Path:
        """Return the path of a wave or sweep from rest, with a number of cycles, to rest."""
        start = request.state.stretch
        period = 2.0 * math.pi / float(
            law.natural_frequency(self.mean, request.material.packed))
        fades = [math.ceil(max(_FADE_CYCLES, _FADE_PERIODS * period * x)) / x
                 for x in (frequency, last)]
        inner = cycles * math.log(last / frequency) / (
            last - frequency) if last != frequency else cycles / frequency
        growth = math.log(last / frequency) / inner
        edges = np.cumsum([fades[0], inner, fades[1]])

        def phase(t: Array) -> tuple[Array, Array, Array]:
            """Return the phase, its rate and its growth; the sweep is between the fades."""
            since = np.clip(t - edges[0], 0.0, inner)
            rate = frequency * np.exp(growth * since)
            swept = rate - frequency
            found = np.minimum(t, edges[0]) * frequency + np.maximum(t - edges[1], 0.0) * last + (
                swept / growth if growth else since * frequency)
            return found, rate, np.where((t > edges[0]) & (t < edges[1]), growth * rate, 0.0)

        def course(t: Array) -> tuple[Array, Array, Array]:
            turned, rate, change = phase(t)
            value, slope, curve = self.shape(turned)
            away = self.mean - start + self.amplitude * value
            speed = self.amplitude * slope * rate
            pull = self.amplitude * (curve * rate ** 2 + slope * change)
            rising = t < 0.5 * edges[-1]
            span, sign = np.where(rising, fades[0], fades[1]), np.where(rising, 1.0, -1.0)
            share = np.clip(np.where(rising, t, edges[-1] - t) / span, 0.0, 1.0)
            faded, fading, curved = fade(share)
            fading, curved = sign * fading / span, curved / span ** 2
            return (start + faded * away, fading * away + faded * speed,
                    curved * away + 2.0 * fading * speed + faded * pull)

        ends = np.append(0.0, edges)
        rates = (frequency, max(frequency, last), last)
        breaks = [np.linspace(a, b, 1 + math.ceil(_BREAKS * (b - a) * rate), endpoint=False)
                  for a, b, rate in zip(ends, edges, rates, strict=False)]
        return Path(np.append(np.concatenate(breaks), edges[-1]), course)

    def within(self, request: MoveRequest, frequency: float) -> bool:
        """Return whether the limits of field and slew rate allow the wave at a frequency."""
        material, delivery, limits = request.material, request.delivery, request.limits
        packed = material.packed
        value, slope, curve = self.shape(np.arange(_PHASES) / _PHASES)
        stretch = self.mean + self.amplitude * value
        if not (packed[law.LOWER] < stretch.min() and stretch.max() < packed[law.UPPER]):
            return False
        found = loads_for(
            stretch, self.amplitude * frequency * slope,
            self.amplitude * frequency ** 2 * curve, material)
        if material.creeps:
            # Upper bound: branches that do not relax during a cycle.
            forces = elastic_force(stretch, material)
            found = found + material.branches[:, 0].sum() * (forces - forces.mean())
        step = 1.0 / (_PHASES * frequency)
        if delivery.lag > 0.0:
            found = found + delivery.lag * _growth(found, step)
        return bool(limits.minimum <= found.min() and found.max() <= limits.maximum
                    and np.max(np.abs(_growth(found, step))) <= _SLEW_SHARE * delivery.slew)

    def reach(self, request: MoveRequest) -> list[tuple[float, float]]:
        """Return the frequency bands that limits allow; the first may start at 0."""
        natural = float(law.natural_frequency(self.mean, request.material.packed))
        looked = (_LOOK * natural / (2.0 * math.pi)).tolist()
        held = [self.within(request, x) for x in looked]
        # Above the resonance, the load grows with the square of the frequency.
        while held[-1] and looked[-1] < _MOST * looked[0]:
            looked.append(2.0 * looked[-1])
            held.append(self.within(request, looked[-1]))
        # At the lowest of these frequencies the motion is static to a millionth.
        edges = [0.0] if held[0] else []
        edges += [self._edge(request, looked[i], looked[i + 1])
                  for i in range(len(held) - 1) if held[i] != held[i + 1]]
        edges += [math.inf] if held[-1] else []
        return list(zip(edges[::2], edges[1::2], strict=True))

    def _edge(self, request: MoveRequest, low: float, high: float) -> float:
        """Return the frequency between two at which limits begin or cease to allow the wave."""
        allowed = self.within(request, low)
        while high - low > _EDGE * high:
            middle = math.sqrt(low * high)
            if self.within(request, middle) is allowed:
                low = middle
            else:
                high = middle
        return low if allowed else high


def _growth(values: Array, step: float) -> Array:
    """Return the time derivative of periodic values."""
    found: Array = (np.roll(values, -1) - np.roll(values, 1)) / (2.0 * step)
    return found
