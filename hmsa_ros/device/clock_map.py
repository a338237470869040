"""
Mapping between the clocks of a device and its host, from round-trip queries.

The shorter a round trip, the more precise the comparison: the device answered at some time between
both host times. Rate and offset are determined by regression, as in Klipper's ``clocksync``. A
prior for the rate keeps the first seconds from following the noise of single answers.
"""

from collections import deque
import math
from typing import NamedTuple

import numpy as np

from hmsa.model.units import NANOSECONDS

# Number of answers stored, and number of initial queries.
_KEPT, ENOUGH = 64, 8
# Standard deviation of the rate of an unknown clock: 100 ppm.
_RATE_STD = 1e-4
# Answers that took longer than this multiple of the shortest are ignored; half durations below the
# second value, in ns, count alike, since a call after a pause takes the host that long.
_SLOW, _LEAST = 3.0, 20_000
# Number of successive answers inconsistent with the known clock until a new one is assumed.
_STRANGE = 3


class _Comparison(NamedTuple):
    """Host and device times, and half the duration of a query, in ns since the first answer."""

    host: int
    device: int
    half: int


class ClockMap:
    """
    Conversion between times of a host and of a device whose clock differs in epoch and rate.

    ``drift`` is the rate of the device's clock relative to the host's, minus 1.
    """

    def __init__(self) -> None:
        self._answers: deque[_Comparison] = deque(maxlen=_KEPT)
        self._origin = 0, 0
        self._strange = 0
        # Device time minus host time is offset + drift (host - centre), with times in ns.
        self._centre = self._offset = self.drift = 0.0
        self._offset_std = self._rate_std = math.inf

    def add(self, before: int, device: int, after: int) -> bool:
        """
        Add one comparison of the two clocks.

        Parameters
        ----------
        before, after : int
            Host times in ns before the query and after the answer.
        device : int
            Device time in the answer, in ns.

        Returns
        -------
        bool
            Whether it is still the same clock; False if it restarted, as after a reboot.

        """
        if not self._answers:
            self._origin = before, device
        host, clock = self._origin
        answer = _Comparison(
            (before + after) // 2 - host, device - clock, max((after - before) // 2, _LEAST))
        off = answer.device - answer.host - self._offset - self.drift * (
            answer.host - self._centre)
        if len(self._answers) >= ENOUGH and abs(off) > answer.half + self._error(answer.host):
            self._strange += 1
            return self._strange < _STRANGE
        self._strange = 0
        self._answers.append(answer)
        self._fit()
        return True

    def _error(self, host: float) -> float:
        """Return a bound of the error, two standard deviations, at a time since the origin."""
        return 2.0 * math.hypot(self._offset_std, self._rate_std * (host - self._centre))

    def _fit(self) -> None:
        """Fit rate and offset, with each answer weighted by its duration."""
        shortest = min(x.half for x in self._answers)
        used = np.array([x for x in self._answers if x.half <= _SLOW * shortest], dtype=float)
        host, device, half = used.T
        # The device time is uniformly distributed between the two host times.
        weights = 3.0 / half**2
        self._centre = float(np.average(host, weights=weights))
        # Delays of one line are correlated: averaging does not reduce their mean.
        self._offset_std = shortest / math.sqrt(3.0)
        since, apart = host - self._centre, device - host
        precision = float(weights @ since**2) + _RATE_STD**-2
        self.drift = float(weights @ (since * (apart - np.average(
            apart, weights=weights)))) / precision
        self._rate_std = precision**-0.5
        self._offset = float(np.average(apart, weights=weights))

    @property
    def error(self) -> float:
        """Bound of the error in s at the newest answer; infinite before the first one."""
        if not self._answers:
            return math.inf
        return self._error(self._answers[-1].host) / NANOSECONDS

    def host_set(self, by: int) -> None:
        """Shift host times by the ns that the host's clock was set ahead."""
        host, device = self._origin
        self._origin = host + by, device

    def to_device(self, host: int) -> int:
        """Return the device time in ns for a host time."""
        begin, clock = self._origin
        since = host - begin
        return clock + since + round(self._offset + self.drift * (since - self._centre))

    def to_host(self, device: int) -> int:
        """Return the host time in ns for a device time."""
        begin, clock = self._origin
        since = device - clock
        apart = (self._offset + self.drift * (since - self._centre)) / (1.0 + self.drift)
        return begin + since - round(apart)
