"""The record of a run: what was measured, commanded, planned and known of one actuator."""

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.bag.info import BagSummary
from hmsa_ros.core.model import Array
from hmsa_ros.core.parameters import ActuatorParameters, paper_actuator
from hmsa_ros.errors import BadInputError
from hmsa_ros.runs.levels import in_force, Level
from hmsa_ros.runs.parameters import number_of, of_joint

Times = NDArray[np.int64]


@dataclass(frozen=True)
class RecordedRequest:
    """A request to the planner."""

    sent: int  # time in ns at which it was recorded
    stamp: int  # start of the sequence in ns; 0 for at once
    # Stretch, and time in ns from the start until which it lasts; None for a setpoint that is held
    # until the next.
    points: tuple[tuple[float, int | None], ...]


@dataclass(frozen=True)
class Verdict:
    """What the planner said of a request."""

    sent: int  # time in ns at which it was recorded
    level: str  # ``'ok'``, ``'warning'`` or ``'error'``
    code: str
    message: str
    stretch: float  # target of the setpoint under way; NaN if there is none


@dataclass(frozen=True, eq=False)
class Run:
    """
    What is known of one actuator in one run.

    Attributes
    ----------
    label : str
        Name for people.
    joint : str
        Name of the actuator in the joint states; empty if it is not known.
    path : Path
        The bag or table.
    time : ndarray of int64, shape (n,)
        Stamps of the samples in ns, increasing; n of at least 1.
    logged : ndarray of int64, shape (n,)
        When they were recorded, in ns.
    stretch, rate, flux_density : ndarray, shape (n,)
        Samples; the rate in 1/s, from the stretch if it was not recorded; the flux density in
        T, NaN if it was not recorded.
    commands : tuple of Level
        In the order they were recorded.
    applied : tuple of Level
        Changes of the field that took effect, as the plant or the driver reported them.
    forces : tuple of (int, int, float)
        Disturbing forces in the order they were recorded: recorded at, stamp (ns), newton.
    plans : tuple of tuple of Level
        Plans in the order they were recorded.
    requests : tuple of RecordedRequest
        In the order they were recorded.
    verdicts : tuple of Verdict
        In the order they were recorded, each once.
    parameters : mapping of str to object
        Parameters of the nodes, by ``'node.name'``.
    plant, planner : ActuatorParameters
        The block as it was, and as the planner took it to be.
    parameters_known : bool
        Whether the recording or the caller names the block; else it is the example block.
    left_out : int
        Messages or rows that could not be used.
    notes : tuple of str
        What a reader should know, one sentence each.
    topics : mapping of str to str
        Topic of each role (`hmsa_ros.runs.topics`) in the bag.
    summary : BagSummary or None
        The bag in figures; None for a table.

    Raises
    ------
    BadInputError
        If there is no sample, shapes differ or time does not increase.

    """

    label: str
    joint: str
    path: Path
    time: Times
    logged: Times
    stretch: Array
    rate: Array
    flux_density: Array
    commands: tuple[Level, ...] = ()
    applied: tuple[Level, ...] = ()
    forces: tuple[tuple[int, int, float], ...] = ()
    plans: tuple[tuple[Level, ...], ...] = ()
    requests: tuple[RecordedRequest, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    parameters: Mapping[str, object] = field(default_factory=dict)
    plant: ActuatorParameters = field(default_factory=paper_actuator)
    planner: ActuatorParameters = field(default_factory=paper_actuator)
    parameters_known: bool = False
    left_out: int = 0
    notes: tuple[str, ...] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    summary: BagSummary | None = None

    def __post_init__(self) -> None:
        """Check the arrays."""
        shapes = {x.shape for x in (
            self.time, self.logged, self.stretch, self.rate, self.flux_density)}
        if len(shapes) != 1 or not len(self.time) or np.any(np.diff(self.time) <= 0):
            raise BadInputError(
                f'the samples of {self.label} have shapes {sorted(shapes)}: expected one shape, '
                'at least one sample, and increasing times')

    def number(self, name: str) -> float:
        """Return a number like ``'planner.slew_limit'``; 0 if unknown, negative or not finite."""
        value = number_of(of_joint(self.parameters, self.joint, name))
        return value if value is not None and 0.0 <= value < math.inf else 0.0

    @property
    def levels(self) -> tuple[Level, ...]:
        """
        Changes of the field in force, by stamp.

        What the plant reported as applied; else the commands that were not superseded; else
        changes of the measured flux density, known to one sample.
        """
        if self.applied:
            return tuple(sorted(self.applied, key=lambda x: x.stamp))
        if self.commands:
            return in_force((x,) for x in self.commands)
        known = np.flatnonzero(np.isfinite(self.flux_density))
        values = self.flux_density[known]
        places = known[np.append(True, values[1:] != values[:-1])] if len(known) else known
        return tuple(
            Level(int(self.time[i]), float(self.flux_density[i]), int(self.logged[i]))
            for i in places)
