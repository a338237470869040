"""Sampling rate that resolves the vibration of an actuator."""

import math

from hmsa.model.parameters import ActuatorParameters

# With fewer samples per period, peaks of a vibration are missed.
_SAMPLES_A_PERIOD = 10.0


def enough_samples(actuator: ActuatorParameters) -> float:
    """Return the smallest sampling rate in Hz that resolves the actuator's small vibration."""
    return _SAMPLES_A_PERIOD / actuator.period


def too_few_samples(actuator: ActuatorParameters, rate: float) -> str:
    """Return a warning if a sampling rate in Hz is too low for an actuator; else empty."""
    enough = enough_samples(actuator)
    if rate >= enough:
        return ''
    return (f'publish_rate {rate:g} Hz gives {_SAMPLES_A_PERIOD * rate / enough:.1f} samples in '
            'a period of the actuator, and peaks of its vibration are missed: expected at least '
            f'{_SAMPLES_A_PERIOD:g}, a publish_rate of {math.ceil(enough):d}')
