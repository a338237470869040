"""Code that faults share: a register, and moves that are measured."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.faults.rig import Child, Rig, settled
from benchmarks.faults.table import Fault, Seen

#: Maximum residual of a move as planned, as a fraction of the step.
LIMIT = 1e-6
#: Targets far enough apart, in both directions.
TARGETS = (1.1, 1.3, 0.95, 1.2, 1.4)
#: Lead of a command over its timestamp in s: the planner's default.
LEAD = 0.05
#: Lead where lead_time is not under test, in s.
PATIENT_LEAD = 0.2
# Levels in T that differ by less are equal.
_SAME = 1e-9

Inject = Callable[[Rig], Seen]


class Register(list[Fault]):
    """
    The faults of one kind, in order.

    ``unavailable`` returns why they cannot be injected on this machine; empty if they can.
    """

    def __init__(self, unavailable: Callable[[], str] = str) -> None:
        super().__init__()
        self._unavailable = unavailable

    def fault(
            self, key: str, name: str, how: str, expected: str) -> Callable[[Inject], Inject]:
        """Return a decorator that registers a function as a fault."""
        def enter(inject: Inject) -> Inject:
            self.add(key, name, how, expected, inject)
            return inject

        return enter

    def add(
            self, key: str, name: str, how: str, expected: str, inject: Callable[..., Seen],
            *arguments: Any) -> None:
        """Register a function with further arguments as a fault."""
        def injected(rig: Rig) -> Seen:
            if why := self._unavailable():
                return Seen(f'not tried: {why}', '-', met=True)
            return inject(rig, *arguments)

        self.append(Fault(key, name, how, expected, injected))


def pair(
        rig: Rig, *, plant: Mapping[str, object] | None = None,
        planner: Mapping[str, object] | None = None,
        remap: Mapping[str, str] | None = None, slow: float = 0.0) -> tuple[Child, Child]:
    """Return a started plant and a planner, both ready; if ``slow``, the plant drives time."""
    led = {'publish_clock': True, 'real_time_factor': slow} if slow else {}
    # On the wall clock, a large lead keeps stalls of a busy machine from counting as faults.
    follows: dict[str, object] = {'use_sim_time': True} if slow else {'lead_time': PATIENT_LEAD}
    started = (rig.start('plant', {**led, **(plant or {})}),
               rig.start('planner', {**follows, **(planner or {})}, remap))
    rig.ready('plant', 'planner')
    return started


def move(
        rig: Rig, target: float, *, start: float, pause: float = 0.3,
        patience: float = 60.0) -> tuple[float, float]:
    """Request a stretch; return the result of `settled` after a pause in s of plant time."""
    mark = rig.count()
    rig.setpoint(target)
    await_change(rig, mark, patience)
    rig.let_pass(pause, patience)
    # The report may come later than the samples with its level.
    rig.spin_until(
        lambda: abs(rig.applied[-1][1] - rig.samples(mark)[1][-1, 2]) < _SAME,
        'the report of the last level', patience)
    return settled(*rig.samples(mark), rig.applied, target, target - start)


def await_change(rig: Rig, mark: int, patience: float = 60.0) -> None:
    """Wait until the flux density in force changes after the mark."""
    rig.spin_until(lambda: jump(rig, mark) > 0.0, 'a command to take effect', patience)


def moves(
        rig: Rig, targets: Sequence[float] = TARGETS, *, start: float = 1.0,
        pause: float = 0.3, patience: float = 60.0) -> float:
    """Request several stretches in sequence; return the worst residual or error."""
    worst = 0.0
    for target in targets:
        worst = max(worst, *move(rig, target, start=start, pause=pause, patience=patience))
        start = target
    return worst


def jump(rig: Rig, first: int, last: int | None = None) -> float:
    """Return the largest change in T of the flux density in force between two samples."""
    flux = rig.samples(first)[1][:None if last is None else last - first, 2]
    return float(np.max(np.abs(np.diff(flux)), initial=0.0))


def share(value: float) -> str:
    """Return a residual, a fraction of the step, as text."""
    return f'{value:.1e}'
