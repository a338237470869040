"""What a planner at work asks of whoever drives it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import monotonic_ns
from typing import NamedTuple

from hmsa_ros.control.slices import Clock


class Seen(NamedTuple):
    """A sample of a joint."""

    stamp: int  # in ns
    stretch: float
    rate: float  # in 1/s
    flux_density: float  # in T
    lag: int | None = None  # how old it was when it came, in ns; None where one clock tells both
    came: int = 0  # when it came, in ns by the steady clock


@dataclass
class Surroundings:
    """
    Answers of whoever drives a planner; times in ns.

    The first request waits for samples, if somebody may give them, and for whoever carries out
    commands.
    """

    clock: Clock  #: time of the stamps and of `hmsa_ros.control.planner.PlannerRuntime.tick`
    steady: Clock = monotonic_ns  #: what timeouts and the length of a slice are measured by
    #: Whether one clock tells the times of all nodes, as simulated time does.
    one_clock: Callable[[], bool] = bool
    #: Whether somebody may give samples.
    observable: Callable[[], bool] = lambda: True
    #: Why nobody carries out commands; empty where somebody does.
    unheard: Callable[[], str] = str
    #: Whether a joint has a device that reports.
    found: Callable[[str], bool] = lambda joint: True
    #: Identifiers of who reports applied levels of a joint.
    reporters: Callable[[str], frozenset[bytes]] = lambda joint: frozenset()
    #: The newest samples by joint, if there are new ones: requests are held against them.
    glance: Callable[[], Iterable[tuple[str, Seen]]] = tuple
