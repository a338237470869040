"""What the faults share: a list to enter themselves in, and moves that are measured."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import Fault, Seen

#: Largest residual, as a share of the step, of a move that is as planned.
LIMIT = 1e-6
#: Targets far enough apart, in both directions.
TARGETS = (1.1, 1.3, 0.95, 1.2, 1.4)
#: Ahead of its stamp, in s: the planner's default.
LEAD = 0.05
#: Where lead_time is not what is looked at, in s.
PATIENT_LEAD = 0.2

Inject = Callable[[Rig], Seen]


class Register(list[Fault]):
    """The faults of one kind, in order."""

    def fault(
            self, key: str, name: str, how: str, expected: str) -> Callable[[Inject], Inject]:
        """
        Enter a function as a fault.

        Parameters
        ----------
        key, name, how, expected : str
            As of `Fault`.

        Returns
        -------
        callable
            A decorator.

        """
        def enter(inject: Inject) -> Inject:
            self.append(Fault(key, name, how, expected, inject))
            return inject

        return enter


def pair(
        rig: Rig, *, plant: Mapping[str, object] | None = None,
        planner: Mapping[str, object] | None = None,
        remap: Mapping[str, str] | None = None, slow: float = 0.0) -> None:
    """
    Start a plant and a planner and wait until both are ready.

    Parameters
    ----------
    rig : Rig
        Where.
    plant, planner : mapping of str to object, optional
        Parameters.
    remap : mapping of str to str, optional
        Names that the planner is to replace.
    slow : float
        Real-time factor with the plant as authority on time; 0 for time by the wall.

    """
    led = {'publish_clock': True, 'real_time_factor': slow} if slow else {}
    # By the wall, so far ahead that stalls of a busy machine are no faults of their own.
    follows: dict[str, object] = {'use_sim_time': True} if slow else {'lead_time': PATIENT_LEAD}
    rig.start('plant', {**led, **(plant or {})})
    rig.start('planner', {**follows, **(planner or {})}, remap)
    rig.ready('plant', 'planner')


def move(
        rig: Rig, target: float, *, start: float, pause: float = 0.3,
        patience: float = 60.0) -> tuple[float, float]:
    """
    Ask for one stretch and measure what is left of the move.

    Parameters
    ----------
    rig : Rig
        With a plant and a planner.
    target, start : float
        Stretch asked for, and the one before, for the step.
    pause : float
        Of the plant's time until the end is looked at, in s.
    patience : float
        In s on the wall.

    Returns
    -------
    residual, error : float
        As `settled` has them.

    """
    mark = rig.count()
    rig.setpoint(target)
    await_change(rig, mark, patience)
    rig.let_pass(pause, patience)
    return settled(*rig.samples(mark), rig.applied, target, target - start)


def await_change(rig: Rig, mark: int, patience: float = 60.0) -> None:
    """
    Wait until the flux density in force changes.

    Parameters
    ----------
    rig : Rig
        With a plant.
    mark : int
        Sample from which on a change counts.
    patience : float
        In s on the wall.

    """
    rig.spin_until(lambda: jump(rig, mark) > 0.0, 'a command to take effect', patience)


def moves(
        rig: Rig, targets: Sequence[float] = TARGETS, *, start: float = 1.0,
        pause: float = 0.3, patience: float = 60.0) -> float:
    """
    Ask for several stretches, one after the other.

    Parameters
    ----------
    rig : Rig
        With a plant and a planner.
    targets : sequence of float
        Stretches.
    start : float
        Stretch before the first.
    pause, patience : float
        As of `move`.

    Returns
    -------
    float
        Worst residual or error.

    """
    worst = 0.0
    for target in targets:
        worst = max(worst, *move(rig, target, start=start, pause=pause, patience=patience))
        start = target
    return worst


def jump(rig: Rig, first: int, last: int | None = None) -> float:
    """
    Return the largest change of the flux density in force between two samples.

    Parameters
    ----------
    rig : Rig
        With a plant.
    first, last : int
        Marks between which to look.

    Returns
    -------
    float
        In T.

    """
    flux = rig.samples(first)[1][:None if last is None else last - first, 2]
    return float(np.max(np.abs(np.diff(flux)), initial=0.0))


def share(value: float) -> str:
    """
    Return a residual as text.

    Parameters
    ----------
    value : float
        As a share of the step.

    Returns
    -------
    str
        Two digits.

    """
    return f'{value:.1e}'
