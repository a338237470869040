"""A simulated coil, actuator, laser and field probe with realistic delays, for guided runs."""

from collections import deque
import math
from time import time_ns

from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.sensor import SensorErrors
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint

# Sampling period in ns, and number of samples stored for a probe.
_PERIOD, _KEPT = 1_000_000, 100_000
# Fields for `SimulatedProbe`, with their times in ns.
_FIELDS: deque[tuple[float, float, int]] = deque(maxlen=_KEPT)


class SimulatedBench:
    """
    Hardware that applies scheduled levels; times in s.

    Parameters
    ----------
    joint : str
        Joint name.
    transport, lag, latency : float
        Delay and first-order lag of the field, and lateness of the timestamps of samples.
    noise : float
        Standard deviation of a stretch sample.

    """

    def __init__(
            self, joint: str, transport: float = 5e-4, lag: float = 5e-4, latency: float = 2e-3,
            noise: float = 1e-3) -> None:
        self.description = 'simulated'
        self._transport, self._latency = (
            round(x * NANOSECONDS) for x in (transport, latency))
        self._device = SimulatedDevice(
            [SimulatedJoint(
                Setup(paper_actuator(), coil_time_constant=lag),
                errors=SensorErrors(stretch_noise=noise))],
            period=_PERIOD, time=time_ns(), measurement_delay=self._latency)
        _FIELDS.clear()

    def schedule(self, levels: list[tuple[int, float]]) -> None:
        """Schedule levels."""
        for stamp, level in levels:
            self._device.receive(0, stamp + self._transport, level)

    def write(self, level: float, now: int) -> int:
        """Set a level now."""
        self._device.receive(0, now + self._transport, level)
        return now

    def read(self, now: int) -> list[tuple[float, float, int]]:
        """Return the samples that have arrived."""
        self._device.advance(now)
        samples = self._device.samples()
        _FIELDS.extend((float(x.flux_density[0]), math.nan, x.time) for x in samples)
        return [(float(x.stretch[0]), math.nan, x.time + self._latency) for x in samples]


class SimulatedProbe:
    """A probe in the coil of the simulated bench."""

    def read(self) -> list[tuple[float, float, int]]:
        """Return field in T, NaN, and time in ns of each sample since the last call."""
        return [_FIELDS.popleft() for _ in range(len(_FIELDS))]
