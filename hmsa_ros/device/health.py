"""Whether a device is well driven: the verdict on its commands, and on how often it is sampled."""

from collections.abc import Sequence
import math

from hmsa_ros.model.parameters import ActuatorParameters

_OK, _WARN, _ERROR = 0, 1, 2
# Below, peaks of a vibration lie between samples.
_SAMPLES_A_PERIOD = 10.0


def judge_commands(
        *, late: int = 0, refused: int = 0, refused_source: int = 0, failed: int = 0,
        silent: Sequence[str] = (), crowded: Sequence[str] = (),
        rivals: str = '') -> tuple[int, str]:
    """
    Return the verdict for /diagnostics: level (0 OK, 1 WARN, 2 ERROR) and message.

    Of counts, of the joints that nobody (``silent``) or several (``crowded``) command, and of what
    other devices there are (``rivals``).
    """
    level, notes = _OK, []
    if late or refused or refused_source:
        level = _WARN
        notes.append(f'{late} commands late, {refused + refused_source} refused')
    if crowded:
        level = _WARN
        notes.append(f'several publishers command {listed(crowded)}')
    if failed:
        level = _ERROR
        notes.append(f'{failed} times started again after a load too large to follow')
    if silent:
        level = _ERROR
        notes.append(f'no command and no heartbeat for {listed(silent)}')
    if rivals:
        level = _ERROR
        notes.insert(0, rivals)
    return level, '; '.join(notes) or 'commands in time'


def judge_hardware(trouble: str, *, saturated: int, state_lost: int) -> tuple[int, str]:
    """Return the verdict on hardware, of what keeps a coil off and of counts."""
    if trouble:
        return _ERROR, trouble
    notes = [text for count, text in (
        (saturated, f'{saturated} levels not reached: the amplifier is saturated'),
        (state_lost, f'its state was lost, times: {state_lost}')) if count]
    return (_WARN, '; '.join(notes)) if notes else (_OK, 'hardware obeys')


def judge_interlock(why: str) -> tuple[int, str]:
    """Return the verdict on an interlock, of why it is open."""
    return (_ERROR, f'open: {why}') if why else (_OK, 'closed')


def listed(names: Sequence[str]) -> str:
    """Return names for a sentence, the first few of many."""
    return ', '.join(names[:4]) + (f' and {len(names) - 4} more' if len(names) > 4 else '')


def enough_samples(actuator: ActuatorParameters) -> float:
    """Return the least sample rate in Hz that shows the actuator's small vibration about rest."""
    return _SAMPLES_A_PERIOD / actuator.period


def too_few_samples(actuator: ActuatorParameters, rate: float) -> str:
    """Return a warning if a sample rate in Hz is too low for an actuator, or nothing."""
    enough = enough_samples(actuator)
    if rate >= enough:
        return ''
    return (f'publish_rate {rate:g} Hz gives {_SAMPLES_A_PERIOD * rate / enough:.1f} samples in '
            'a period of the actuator, and peaks of its vibration are missed: expected at least '
            f'{_SAMPLES_A_PERIOD:g}, a publish_rate of {math.ceil(enough):d}')
