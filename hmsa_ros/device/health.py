"""Status of a device: its commands, its hardware, and its interlock."""

from collections.abc import Sequence

from hmsa.errors import listed

_OK, _WARN, _ERROR = 0, 1, 2


def judge_commands(
        *, late: int = 0, refused: int = 0, refused_source: int = 0, failed: int = 0,
        silent: Sequence[str] = (), crowded: Sequence[str] = (),
        rivals: str = '') -> tuple[int, str]:
    """
    Return the status for /diagnostics: level (0 OK, 1 WARN, 2 ERROR) and message.

    It depends on counts, on the joints without commands (``silent``) or with several publishers
    (``crowded``), and on other devices (``rivals``).
    """
    refused += refused_source
    return _verdict(
        'commands in time', (_ERROR, rivals),
        (_WARN, f'{late} commands late, {refused} refused' if late or refused else ''),
        (_WARN, f'several publishers command {listed(crowded)}' if crowded else ''),
        (_ERROR, f'{failed} times started again after a load too large to follow'
         if failed else ''),
        (_ERROR, f'no command and no heartbeat for {listed(silent)}' if silent else ''))


def judge_hardware(trouble: str, *, saturated: int, state_lost: int) -> tuple[int, str]:
    """Return the status of hardware from an error and counts."""
    return (_ERROR, trouble) if trouble else _verdict(
        'hardware obeys',
        (_WARN, f'{saturated} levels not reached: the amplifier is saturated'
         if saturated else ''),
        (_WARN, f'its state was lost, times: {state_lost}' if state_lost else ''))


def _verdict(fine: str, *notes: tuple[int, str]) -> tuple[int, str]:
    """Return the worst level of the notes, and all their messages."""
    present = [x for x in notes if x[1]]
    return max((x for x, _ in present), default=_OK), '; '.join(x for _, x in present) or fine


def judge_interlock(why: str) -> tuple[int, str]:
    """Return the status of an interlock from the reason why it is open."""
    return (_ERROR, f'open: {why}') if why else (_OK, 'closed')
