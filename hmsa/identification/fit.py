"""
Maximum likelihood by Levenberg-Marquardt, robust against outliers.

Residuals have full weight up to three standard deviations, then a decreasing one, and none
beyond six (Hampel, "Robust Statistics", Wiley 1986, sec. 2.6). The standard deviation is estimated
from the residuals themselves. Under normal noise that costs 0.1 % of the accuracy.

For white residuals the covariance is the inverse information. Correlated ones (a filter in the
camera, quantisation, drift) contain less information than their number suggests: the covariance is
widened by the larger of two sandwich estimates, with the autocorrelation of the residuals and with
that of the scores (Newey and West, Econometrica 55 (1987) 703).

The search is not `scipy.optimize.least_squares`: with this Jacobian and loss, its method ``trf``
finds the same minima in 11 simulations instead of 6, so that the identification of nine parameters
from 2 s at 1 kHz, before modes are tried in their place, takes 47 ms of a core instead of 30, and
that of five 25 instead of 20.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.identification import quantities
from hmsa.identification.measurement import Measurement
from hmsa.identification.response import respond, Response
from hmsa.model.equations import Array

_FULL, _NONE = 3.0, 6.0
_MAX_PASSES = 60
# Step, in standard deviations, below which the search has converged.
_SMALL = 1e-2
_MAX_DAMPING = 1e10
_MOST_DERIVATIVE = 1e100
# Maximum change of a logarithmic coordinate in one step.
_STRIDE = 0.7
# RMS error of the simulation, which makes it a non-smooth function of the parameters.
_NUMERICAL = 1e-8
#: Minimum standard deviation: a few errors of the simulation.
LEAST_SCALE = 3.0 * _NUMERICAL
# Probability below which residuals are not white.
_WHITE = 1e-3
_LAGS = 20
# Window length in correlation times (A. Sokal, "Monte Carlo methods in statistical
# mechanics", 1997).
_WINDOW = 6.0
#: Half a 95 % interval of normal noise, in standard deviations.
HALF_95 = 1.96
# Ratios of the standard deviation at the fastest motion to that at rest to try.
_LARGEST_SPREADS = np.geomspace(0.5, 200.0, 13)


@dataclass(frozen=True, eq=False)
class Fit:
    """A local minimum."""

    recording: Measurement
    free: tuple[str, ...]  # columns of the Jacobian
    response: Response
    residual: Array  # measured minus simulated stretch, shape (n,)
    weights: Array  # weight of each sample, 0 to 1
    scale: float  # robust standard deviation of the residuals
    converged: bool  # whether the last step was small relative to the standard deviations
    passes: int  # number of simulations
    spread: Array  # standard deviation of each sample relative to that of one at rest
    # Prior information on each uncertain switch, for unit noise.
    prior: float = 0.0

    @property
    def values(self) -> dict[str, Any]:
        """Values of all quantities, and the hyperelastic model."""
        return self.response.values

    @cached_property
    def root(self) -> Array:
        """Square root of the weights of residuals and derivatives."""
        found: Array = np.sqrt(self.weights) / self.spread
        return found

    @cached_property
    def jacobian(self) -> Array:
        """Derivatives by the coordinates, after removal of uncertain switches; (n, p)."""
        jacobian, extra = self.response.jacobian, self.response.by_switch
        weighted = self.root[:, None] ** 2 * extra
        matrix = extra.T @ weighted + self.prior * np.eye(extra.shape[1])
        found: Array = jacobian - extra @ np.linalg.solve(matrix, weighted.T @ jacobian)
        return found

    @cached_property
    def information(self) -> Array:
        """Information matrix by the coordinates, for unit noise; shape (p, p)."""
        matrix: Array = self.response.jacobian.T @ (self.root[:, None] ** 2 * self.jacobian)
        return 0.5 * (matrix + matrix.T)


def robust_scale(residual: Array, fitted: int = 0) -> float:
    """
    Return the standard deviation of residuals that may include outliers.

    As many residuals as there are fitted parameters may be zero for any noise; they do not count.
    """
    last = len(residual) - 1
    rest = max(last - fitted, 0)
    places = [last - rest + int(x * rest) for x in (0.6827, 0.9545)]
    size = np.partition(np.abs(residual), places)
    return max(float(size[places[0]]), 0.5 * float(size[places[1]]), LEAST_SCALE)


def weights_of(residual: Array, scale: float, *, convex: bool = False) -> Array:
    """Return the weight of each residual; convex: by Huber, so that none is left out."""
    u = np.abs(residual) / scale
    if convex:
        all_count: Array = _FULL / np.maximum(u, _FULL)
        return all_count
    weights: Array = np.where(
        u <= _FULL, 1.0, np.clip((_NONE - u) / (_NONE - _FULL), 0.0, 1.0)
        * _FULL / np.maximum(u, _FULL))
    return weights


def loss(residual: Array, scale: float, *, convex: bool = False) -> float:
    """Return Hampel's loss, bounded for each residual, or Huber's convex one."""
    u = np.abs(residual) / scale
    inner = np.minimum(u, _FULL)
    if convex:
        return float(np.sum(0.5 * inner ** 2 + _FULL * (u - inner)))
    middle = np.clip(u, _FULL, _NONE) - _FULL
    width = _NONE - _FULL
    loss = 0.5 * inner ** 2 + _FULL * (middle - 0.5 * middle ** 2 / width)
    return float(np.sum(loss))


def moved(values: Mapping[str, Any], free: Sequence[str], step: Array) -> dict[str, Any]:
    """Return values after a step of the coordinates, clipped to their ranges."""
    return quantities.values_at(values, free, quantities.coordinates(values, free) + step)


def fit(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str], *,
        most: int = _MAX_PASSES, spread: Array | None = None) -> Fit | None:
    """
    Search for a minimum from start values of all quantities; None if they cannot be simulated.

    ``spread`` is the standard deviation of each sample relative to one at rest; default 1.
    """
    return _Search(recording, tuple(free), most, np.ones(
        len(recording.time)) if spread is None else spread).run(values)


@dataclass(eq=False)
class _Search:
    """A search in parameters and uncertain switches."""

    _recording: Measurement
    _free: tuple[str, ...]
    _most: int
    _spread: Array
    _passes: int = 0
    _convex: bool = True  # whether all samples are used

    @property
    def _middle(self) -> float:
        return -0.5 * self._recording.earlier

    def _respond(self, values: Mapping[str, float], shifts: Array) -> Response | None:
        self._passes += 1
        response = respond(self._recording, values, self._free, shifts=shifts)
        # Such sensitivity cannot be measured.
        return response if response is not None and np.max(
            np.abs(response.jacobian), initial=0.0) < _MOST_DERIVATIVE else None

    def _residual(self, response: Response) -> Array:
        return (self._recording.stretch - response.stretch) / self._spread

    def _prior(self, scale: float) -> float:
        # The prior of a switch is uniform in its interval; use its variance.
        deviation = self._recording.earlier / math.sqrt(12.0)
        return (scale / deviation) ** 2 if deviation else 0.0

    def _loss(self, residual: Array, shifts: Array, scale: float) -> float:
        apart = float(np.sum((shifts - self._middle) ** 2))
        return (loss(residual, scale, convex=self._convex)
                + 0.5 * self._prior(scale) * apart / scale ** 2)

    def run(self, values: Mapping[str, float]) -> Fit | None:
        """Search from start values."""
        shifts: Array = np.full(len(self._recording.uncertain), self._middle)
        response = self._respond(values, shifts)
        if response is None:
            return None
        residual = self._residual(response)
        count = len(self._free)
        scale = robust_scale(residual, count)
        damping = 1e-4
        # First use all samples, so that the few in motion are not taken for outliers.
        for self._convex in (True, False):
            converged = False
            while not converged and self._passes < self._most:
                weights = weights_of(residual, scale, convex=self._convex)
                matrix, gradient, size = self._normal(response, residual, weights, shifts, scale)
                if _at_bottom(matrix, gradient / size, len(residual), scale):
                    converged = True
                    break
                before = self._loss(residual, shifts, scale)
                allowed = before + _SMALL ** 2 + _NUMERICAL * float(
                    np.linalg.norm(weights * residual)) / scale ** 2
                while self._passes < self._most:
                    scaled: Array = np.asarray(np.linalg.solve(
                        matrix + damping * np.eye(len(size)), gradient / size), dtype=np.float64)
                    step = scaled / size
                    stride = _stride(response.values, self._free, step[:count])
                    step = step * stride
                    trial_shifts = np.clip(shifts + step[count:], -self._recording.earlier, 0.0)
                    trial = self._respond(
                        moved(response.values, self._free, step[:count]), trial_shifts)
                    if trial is not None:
                        trial_residual = self._residual(trial)
                        after = self._loss(trial_residual, trial_shifts, scale)
                        if after <= allowed:
                            break
                    damping = max(10.0 * damping, 1e-6)
                    if damping > _MAX_DAMPING:
                        break
                else:
                    break
                if trial is None or damping > _MAX_DAMPING:
                    damping = 1e-4
                    break
                # Switches at the end of their intervals do not converge: the loss does.
                converged = damping <= 1.0 and stride == 1.0 and (
                    float(scaled @ matrix @ scaled) <= (_SMALL * scale) ** 2
                    or before - after < _SMALL ** 2)
                shifts, response, residual = trial_shifts, trial, trial_residual
                if converged and not self._convex:
                    break
                now = robust_scale(residual, count)
                if self._convex and not converged or scale >= 2.0 * now:
                    # Fixed once samples may be left out (Yohai, Ann. Statist. 15 (1987) 642), and
                    # never increasing, so that the search ends.
                    scale = min(scale, now)
                damping = max(0.1 * damping, 1e-12)
        return Fit(
            self._recording, self._free, response, residual * self._spread,
            weights_of(residual, scale), scale, converged, self._passes, self._spread,
            self._prior(scale))

    def _normal(
            self, response: Response, residual: Array, weights: Array, shifts: Array,
            scale: float) -> tuple[Array, Array, Array]:
        """Return the normal equations, scaled to a unit diagonal, and the scales."""
        jacobian = response.jacobian
        if len(shifts):
            jacobian = np.hstack([jacobian, response.by_switch])
        jacobian = jacobian / self._spread[:, None]
        matrix = jacobian.T @ (weights[:, None] * jacobian)
        gradient = jacobian.T @ (weights * residual)
        prior, first = self._prior(scale), len(self._free)
        matrix[first:, first:] += prior * np.eye(len(shifts))
        gradient[first:] -= prior * (shifts - self._middle)
        # A switch at the end of its interval that would leave it stays there (active set).
        held = np.flatnonzero((shifts >= 0.0) & (gradient[first:] > 0.0) | (
            shifts <= -self._recording.earlier) & (gradient[first:] < 0.0)) + first
        gradient[held] = 0.0
        matrix[held] = matrix[:, held] = 0.0
        matrix[held, held] = 1.0
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
        return matrix / np.outer(size, size), gradient, size


def _stride(values: Mapping[str, float], free: Sequence[str], step: Array) -> float:
    """Return the largest fraction of a step that keeps its changes within their limits."""
    share = 1.0
    for name, change in zip(free, step.tolist(), strict=True):
        quantity, limit = quantities.quantity_of(name), _STRIDE
        if quantity.scale == 'inverse':
            limit = max(0.5 / values[name], 0.02)
        elif name == 'damping_coefficient':
            limit = max(2.0 * values[name], 1e-6)
        elif quantity.unit == 'Pa' and quantity.scale == 'linear':
            limit = 0.5 * _STRIDE * values['shear_modulus']
        elif quantity.scale == 'linear' and name != 'initial_stretch' and (
                name in quantities.QUANTITIES):
            continue
        if abs(change) > limit:
            share = min(share, limit / abs(change))
    return share


def _at_bottom(matrix: Array, gradient: Array, count: int, scale: float) -> bool:
    """Return whether the next full step is small in standard deviations or numerical errors."""
    step = np.linalg.solve(matrix + 1e-12 * np.eye(len(gradient)), gradient)
    return float(gradient @ step) <= (_SMALL * scale) ** 2 + count * _NUMERICAL ** 2


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Correlation of the residuals."""

    autocorrelation: Array  # from lag 0 on, over samples
    p_value: float  # of this or more in white noise (Ljung and Box, Biometrika 65 (1978) 297)
    window: int  # number of significant lags; 0 if the residuals are white

    @property
    def white(self) -> bool:
        """Whether the residuals may be white."""
        return self.window == 0

    @property
    def taper(self) -> Array:
        """Weights of the significant lags."""
        return 1.0 - np.arange(self.window + 1) / (self.window + 1.0)


def autocorrelation(values: Array) -> Array:
    """Return the biased autocorrelation of values by lag, from 1 on; shape (n,)."""
    found = _products(values)
    return found / found[0] if found[0] > 0.0 else np.append(1.0, np.zeros(len(values) - 1))


def _products(columns: Array) -> Array:
    """Return the sums of products of each column with itself, by lag."""
    n = len(columns)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(columns, size, axis=0)) ** 2
    found: Array = np.fft.irfft(spectrum, size, axis=0)[:n]
    return found


def whiteness(residual: Array) -> Whiteness:
    """Test weighted residuals for correlation."""
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import chdtrc

    n = len(residual)
    rho = autocorrelation(residual)
    lags = max(1, min(_LAGS, n // 5))
    k = np.arange(1, lags + 1)
    q = n * (n + 2.0) * float(np.sum(rho[1:lags + 1] ** 2 / (n - k)))
    # Parameters of a motion, unlike those of a noise filter, cost no degrees of freedom.
    p_value = float(chdtrc(lags, q))
    if p_value > _WHITE:
        return Whiteness(rho, p_value, 0)
    times = np.cumsum(np.append(0.5, rho[1:n // 4]))
    long = np.flatnonzero(np.arange(len(times)) > _WINDOW * np.maximum(times, 0.5))
    return Whiteness(rho, p_value, int(long[0]) if len(long) else max(n // 4, 1))


def errors_of_stamps(jacobian: Array, residual: Array, rate: Array) -> tuple[Array, Array]:
    """
    Estimate the timestamp errors, which add noise in proportion to the rate.

    Noise at rest and timestamp errors have a variance each. The restricted likelihood of a linear
    model (H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545) gives the probability of each
    ratio of the two; a priori, exact timestamps are as likely as all errors together.

    Return the standard deviation of each sample relative to one at rest, all 1 if exact timestamps
    are more likely, and the variance of the coordinates due to the uncertainty of the ratio.
    """
    fastest = float(np.max(np.abs(rate), initial=0.0))
    largest = np.append(0.0, _LARGEST_SPREADS if fastest > 0.0 else [])
    spreads = np.sqrt(1.0 + np.square(np.outer(largest, rate / max(fastest, 1e-300))))
    # Use the outliers of the most likely ratio for all, so that they can be compared.
    scaled = residual / min(spreads, key=lambda x: _surprise(residual, x))
    weights = weights_of(scaled, robust_scale(scaled))
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-100)
    count = jacobian.shape[1]
    freedom = max(float(np.sum(weights)) - count, 1.0)
    both = np.column_stack([jacobian / size, residual])
    products = np.array([both.T @ ((weights / x ** 2)[:, None] * both) for x in spreads])
    matrix, cross = products[:, :count, :count], products[:, :count, count]
    trace = np.trace(matrix, axis1=1, axis2=2)
    matrix = matrix + 1e-13 * trace[:, None, None] * np.eye(count)
    inverse = np.linalg.inv(matrix)
    shift = np.einsum('kij,kj->ki', inverse, cross)
    rest = np.maximum(
        products[:, count, count] - np.sum(cross * shift, axis=1), freedom * LEAST_SCALE ** 2)
    likely = -np.log(spreads) @ weights - 0.5 * (
        np.linalg.slogdet(matrix)[1] + freedom * np.log(rest))
    variances = (rest[:, None] / freedom * np.diagonal(
        inverse, axis1=1, axis2=2) + shift ** 2) / size ** 2
    share = np.exp(likely - np.max(likely))
    share[1:] /= max(len(share) - 1, 1)
    share /= np.sum(share)
    place = 0 if share[0] >= 0.5 else 1 + int(np.argmax(share[1:]))
    return spreads[place], share @ variances


def _surprise(residual: Array, spread: Array) -> float:
    """Return the negative log likelihood, with bounded outliers."""
    scaled = residual / spread
    scale = robust_scale(scaled)
    return len(scaled) * math.log(scale) + float(np.sum(np.log(spread))) + loss(scaled, scale)


def widening(jacobian: Array, residual: Array, inverse: Array, found: Whiteness) -> Array:
    """
    Return the factors, at least 1, by which correlation widens standard deviations, shape (p,).

    Jacobian and residual are weighted; the inverse is that of the information for unit noise.
    """
    count = jacobian.shape[1]
    if found.white:
        return np.ones(count)
    variance = float(residual @ residual) / max(len(residual) - count, 1)
    projected = jacobian @ inverse
    plain = variance * np.sum(projected ** 2, axis=0)
    by_noise, by_score = (
        _sum_of_lags(x, weights) for x, weights in (
            (projected, variance * found.autocorrelation[:found.window + 1] * found.taper),
            (projected * residual[:, None], found.taper)))
    largest = np.maximum(np.maximum(by_noise, by_score), plain)
    factors: Array = np.sqrt(largest / np.maximum(plain, 1e-300))
    return factors


def clustered(
        jacobian: Array, residual: Array, inverse: Array, clusters: NDArray[np.int64]) -> Array:
    """
    Return the factors, at least 1, by which errors of the model widen deviations, shape (p,).

    Such errors are the same after equal changes of level. Each of these ``clusters``, an integer a
    sample, is one draw of them: the covariance is that of their scores (K.-Y. Liang and S. L.
    Zeger, Biometrika 73 (1986) 13), with Student's t for their number.
    """
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import stdtrit

    count = int(np.max(clusters, initial=0)) + 1
    if count < 2:
        return np.ones(jacobian.shape[1])
    scores = np.zeros((count, jacobian.shape[1]))
    np.add.at(scores, clusters, (jacobian @ inverse) * residual[:, None])
    variance = float(residual @ residual) / max(len(residual) - jacobian.shape[1], 1)
    wider = float(stdtrit(count - 1.0, 0.975)) / HALF_95
    factors: Array = wider * np.sqrt(
        count / (count - 1.0) * np.sum(scores ** 2, axis=0) / np.maximum(
            variance * np.diag(inverse), 1e-300))
    return np.maximum(factors, 1.0)


def _sum_of_lags(columns: Array, weights: Array) -> Array:
    """Return the sum over all lags of the weighted products of each column with itself."""
    total: Array = np.append(weights[0], 2.0 * weights[1:]) @ _products(columns)[:len(weights)]
    return total


def inflation(column: Array, found: Whiteness) -> float:
    """Return the factor on the standard deviation of the projection of residuals on a column."""
    if found.white:
        return 1.0
    norm = float(column @ column)
    total = float(_sum_of_lags(
        column[:, None], found.autocorrelation[:found.window + 1] * found.taper)[0])
    return math.sqrt(max(total / norm, 1.0)) if norm > 0.0 else 1.0
