"""The plain step, the paper's unshaped input."""

from hmsa_ros.core.moves import Move
from hmsa_ros.core.shapers.request import Request
from hmsa_ros.core.status import Code


def step(request: Request) -> Move:
    """Apply the target's own load at once and let the motion ring down."""
    return request.plain(Code.STEP, '')
