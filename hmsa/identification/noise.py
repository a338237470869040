"""
Properties of the noise from the residuals, and their effect on the covariance.

For white residuals the covariance is the inverse information. Correlated ones (a filter in the
camera, quantisation, drift) contain less information than their number suggests: the covariance is
widened by the larger of two sandwich estimates, with the autocorrelation of the residuals and with
that of the scores (Newey and West, Econometrica 55 (1987) 703).
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.identification.fit import LEAST_SCALE, loss, robust_scale, weights_of
from hmsa.model.equations import Array

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
