"""What goes into a planner runtime and what comes out of it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from hmsa_ros.errors import BadInputError
from hmsa_ros.estimation.correction import TOLERANCE
from hmsa_ros.estimation.prior import TRACKED
from hmsa_ros.identification.known import Known
from hmsa_ros.judge.records import Finding, GoalTolerances, Tolerances
from hmsa_ros.model.status import Code
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.group import Progress

#: What a trajectory with velocities is: refused, or a path to follow.
TRAJECTORY_MODES = ('rest', 'path')
#: What to do when a coil was cut off: wait for a request, or go on with a shaped move.
AFTER_CUT_OFF = ('wait', 'resume')


@dataclass(frozen=True)
class Settings:
    """How a runtime deals with time and with what it hears; times in ns."""

    # How often the level in force is sent again; 0 for never.
    heartbeat_period: int = NANOSECONDS // 5
    replan_late: bool = True  # plan the rest of a sequence anew when reality has left the plan
    lateness_tolerance: int = 5000  # how late a command may be without a new plan
    takeover_timeout: int = NANOSECONDS // 2  # wait for plant and sample at first; 0 for not
    takeover_max_age: int = NANOSECONDS // 2  # largest age of such a sample
    after_cut_off: str = 'wait'  # one of `AFTER_CUT_OFF`
    max_points: int = 100_000  # setpoints of one request, of all joints together
    trajectory_mode: str = 'rest'  # one of `TRAJECTORY_MODES`
    allow_partial_joints: bool = False  # whether a trajectory may lack joints
    tolerances: Tolerances = field(default_factory=Tolerances)
    # ``off``; ``observe`` to estimate from samples; ``adapt`` to correct plans too.
    feedback: str = 'off'
    feedback_parameters: tuple[str, ...] = TRACKED  # what is estimated besides the state
    feedback_cautious: bool = False  # take longer for moves that are expected to leave much
    feedback_tolerance: float = TOLERANCE  # share of its step from which on that is much
    feedback_trim: float = 0.0  # largest change in T of a level against a force; 0: none
    feedback_frozen: bool = False  # estimate the state alone, and keep the parameters
    feedback_file: str = ''  # where to write what was learnt; empty for nowhere
    # By joint, how well parameters are known before the first sample.
    known: Mapping[str, Known] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ('heartbeat_period', 'lateness_tolerance', 'takeover_timeout',
                     'takeover_max_age', 'max_points'):
            if getattr(self, name) < 0:
                raise BadInputError(f'{name} is {getattr(self, name)}: expected at least 0')


# -- in -----------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Trajectory:
    """
    A request to go through setpoints.

    A point has the stretch of each joint, and the time in ns from the start until which it lasts;
    if raw, the flux density in T of each joint, and the time from which it applies. Points are
    read bit by bit, and again where they are planned again; they may raise `RefusedError` where
    they cannot be read. Those of a ``path``, if there is one, have stretch, rate (1/s) and
    acceleration (1/s^2, or NaN) of each joint; it is followed if settings, or ``follows``, say so.
    """

    joints: tuple[str, ...]
    points: Iterable[tuple[Sequence[Any], int]]
    count: int  # of the points
    stamp: int | None = None  # start in ns; None for now
    name: str = ''  # repeated in the verdict
    raw: bool = False
    path: Iterable[tuple[Sequence[Any], int]] | None = None
    follows: bool = False
    # By joint, what counts as having arrived at the end, where it is not as in the settings.
    goals: Mapping[str, GoalTolerances] = field(default_factory=dict)


@dataclass(frozen=True)
class Target:
    """A request to go to one stretch now and to hold it."""

    joint: str
    stretch: float
    name: str = ''

    @property
    def joints(self) -> tuple[str, ...]:
        """Whom it is for."""
        return (self.joint,)


@dataclass(frozen=True)
class Stop:
    """A request to drop what is ahead and to come to rest."""

    name: str = ''


Request = Trajectory | Target | Stop


# -- out ----------------------------------------------------------------------------------------

class Severity(IntEnum):
    """How bad something is, as in diagnostics."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Verdict:
    """How a request fares; an error where it is not carried out."""

    severity: Severity
    code: Code
    message: str  # one sentence for people
    request: str = ''  # its name
    figures: Mapping[str, float] = field(default_factory=dict)  # what the sentence is about


@dataclass(frozen=True)
class Send:
    """A command to send now: a flux density in T that a joint's coil has from a stamp in ns on."""

    joint: str
    stamp: int
    flux_density: float


@dataclass(frozen=True)
class PlanChanged:
    """A preview of what is planned, wherever the level of a joint changes."""

    stamps: tuple[int, ...]  # in ns, increasing; of a long plan the beginning
    # By joint, for each stamp: stretch, rate in 1/s and flux density in T from then on.
    samples: Mapping[str, Sequence[tuple[float, float, float]]]


@dataclass(frozen=True)
class StatusChanged:
    """A new verdict, or a step in the progress."""

    verdict: Verdict
    progress: Progress
    each: Mapping[str, Progress]
    plan: int  # accepted requests so far
    late: int  # late commands
    replanned: int  # plans made anew
    findings: Mapping[str, Finding] = field(default_factory=dict)  # at the newest setpoint judged
    worst: Finding | None = None  # of the last request
    watching: bool = False  # whether setpoints that have begun are still to be judged
    unheard: str = ''  # why nobody carries out commands; empty where somebody does
    unseen: str = ''  # of which joint samples have ceased; empty for none
    measuring: bool = False  # whether samples have come lately
    # What each joint's position is called.
    coordinates: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Note:
    """A sentence for the log."""

    severity: Severity
    message: str


@dataclass(frozen=True)
class EstimateChanged:
    """What samples say of a joint."""

    time: int  # in ns
    joint: str
    severity: Severity  # WARN where parameters are not those given, or samples not trusted
    message: str
    values: Mapping[str, object]  # in SI, with deviations and given values, and counters


Output = Send | PlanChanged | StatusChanged | Note | EstimateChanged
