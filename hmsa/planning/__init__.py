"""
Plans without residual vibration: the two-step command, shapers, sequences and their timeline.

Like the model, it is dimensionless unless a name says otherwise, and does not depend on ROS.
"""

from collections.abc import Callable

#: Called after each bounded amount of work; raises to abandon it.
Check = Callable[[], None]


def proceed() -> None:
    """Go on, as a `Check` that abandons nothing."""
