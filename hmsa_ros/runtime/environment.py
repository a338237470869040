"""Information that a planner at work requests from its caller."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmsa_ros.runtime.worker import Inline, Worker
from hmsa_ros.timekeeping import steady_ns

#: Returns the time in ns of the clock of timestamps.
Clock = Callable[[], int]


class ObservedSample(NamedTuple):
    """A sample of a joint."""

    stamp: int  # in ns
    stretch: float
    rate: float  # in 1/s
    flux_density: float  # in T
    lag: int | None = None  # age at arrival in ns; None if all nodes share a clock
    came: int = 0  # time of arrival, in ns by the steady clock; 0 for now


@dataclass
class Environment:
    """
    Queries to the caller of a planner; times in ns.

    The first request waits for samples, if a publisher may provide them, and for a subscriber that
    carries out commands.
    """

    clock: Clock  #: clock of the timestamps and of `hmsa_ros.runtime.runtime.Runtime.tick`
    steady: Clock = steady_ns  #: clock of timeouts and slices
    worker: Worker = field(default_factory=Inline)  #: plans requests
    #: Whether all nodes share one clock, such as simulated time.
    one_clock: Callable[[], bool] = bool
    #: Whether there may be a publisher of samples.
    observable: Callable[[], bool] = lambda: True
    #: Why commands are not carried out; empty if they are.
    unheard: Callable[[], str] = str
    #: Whether a joint has a device that reports.
    found: Callable[[str], bool] = lambda joint: True
    #: Whether the device of a joint gives receipts.
    reports: Callable[[str], bool] = lambda joint: False
    #: Identifiers of the publishers of applied levels of a joint.
    reporters: Callable[[str], frozenset[bytes]] = lambda joint: frozenset()
    #: New samples by joint, which requests are checked against.
    glance: Callable[[], Iterable[tuple[str, ObservedSample]]] = tuple
