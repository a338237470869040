"""Whether a device is well driven: the verdict on its commands, and on how often it is sampled."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

from hmsa_ros.core.model import natural_frequency
from hmsa_ros.core.parameters import ActuatorParameters

_OK, _WARN, _ERROR = 0, 1, 2
# Below, peaks of a vibration lie between samples.
_SAMPLES_A_PERIOD = 10.0


@dataclass(frozen=True)
class CommandHealth:
    """Counts of late, refused and failed commands, and joints nobody or several command."""

    late: int
    refused: int
    refused_source: int
    failed: int
    silent: Sequence[str]
    crowded: Sequence[str]

    def verdict(self) -> tuple[int, str]:
        """Return level (0 OK, 1 WARN, 2 ERROR) and message for /diagnostics."""
        level, notes = _OK, []
        if self.late or self.refused or self.refused_source:
            level = _WARN
            notes.append(
                f'{self.late} commands late, {self.refused + self.refused_source} refused')
        if self.crowded:
            level = _WARN
            notes.append(f'several publishers command {_listed(self.crowded)}')
        if self.failed:
            level = _ERROR
            notes.append(
                f'{self.failed} times started again after a load too large to follow')
        if self.silent:
            level = _ERROR
            notes.append(f'no command and no heartbeat for {_listed(self.silent)}')
        return level, '; '.join(notes) or 'commands in time'


def _listed(names: Sequence[str]) -> str:
    """Return names for a sentence, the first few of many."""
    return ', '.join(names[:4]) + (f' and {len(names) - 4} more' if len(names) > 4 else '')


def enough_samples(actuator: ActuatorParameters) -> float:
    """Return the least sample rate in Hz that shows the actuator's small vibration about rest."""
    frequency = float(natural_frequency(actuator.rest, actuator.nondimensional))
    return _SAMPLES_A_PERIOD * frequency / (2.0 * math.pi * actuator.time_unit)


def too_few_samples(actuator: ActuatorParameters, rate: float) -> str:
    """Return a warning if a sample rate in Hz is too low for an actuator, or nothing."""
    enough = enough_samples(actuator)
    if rate >= enough:
        return ''
    return (f'publish_rate {rate:g} Hz gives {_SAMPLES_A_PERIOD * rate / enough:.1f} samples in '
            'a period of the actuator, and peaks of its vibration are missed: expected at least '
            f'{_SAMPLES_A_PERIOD:g}, a publish_rate of {math.ceil(enough):d}')
