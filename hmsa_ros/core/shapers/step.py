"""The plain step, the paper's unshaped input."""

from hmsa_ros.core.moves import Move
from hmsa_ros.core.shapers.request import Request
from hmsa_ros.core.status import Code


def step(request: Request) -> Move:
    """
    Apply the target's own load at once and let the motion ring down.

    Parameters
    ----------
    request : Request
        The move.

    Returns
    -------
    Move
        One level; the target is only approached.

    Raises
    ------
    RefusedError
        If the target lies outside the stretch limits or needs a load outside the limits.

    """
    return request.plain(Code.STEP, '')
