"""Samples of the state of several actuators, with bias, gain, noise and transport delay."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from hmsa.errors import check_number
from hmsa.model.equations import Array

T = TypeVar('T')


class Sample(NamedTuple):
    """Sample of all joints: time in ns, stretch, rate in 1/s and flux density in T."""

    time: int
    stretch: Array
    rate: Array
    flux_density: Array


class Delay(Generic[T]):
    """
    Items in transit with a constant delay in ns.

    Raises
    ------
    BadInputError
        If the delay is negative.

    """

    def __init__(self, delay: int) -> None:
        check_number('delay', delay, 'ns', least=0)
        self.delay = delay
        self._moving: deque[tuple[int, T]] = deque()

    def put(self, now: int, thing: T) -> None:
        """Send an item at a time in ns, not before the previous one."""
        self._moving.append((now + self.delay, thing))

    def arrived(self, now: int) -> Iterator[tuple[int, T]]:
        """Yield arrival time and item for each item that has arrived by a time in ns."""
        while self._moving and self._moving[0][0] <= now:
            yield self._moving.popleft()

    def shift(self, span: int) -> None:
        """Shift the times of arrival by some ns."""
        self._moving = deque((time + span, item) for time, item in self._moving)

    def clear(self) -> None:
        """Discard the items in transit."""
        self._moving.clear()


@dataclass(frozen=True)
class SensorErrors:
    """
    Errors of the samples of one actuator.

    The measured stretch is the bias plus the gain times the true stretch. The measured rate, its
    derivative, is only affected by the gain.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    #: standard deviations, the latter in 1/s; at least 0
    stretch_noise: float = 0.0
    rate_noise: float = 0.0
    #: finite, the gain above 0
    stretch_bias: float = 0.0
    stretch_gain: float = 1.0

    def __post_init__(self) -> None:
        for name in ('stretch_noise', 'rate_noise'):
            check_number(name, getattr(self, name), least=0.0)
        check_number('stretch_bias', self.stretch_bias)
        check_number('stretch_gain', self.stretch_gain, above=0.0)


class Sensor:
    """Take samples with errors from a seeded generator, delayed by some ns."""

    def __init__(
            self, errors: Sequence[SensorErrors], delay: int = 0, seed: int = 0) -> None:
        self._deviations = np.array(
            [[x.stretch_noise for x in errors], [x.rate_noise for x in errors]])
        self._bias = np.array([x.stretch_bias for x in errors])
        self._gain = np.array([x.stretch_gain for x in errors])
        self._exact = all(x == SensorErrors() for x in errors)
        self._noisy = bool(np.any(self._deviations))
        self._random = np.random.default_rng(seed)
        self._transport: Delay[Sample] = Delay(delay)

    def forget(self) -> None:
        """Discard the samples in transit."""
        self._transport.clear()

    def shift(self, span: int) -> None:
        """Shift the times at which the samples in transit arrive by some ns."""
        self._transport.shift(span)

    def measure(self, sample: Sample) -> Iterator[Sample]:
        """Add a sample of the true state; yield the measured samples that have arrived by now."""
        if not self._exact:
            stretch = self._bias + self._gain * sample.stretch
            rate = self._gain * sample.rate
            if self._noisy:
                errors = self._deviations * self._random.standard_normal(
                    self._deviations.shape)
                stretch, rate = stretch + errors[0], rate + errors[1]
            sample = sample._replace(stretch=stretch, rate=rate)
        self._transport.put(sample.time, sample)
        for _, measured in self._transport.arrived(sample.time):
            yield measured
