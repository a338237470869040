"""
The clock of a device against that of its host, from questions that go to and fro.

A question that came back fast says most: its answer was given somewhere between both times. Rate
and offset are a regression over such answers, as Klipper's ``clocksync`` does; the prior of the
rate keeps the first seconds from following the noise of single answers.
"""

from collections import deque
import math
from typing import NamedTuple

import numpy as np

from hmsa_ros.model.units import NANOSECONDS

# Answers that are kept, and how many are asked for at once at the start.
_KEPT, ENOUGH = 64, 8
# Standard deviation of the rate of a clock that nothing is known of: 100 ppm.
_RATE_STD = 1e-4
# Answers that took longer than so many of the shortest say too little.
_SLOW = 3.0
# Answers in a row that cannot be of the clock that is known, before it counts as another one.
_STRANGE = 3


class _Answer(NamedTuple):
    """The clock of the device, and half a question's duration, in ns since the first answer."""

    host: int
    device: int
    half: int


class ClockMap:
    """
    Times of a host, and of a device whose clock has another beginning and rate.

    ``drift`` is the rate of the device's clock against the host's, less 1.
    """

    def __init__(self) -> None:
        self._answers: deque[_Answer] = deque(maxlen=_KEPT)
        self._origin = 0, 0
        self._strange = 0
        # Device time less host time is offset + drift (host - centre), about the centre in ns.
        self._centre = self._offset = self.drift = 0.0
        self._offset_std = self._rate_std = math.inf

    def add(self, before: int, device: int, after: int) -> bool:
        """
        Add one comparison of the two clocks.

        Parameters
        ----------
        before, after : int
            Times of the host in ns before the question and after the answer.
        device : int
            Time of the device in the answer, in ns.

        Returns
        -------
        bool
            Whether it is still the same clock, and not one that began anew, as after a reboot.

        """
        if not self._answers:
            self._origin = before, device
        host, clock = self._origin
        answer = _Answer(
            (before + after) // 2 - host, device - clock, max((after - before) // 2, 1))
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
        """Return a bound of the error at a time since the first answer: two deviations."""
        return 2.0 * math.hypot(self._offset_std, self._rate_std * (host - self._centre))

    def _fit(self) -> None:
        """Fit rate and offset, each answer weighed by its duration."""
        shortest = min(x.half for x in self._answers)
        used = np.array([x for x in self._answers if x.half <= _SLOW * shortest], dtype=float)
        host, device, half = used.T
        # The time of an answer is anywhere between the two of the host.
        weights = 3.0 / half**2
        self._centre = float(np.average(host, weights=weights))
        # The delays of one line are alike: their mean does not shrink with their number.
        self._offset_std = shortest / math.sqrt(3.0)
        since, apart = host - self._centre, device - host
        precision = float(weights @ since**2) + _RATE_STD**-2
        self.drift = float(weights @ (since * (apart - np.average(
            apart, weights=weights)))) / precision
        self._rate_std = precision**-0.5
        self._offset = float(np.average(apart, weights=weights))

    @property
    def error(self) -> float:
        """Bound of the error in s at the newest answer; infinite before the first."""
        if not self._answers:
            return math.inf
        return self._error(self._answers[-1].host) / NANOSECONDS

    def host_set(self, by: int) -> None:
        """Take in that the clock of the host was set ahead by some ns."""
        host, device = self._origin
        self._origin = host + by, device

    def to_device(self, host: int) -> int:
        """Return the time of the device in ns at one of the host."""
        begin, clock = self._origin
        since = host - begin
        return clock + since + round(self._offset + self.drift * (since - self._centre))

    def to_host(self, device: int) -> int:
        """Return the time of the host in ns at one of the device."""
        begin, clock = self._origin
        since = device - clock
        apart = (self._offset + self.drift * (since - self._centre)) / (1.0 + self.drift)
        return begin + since - round(apart)
