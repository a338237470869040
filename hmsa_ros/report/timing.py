"""When commands and samples of a run came."""

from dataclasses import dataclass
import math

import numpy as np

from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.recordings.levels import lateness_of, Level, without_repeats
from hmsa_ros.recordings.record import Run, Times

# A change of level that took effect within so many s of its stamp was in time.
_PUNCTUAL = 1e-6
# Clocks further apart than this are different clocks.
_SAME_CLOCK = 60.0


@dataclass(frozen=True)
class Timing:
    """When commands and samples came; all arrays are in s."""

    commands: tuple[Level, ...]  #: those that change something, in the order received
    repeats: int  #: how many commands changed nothing
    #: Shape (m,): how far ahead of its stamp each command was recorded; below 0 for a late one.
    #: Empty if the recorder kept another clock than the stamps.
    lead: Array
    #: Shape (k,): how long after its stamp each change of level took effect, as the plant or the
    #: driver reported; NaN for one that it did not report. Empty if it reported none.
    lateness: Array
    delay: Array  #: shape (n,): how long after its stamp each sample was recorded; or empty
    interval: Array  #: shape (n - 1,): between the stamps of two samples
    arrival_interval: Array  #: shape (n - 1,): between the times of recording
    missing: int  #: samples that gaps in the stamps have room for
    unapplied: int  #: changes of level that were due and did not take effect as reported

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
