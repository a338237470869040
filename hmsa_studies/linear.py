"""
Linear controllers of a block in their usual form, for small motion at each target.

The block is linearised about the target and discretised exactly, including delayed levels. A
stationary Kalman filter estimates stretch and rate. The sensor is zeroed on the block at rest
before the first move.
"""

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
import math

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from hmsa.errors import HmsaError
from hmsa.identification.quantities import complete, values_of
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa_lab.adapt.motion import follow, Levels

# Load increment for the linearisation.
_SMALL = 1e-4
# Horizon of the predictive controller, in time scales.
_HORIZON = 6.0


@dataclass(frozen=True)
class Weights:
    """Weights of a controller, relative to that of the error."""

    rate: float  #: per time scale
    effort: float  #: of the level
    integral: float = 0.0  #: of the integrated error over a time scale, for the regulator only
    wander: float = 0.1  #: of a disturbing load, in a time scale


@dataclass(frozen=True, eq=False)
class Linearised:
    """A block linearised about an equilibrium and discretised: x(k + 1) = a x(k) + b u(k)."""

    #: effect of the state: stretch from the target, rate per time scale, and the delayed levels,
    #: the newest first; shape (n, n)
    a: Array
    b: Array  #: effect of a level, as a load above the holding one, shape (n,)

    @classmethod
    def at(
            cls, block: ActuatorParameters, target: float, holding: float, period: int,
            delay: int) -> 'Linearised':
        """Linearise about a target held by a level in T; delay of levels and period in ns."""
        whole, late = divmod(delay, period)
        by, left = _motion(block, target, holding, period)
        _, before = _motion(block, target, holding, late)
        rest, after = _motion(block, target, holding, period - late)
        n = whole + 3
        a, b = np.zeros((n, n)), np.zeros(n)
        a[:2, :2] = by
        a[:2, n - 1] = rest @ before
        if whole:
            a[:2, n - 2] += after
            b[2] = 1.0
        else:
            b[:2], b[2] = after, 1.0
        a[3:, 2:n - 1] = np.eye(n - 3)
        return cls(a, b)

    def observer(self, noise: float, wander: float) -> Array:
        """Return the stationary Kalman gain for stretch, rate and a disturbing level."""
        n = len(self.b)
        a = np.eye(3)
        a[:2, :2] = self.a[:2, :2]
        a[:2, 2] = self.a[:2, 2:].sum(axis=1) + (self.b[:2] if n == 3 else 0.0)
        c = np.array([1.0, 0.0, 0.0])
        spread = np.diag([1e-12, 1e-12, wander ** 2])
        p: Array = np.asarray(solve_discrete_are(
            a.T, c[:, None], spread, np.array([[noise ** 2]])), dtype=np.float64)
        gain: Array = p @ c / (float(c @ p @ c) + noise ** 2)
        return gain


def _motion(
        block: ActuatorParameters, target: float, holding: float, time: int
) -> tuple[Array, Array]:
    """Return derivatives of stretch and rate after a time in ns by initial state, and by load."""
    unit, load = block.time_unit, block.flux_density_unit
    values = complete(values_of(block), ())
    ends = []
    scale = np.array([1.0, unit])
    for level in (holding - _SMALL * load, holding + _SMALL * load):
        motion = follow(
            values, (), (target, 0.0), Levels(np.zeros(1), np.array([level])), 0.0,
            np.array([time / NANOSECONDS]))
        if motion is None:
            raise HmsaError(
                f'the motion about {block.coordinate.name} {target:g} cannot be simulated: '
                'expected a target away from the limits of the law')
        ends.append((motion, scale * [motion.stretch[0], motion.rate[0]]))
    (one, low), (other, high) = ends
    by = 0.5 * sum(
        np.array([x.by[0], x.rate_by[0]]) for x in (one, other)) * scale[:, None] / scale
    return by, (high - low) / (2.0 * _SMALL)


class Controller(ABC):
    """
    Controller that sets a level after each sample.

    Parameters
    ----------
    block : ActuatorParameters
        Nominal block.
    largest : float
        Maximum magnitude of the load.
    period, delay : int
        Sampling period, and delay from a sample to the level that depends on it, in ns.
    noise : float
        Standard deviation of a sample.
    weights : Weights
        Weights of the controller.

    """

    def __init__(
            self, block: ActuatorParameters, largest: float, period: int, delay: int,
            noise: float, weights: Weights) -> None:
        """Begin at rest without a field."""
        self._weights = weights
        self._block, self._largest, self._noise = block, largest, noise
        self._period, self._delay = period, delay
        self._before: list[float] = []
        self._zero = 0.0
        self._target, self._holding = block.rest, 0.0
        self._model: Linearised | None = None
        self._x = np.zeros(3)
        self._sent: deque[float] = deque()

    @abstractmethod
    def _design(self, model: Linearised) -> None:
        """Design the control law for a target."""

    @abstractmethod
    def _law(self, z: Array, error: float, low: float, high: float) -> float:
        """Return the level above the holding one, as a load, within bounds."""

    def move(self, target: float, holding: float) -> float:
        """Move to a target held by a level in T; return the level until the next sample."""
        unit = self._block.flux_density_unit
        if self._model is None:
            self._zero = float(np.mean(self._before)) - self._block.rest
        model = self._model = Linearised.at(
            self._block, target, holding, self._period, self._delay)
        if not self._sent:
            self._sent = deque([0.0] * (len(model.b) - 2))
        self._gain = model.observer(
            self._noise,
            self._weights.wander * self._period / NANOSECONDS / self._block.time_unit)
        self._x[0] += self._target - target
        self._target, self._holding = target, holding / unit
        self._design(model)
        return self._sent[0] * unit

    def seen(self, stretch: float) -> float | None:
        """Process a sample in order; return a level in T, or None before the first move."""
        if self._model is None:
            self._before.append(stretch)
            return None
        error = stretch - self._zero - self._target
        sent = np.array(self._sent) - self._holding
        self._x = self._x + self._gain * (error - self._x[0])
        load = self._law(
            np.concatenate([self._x[:2], sent]), error,
            -self._largest - self._holding, self._largest - self._holding)
        # Predict the state at the next sample.
        beside = float(self._x[2])
        z = np.concatenate([self._x[:2], sent + beside])
        self._x[:2] = (self._model.a @ z + self._model.b * (load + beside))[:2]
        self._sent.appendleft(load + self._holding)
        self._sent.pop()
        return self._sent[0] * self._block.flux_density_unit


class Quadratic(Controller):
    """A linear quadratic regulator with integral action, which stops while levels are clipped."""

    _sum = 0.0
    _gains: Array = np.ones(1)

    def _design(self, model: Linearised) -> None:
        n = len(model.b)
        share = self._period / NANOSECONDS / self._block.time_unit
        a = np.zeros((n + 1, n + 1))
        a[:n, :n], a[n, 0], a[n, n] = model.a, share, 1.0
        b = np.append(model.b, 0.0)[:, None]
        before, weights = self._gains, self._weights
        self._gains = _regulator(a, b, np.diag(
            [1.0, weights.rate, *[0.0] * (n - 2), weights.integral]), weights.effort)[0]
        # Keep the final level.
        self._sum *= before[-1] / self._gains[-1]
        self._share = share

    def _law(self, z: Array, error: float, low: float, high: float) -> float:
        wanted = -float(self._gains @ np.append(z, self._sum))
        load = min(max(wanted, low), high)
        if load == wanted:
            self._sum += error * self._share
        return load


class Predictive(Controller):
    """
    An offset-free linear model predictive controller, which estimates a disturbing level.

    G. Pannocchia and J. B. Rawlings, AIChE Journal 49 (2003) 426.
    """

    def _design(self, model: Linearised) -> None:
        n = len(model.b)
        steps = max(round(_HORIZON * self._block.time_unit * NANOSECONDS / self._period), 2)
        effort = self._weights.effort
        weight = np.diag([1.0, self._weights.rate, *[0.0] * (n - 2)])
        final = _regulator(model.a, model.b[:, None], weight, effort)[1]
        values, vectors = np.linalg.eigh(final)
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        free = np.eye(n)
        forced: Array = np.zeros((n, steps))
        rows, by = [], []
        for i in range(steps):
            forced = model.a @ forced
            forced[:, i] += model.b
            free = model.a @ free
            last = root if i == steps - 1 else np.sqrt(weight[:2])
            rows.append(last @ forced)
            by.append(last @ free)
        rows.append(math.sqrt(effort) * np.eye(steps))
        by.append(np.zeros((steps, n)))
        self._rows, self._by = np.vstack(rows), np.vstack(by)
        self._inverse = np.linalg.pinv(self._rows)

    def _law(self, z: Array, error: float, low: float, high: float) -> float:
        beside = float(self._x[2])
        right = -self._by @ np.concatenate([z[:2], z[2:] + beside])
        found = self._inverse @ right
        if np.any(found < low + beside) or np.any(found > high + beside):
            found = lsq_linear(
                self._rows, right, (low + beside, high + beside), method='bvls').x
        return min(max(float(found[0]) - beside, low), high)


def _regulator(a: Array, b: Array, weight: Array, effort: float) -> tuple[Array, Array]:
    """Return the gains of the quadratic regulator and its cost matrix."""
    cost: Array = np.asarray(
        solve_discrete_are(a, b, weight, np.array([[effort]])), dtype=np.float64)
    gains = (b.T @ cost @ a) / (effort + float((b.T @ cost @ b)[0, 0]))
    return gains[0], cost
