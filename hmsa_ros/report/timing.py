"""When commands and samples of a run came."""

from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.core.model import Array
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.runs.levels import lateness_of, Level, without_repeats
from hmsa_ros.runs.record import Run, Times

# A change of level that took effect within so many s of its stamp was in time.
_PUNCTUAL = 1e-6
# Clocks further apart than this are different clocks.
_SAME_CLOCK = 60.0


@dataclass(frozen=True)
class Timing:
    """
    When commands and samples came.

    Attributes
    ----------
    commands : tuple of Level
        Those that change something, in the order received.
    repeats : int
        How many commands changed nothing.
    lead : ndarray, shape (m,)
        How far ahead of its stamp each command was recorded, in s; below 0 for a late one.
        Empty if the recorder kept another clock than the stamps.
    lateness : ndarray, shape (k,)
        How long after its stamp each change of level took effect, in s, by what the plant or the
        driver reported; NaN for one that it did not report. Empty if it reported none.
    delay : ndarray, shape (n,)
        How long after its stamp each sample was recorded, in s; empty likewise.
    interval : ndarray, shape (n - 1,)
        Between the stamps of two samples, in s.
    arrival_interval : ndarray, shape (n - 1,)
        Between the times at which they were recorded, in s.
    missing : int
        Samples that gaps in the stamps have room for.
    unapplied : int
        Changes of level that were due and did not take effect as reported.

    """

    commands: tuple[Level, ...]
    repeats: int
    lead: Array
    lateness: Array
    delay: Array
    interval: Array
    arrival_interval: Array
    missing: int
    unapplied: int

    @property
    def late(self) -> int:
        """Commands that took effect, or else were recorded, after the time they apply from."""
        if len(self.lateness):
            return int(np.count_nonzero(self.lateness > _PUNCTUAL))
        return int(np.count_nonzero(self.lead < 0.0))


def timing(run: Run) -> Timing:
    """Return when commands and samples of a run came."""
    commands, repeats = without_repeats(run.commands)
    delay = _seconds(run.logged - run.time)
    interval = _seconds(np.diff(run.time))
    lead = _seconds(np.array([x.stamp - x.sent for x in commands], dtype=np.int64))
    if abs(float(np.median(delay))) > _SAME_CLOCK:
        delay, lead = np.empty(0), np.empty(0)
    recorded: Times = np.sort(run.logged)
    usual = float(np.median(interval)) if len(interval) else math.inf
    gaps = np.rint(interval / usual) - 1.0
    lateness, unapplied = lateness_of(commands, run.applied, int(run.time[-1]))
    return Timing(
        commands, repeats, lead, lateness, delay, interval, _seconds(np.diff(recorded)),
        int(np.sum(gaps[gaps > 0.0])) if len(interval) else 0, unapplied)


def _seconds(nanoseconds: Times) -> Array:
    return np.asarray(nanoseconds / NANOSECONDS, dtype=np.float64)
