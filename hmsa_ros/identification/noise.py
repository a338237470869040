"""
What the residuals say of the noise, and what it makes of the covariance.

White residuals leave the inverse of the information. Correlated ones (a filter in the camera,
quantisation, drift) hold less information than their number says: the covariance is widened by
two sandwiches, one with the autocorrelation of the residuals and one with that of the scores
(Newey and West, Econometrica 55 (1987) 703), whichever is larger.
"""

from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.core.model import Array
from hmsa_ros.identification.fit import loss, robust_scale

# Below this probability residuals are not white.
_WHITE = 1e-3
_LAGS = 20
# A window of this many correlation times (A. Sokal, "Monte Carlo methods in statistical
# mechanics", 1997).
_WINDOW = 6.0
# Deviation at the fastest motion over that at rest, as tried, and the gain of the logarithm of the
# likelihood that speaks for one.
_LARGEST_SPREADS, _MUCH_LIKELIER = np.geomspace(0.5, 200.0, 13).tolist(), 4.0


@dataclass(frozen=True, eq=False)
class Whiteness:
    """
    How the residuals hang together.

    Attributes
    ----------
    autocorrelation : ndarray, shape (k,)
        From lag 0 on, over samples.
    p_value : float
        Probability of as much correlation in white residuals (Ljung and Box, Biometrika 65
        (1978) 297).
    window : int
        Lags that matter; 0 where the residuals are white.

    """

    autocorrelation: Array
    p_value: float
    window: int

    @property
    def white(self) -> bool:
        """Whether they may be white."""
        return self.window == 0


def autocorrelation(values: Array) -> Array:
    """Return the autocorrelation of values over their lags, biased, from 1 on; shape (n,)."""
    n = len(values)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    found: Array = np.fft.irfft(np.abs(spectrum) ** 2, size)[:n]
    return found / found[0] if found[0] > 0.0 else np.append(1.0, np.zeros(n - 1))


def whiteness(residual: Array, free: int) -> Whiteness:
    """
    Test residuals for correlation.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Weighted.
    free : int
        Number of parameters that were fitted.

    Returns
    -------
    Whiteness
        With the lags that matter.

    """
    # Slow to load, and no use to a planner that estimates.
    from scipy.special import chdtrc

    n = len(residual)
    rho = autocorrelation(residual)
    lags = max(1, min(_LAGS, n // 5))
    k = np.arange(1, lags + 1)
    q = n * (n + 2.0) * float(np.sum(rho[1:lags + 1] ** 2 / (n - k)))
    p_value = float(chdtrc(max(lags - min(free, lags // 2), 1), q))
    if p_value > _WHITE:
        return Whiteness(rho, p_value, 0)
    window, time = n // 4, 0.5
    for lag in range(1, n // 4):
        time += float(rho[lag])
        if lag > _WINDOW * max(time, 0.5):
            window = lag
            break
    return Whiteness(rho, p_value, max(window, 1))


def spread_in_motion(residual: Array, rate: Array) -> Array:
    """
    Return the deviation of each sample over that of one at rest.

    Errors of the stamps add to the noise in proportion to the rate. Their size is the likeliest of
    several, and none unless that is much likelier.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Of a fit, few of them outliers.
    rate : ndarray, shape (n,)
        Of the stretch.

    Returns
    -------
    ndarray, shape (n,)
        All 1 where nothing speaks for errors of the stamps.

    """
    fastest = float(np.max(np.abs(rate), initial=0.0))
    none: Array = np.ones(len(residual))
    if fastest == 0.0:
        return none
    best, found = -_MUCH_LIKELIER, none
    reference = _surprise(residual, none)
    for largest in _LARGEST_SPREADS:
        spread: Array = np.sqrt(1.0 + (largest * rate / fastest) ** 2)
        gain = _surprise(residual, spread) - reference
        if gain < best:
            best, found = gain, spread
    return found


def _surprise(residual: Array, spread: Array) -> float:
    """Return the negative logarithm of the likelihood, outliers bounded."""
    scaled = residual / spread
    scale = robust_scale(scaled)
    return len(scaled) * math.log(scale) + float(np.sum(np.log(spread))) + loss(scaled, scale)


def widening(jacobian: Array, residual: Array, inverse: Array, found: Whiteness) -> Array:
    """
    Return by how much correlation widens the deviations.

    Parameters
    ----------
    jacobian : ndarray, shape (n, p)
        Weighted.
    residual : ndarray, shape (n,)
        Weighted.
    inverse : ndarray, shape (p, p)
        Inverse of the information for a noise of 1.
    found : Whiteness
        Of the residuals.

    Returns
    -------
    ndarray, shape (p,)
        Factors of at least 1.

    """
    count = jacobian.shape[1]
    if found.white:
        return np.ones(count)
    variance = float(residual @ residual) / max(len(residual) - count, 1)
    taper = 1.0 - np.arange(found.window + 1) / (found.window + 1.0)
    projected = jacobian @ inverse
    plain = variance * np.sum(projected ** 2, axis=0)
    by_noise, by_score = (
        _sum_of_lags(x, weights) for x, weights in (
            (projected, variance * found.autocorrelation[:found.window + 1] * taper),
            (projected * residual[:, None], taper)))
    largest = np.maximum(np.maximum(by_noise, by_score), plain)
    factors: Array = np.sqrt(largest / np.maximum(plain, 1e-300))
    return factors


def _sum_of_lags(columns: Array, weights: Array) -> Array:
    """Return the sum over all lags of the weighted products of each column with itself."""
    n = len(columns)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(columns, size, axis=0)) ** 2
    products = np.fft.irfft(spectrum, size, axis=0)[:len(weights)]
    weights = np.append(weights[0], 2.0 * weights[1:])
    total: Array = weights @ products
    return total


def inflation(column: Array, found: Whiteness) -> float:
    """Return the factor on the deviation of a projection of the residuals on a column."""
    if found.white:
        return 1.0
    taper = 1.0 - np.arange(found.window + 1) / (found.window + 1.0)
    norm = float(column @ column)
    total = float(_sum_of_lags(
        column[:, None], found.autocorrelation[:found.window + 1] * taper)[0])
    return math.sqrt(max(total / norm, 1.0)) if norm > 0.0 else 1.0
