"""Record of a run: measurements, commands, plans and parameters of one actuator."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
import math
from pathlib import Path
from typing import Any, cast, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.interfaces.outcome import Outcome
from hmsa.interfaces.parameters import LATENESS_LIMIT, number_of
from hmsa.interfaces.topics import PLANT
from hmsa.judge.records import SensorModel
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.units import NANOSECONDS
from hmsa.runs.levels import came_too_late, in_force, RecordedLevel, without_repeats
from hmsa.runs.parameters import of_joint
from hmsa.runs.topics import APPLIED

if TYPE_CHECKING:
    from hmsa.bag.info import BagSummary

Times = NDArray[np.int64]
# Larger median delays of samples in ns mean that the recorder used another clock.
_SAME_CLOCK = 60 * NANOSECONDS


def read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array that cannot be written to."""
    view = values.view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True)
class RecordedVerdict:
    """The planner's verdict on a request."""

    sent: int  # recording time in ns
    level: str  # ``'ok'``, ``'warning'`` or ``'error'``
    code: str
    message: str


@dataclass(frozen=True)
class LearntSensor:
    """The planner's estimate of a sensor from a time on."""

    sent: int  # recording time in ns
    sensor: SensorModel


@dataclass(frozen=True, eq=False)
class Run:
    """Data of one actuator in one run; tuples are in recorded order."""

    label: str  # name for display
    joint: str  # name in the joint states; empty if unknown
    path: Path  # the bag or table
    time: Times  # shape (n,), n of at least 1: timestamps in ns, increasing
    logged: Times  # shape (n,): recording times of the samples in ns
    stretch: Array  # shape (n,)
    rate: Array  # shape (n,): in 1/s, computed from the stretch if not recorded
    flux_density: Array  # shape (n,): in T, NaN if not recorded
    commands: tuple[RecordedLevel, ...] = ()
    applied: tuple[RecordedLevel, ...] = ()  # changes of the field that took effect, as reported
    forces: tuple[tuple[int, int, float], ...] = ()  # recording time, timestamp (ns), newtons
    # Recording time, timestamp (ns), and temperature in degrees Celsius
    temperatures: tuple[tuple[int, int, float], ...] = ()
    plans: tuple[tuple[RecordedLevel, ...], ...] = ()
    verdicts: tuple[RecordedVerdict, ...] = ()  # each once
    # Of setpoints, by begin; of a simulated run as planned, without findings
    outcomes: tuple[Outcome, ...] = ()
    sensors: tuple[LearntSensor, ...] = ()  # by time; the given sensor applies before
    # Parameters of the nodes, by ``'node.name'``
    parameters: Mapping[str, object] = field(default_factory=dict)
    plant: ActuatorParameters = field(default_factory=paper_actuator)  # true parameters
    # Parameters used by the planner
    planner: ActuatorParameters = field(default_factory=paper_actuator)
    parameters_known: bool = False  # if False, those of the example block
    left_out: int = 0  # messages or rows that could not be used
    notes: tuple[str, ...] = ()  # information for the reader, one sentence each
    # Topic names by role (`hmsa.runs.topics`)
    topics: Mapping[str, str] = field(default_factory=dict)
    summary: 'BagSummary | None' = None  # None for a table
    # ``'recorded'``, or ``'simulated'`` for samples of the simulated plant
    origin: str = 'recorded'

    def __post_init__(self) -> None:
        """Check the arrays, and protect the record from changes."""
        for name in ('time', 'logged', 'stretch', 'rate', 'flux_density'):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        shapes = {x.shape for x in (
            self.time, self.logged, self.stretch, self.rate, self.flux_density)}
        if len(shapes) != 1 or not len(self.time) or np.any(np.diff(self.time) <= 0):
            raise BadInputError(
                f'the samples of {self.label} have shapes {sorted(shapes)}: expected one shape, '
                'at least one sample, and increasing times')

    def lost(self, *names: str) -> list[str]:
        """Return the numbers of messages that the recorder lost, as ``'3 of /name'``."""
        counts = {} if self.summary is None else {x.name: x.lost for x in self.summary.topics}
        return [f'{count} of {name}' for x in names
                if (name := self.topics.get(x)) and (count := counts.get(name))]

    def number(self, name: str) -> float:
        """Return a number like ``'planner.slew_limit'``; 0 if unknown, negative or not finite."""
        value = number_of(of_joint(self.parameters, self.joint, name))
        return value if value is not None and 0.0 <= value < math.inf else 0.0

    @property
    def temperature(self) -> float:
        """Mean of the recorded temperatures in degrees Celsius; NaN if there are none."""
        values = [x for _, _, x in self.temperatures]
        return sum(values) / len(values) if values else math.nan

    def coil_time_constant(self, node: str) -> float:
        """Return the time constant in s that a node has for the coil, at the temperature."""
        own = self.plant if node == PLANT else self.planner
        value = self.number(f'{node}.coil_time_constant')
        if not (value and own.thermal.coil_resistance):
            return value
        given = number_of(of_joint(self.parameters, self.joint, f'{node}.thermal.reference'))
        # The values of the actuator hold at the temperature of the run.
        return value * (1.0 if given is None else own.thermal.factor('coil_resistance', given))

    @property
    def one_clock(self) -> bool:
        """Whether the recorder used the clock of the timestamps."""
        return abs(float(np.median(self.logged - self.time))) <= _SAME_CLOCK

    @cached_property
    def accepted(self) -> tuple[RecordedLevel, ...]:
        """Commands that did not come too late, as plant or driver show, or their parameters."""
        known = number_of(of_joint(self.parameters, self.joint, f'plant.{LATENESS_LIMIT.name}'))
        reports = self.applied if self.reported else None
        if not self.one_clock or known is None and reports is None:
            return self.commands
        late = came_too_late(
            self.commands, reports,
            cast(float, LATENESS_LIMIT.default) if known is None else known)
        return tuple(x for x, too in zip(self.commands, late, strict=True) if not too)

    @cached_property
    def rejected(self) -> int:
        """Number of changes of level that came too late."""
        kept = {id(x) for x in self.accepted}
        return sum(id(x) not in kept for x in without_repeats(self.commands)[0])

    @property
    def reported(self) -> tuple[RecordedLevel, ...]:
        """
        Levels that the plant reported as applied, by time.

        Empty if some reports were lost and there are commands to use instead.
        """
        if self.commands and self.lost(APPLIED):
            return ()
        return tuple(sorted(self.applied, key=lambda x: x.stamp))

    @property
    def levels(self) -> tuple[RecordedLevel, ...]:
        """
        Changes of the field, by time.

        These are the levels that the plant reported as applied; without complete reports the
        commands that were not replaced; else changes of the measured flux density, accurate to one
        sample.
        """
        if reported := self.reported:
            return reported
        if self.commands:
            return in_force((x,) for x in self.accepted)
        known = np.flatnonzero(np.isfinite(self.flux_density))
        values = self.flux_density[known]
        places = known[np.append(True, values[1:] != values[:-1])] if len(known) else known
        return tuple(
            RecordedLevel(int(self.time[i]), float(self.flux_density[i]), int(self.logged[i]))
            for i in places)
