"""What is measured of the state of several actuators: noise and transport delay."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hmsa_ros.core.model import Array
from hmsa_ros.errors import BadInputError


class Sample(NamedTuple):
    """Measurement of all actuators: time in ns, stretch, rate in 1/s and flux density in T."""

    time: int
    stretch: Array
    rate: Array
    flux_density: Array


class Sensor:
    """
    Measures with normally distributed errors, and tells later.

    Parameters
    ----------
    stretch_noise, rate_noise : sequence of float
        Standard deviation for each actuator; the latter in 1/s.
    delay : int
        Time in ns between taking a sample and telling it.
    seed : int
        Of the noise: the same seed gives the same errors.

    Raises
    ------
    BadInputError
        If a deviation or the delay is negative.

    """

    def __init__(
            self, stretch_noise: Sequence[float], rate_noise: Sequence[float], delay: int = 0,
            seed: int = 0) -> None:
        """Begin the noise."""
        least = min(*stretch_noise, *rate_noise)
        if not (least >= 0.0 and delay >= 0):
            raise BadInputError(
                f'standard deviation {least:g}, delay {delay} ns: expected none below 0')
        self._deviations = np.array([stretch_noise, rate_noise])
        self._noisy = bool(np.any(self._deviations))
        self._delay = delay
        self._random = np.random.default_rng(seed)
        self._untold: deque[Sample] = deque()

    def forget(self) -> None:
        """Drop what has not been told."""
        self._untold.clear()

    def measure(self, sample: Sample) -> Iterator[Sample]:
        """
        Take a sample of the true state.

        Parameters
        ----------
        sample : Sample
            Later than the one before; its arrays are kept.

        Yields
        ------
        Sample
            Measurements that can be told by now: each sample once, its delay later.

        """
        if self._noisy:
            errors = self._deviations * self._random.standard_normal(self._deviations.shape)
            sample = sample._replace(
                stretch=sample.stretch + errors[0], rate=sample.rate + errors[1])
        if not self._delay:
            yield sample
            return
        self._untold.append(sample)
        while self._untold and self._untold[0].time <= sample.time - self._delay:
            yield self._untold.popleft()
