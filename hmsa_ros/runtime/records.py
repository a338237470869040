"""What goes into a planner runtime and what comes out of it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from hmsa_ros.core.group import Progress
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError
from hmsa_ros.estimation.correction import TOLERANCE
from hmsa_ros.estimation.prior import TRACKED
from hmsa_ros.identification.known import Known
from hmsa_ros.runtime.measured import Finding, Tolerances


@dataclass(frozen=True)
class Settings:
    """
    How a runtime deals with time and with what it hears; times in ns.

    Attributes
    ----------
    heartbeat_period : int
        How often the level in force is sent again; 0 for never.
    replan_late : bool
        Whether the rest of a sequence is replanned when reality has left the plan.
    lateness_tolerance : int
        How late a command may take effect without a new plan.
    takeover_timeout : int
        How long the first request waits for a plant and a sample of the state in force; 0 for
        not at all.
    takeover_max_age : int
        Age up to which such a sample counts.
    max_points : int
        Setpoints that one request may have, those of all joints together.
    allow_partial_joints : bool
        Whether a trajectory may be for some of the joints.
    tolerances : Tolerances
        What counts as having arrived, where it is measured.
    feedback : str
        ``off``; ``observe`` to estimate from samples; ``adapt`` to correct plans too.
    feedback_parameters : tuple of str
        What is estimated besides the state.
    feedback_cautious : bool
        Whether a move takes longer where it is expected to leave much.
    feedback_tolerance : float
        Share of its step from which on that is much.
    feedback_trim : float
        Largest change in T of a holding level against an estimated constant force; 0 for none.
    feedback_frozen : bool
        Whether these stay as they are, and the state alone is estimated.
    feedback_file : str
        Where to write what was learnt; empty for nowhere.
    known : mapping of str to Known
        By joint, how well parameters are known before the first sample.

    Raises
    ------
    BadInputError
        If a number is negative.

    """

    heartbeat_period: int = NANOSECONDS // 5
    replan_late: bool = True
    lateness_tolerance: int = 5000
    takeover_timeout: int = NANOSECONDS // 2
    takeover_max_age: int = NANOSECONDS // 2
    max_points: int = 100_000
    allow_partial_joints: bool = False
    tolerances: Tolerances = field(default_factory=Tolerances)
    feedback: str = 'off'
    feedback_parameters: tuple[str, ...] = TRACKED
    feedback_cautious: bool = False
    feedback_tolerance: float = TOLERANCE
    feedback_trim: float = 0.0
    feedback_frozen: bool = False
    feedback_file: str = ''
    known: Mapping[str, Known] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ('heartbeat_period', 'lateness_tolerance', 'takeover_timeout',
                     'takeover_max_age', 'max_points'):
            if getattr(self, name) < 0:
                raise BadInputError(f'{name} is {getattr(self, name)}: expected at least 0')


# -- in -----------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Trajectory:
    """
    A request to go through setpoints.

    Attributes
    ----------
    joints : tuple of str
        Whose setpoints they are.
    points : iterable of (tuple of float, int)
        Stretch of each joint, and time in ns from the start until which they last. It is read
        bit by bit, and may raise `RefusedError` where it cannot be read. If raw: flux density in
        T of each joint, and time from which they apply.
    count : int
        How many points there are.
    stamp : int or None
        Start in ns; None for now.
    name : str
        Repeated in the verdict.
    raw : bool
        Whether the points are levels.

    """

    joints: tuple[str, ...]
    points: Iterable[tuple[Sequence[float], int]]
    count: int
    stamp: int | None = None
    name: str = ''
    raw: bool = False


@dataclass(frozen=True)
class Target:
    """A request to go to one stretch now and to hold it."""

    joint: str
    stretch: float
    name: str = ''


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
    """
    How a request fares.

    Attributes
    ----------
    severity : Severity
        ERROR where it is not carried out.
    code : str
        One word for programs.
    message : str
        One sentence for people.
    request : str
        Name of the request.
    figures : mapping of str to float
        Numbers that the sentence is about, where there are any.

    """

    severity: Severity
    code: str
    message: str
    request: str = ''
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Send:
    """A command to send now: a flux density in T that a joint's coil has from a stamp in ns on."""

    joint: str
    stamp: int
    flux_density: float


@dataclass(frozen=True)
class PlanChanged:
    """
    A preview of what is planned, wherever the level of a joint changes.

    Attributes
    ----------
    stamps : tuple of int
        In ns, increasing; where there are too many for one preview, the next one follows in time.
    samples : mapping of str to sequence of (float, float, float)
        By joint, one for each stamp: stretch, rate in 1/s and flux density in T from then on.

    """

    stamps: tuple[int, ...]
    samples: Mapping[str, Sequence[tuple[float, float, float]]]


@dataclass(frozen=True)
class StatusChanged:
    """
    A new verdict, or a step in the progress.

    Attributes
    ----------
    verdict : Verdict
        On the last request.
    progress : Progress
        Of all joints.
    each : mapping of str to Progress
        Of each.
    plan, late, replanned : int
        Accepted requests, late commands, and plans made anew so far.
    findings : mapping of str to Finding
        By joint, what was measured at the newest setpoint that has been judged.
    worst : Finding or None
        The worst since the last request.
    watching : bool
        Whether setpoints that have begun are still to be judged.
    unheard : str
        Why nobody carries out commands; empty where somebody does.
    coordinates : mapping of str to str
        By joint, what its position is called.

    """

    verdict: Verdict
    progress: Progress
    each: Mapping[str, Progress]
    plan: int
    late: int
    replanned: int
    findings: Mapping[str, Finding] = field(default_factory=dict)
    worst: Finding | None = None
    watching: bool = False
    unheard: str = ''
    coordinates: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Note:
    """A sentence for the log."""

    severity: Severity
    message: str


@dataclass(frozen=True)
class EstimateChanged:
    """
    What samples say of a joint.

    Attributes
    ----------
    time : int
        In ns.
    joint : str
        Whose it is.
    severity : Severity
        WARN where parameters differ from those given, or samples are not trusted.
    message : str
        One sentence for people.
    values : mapping of str to object
        Parameters in SI, with standard deviations and given values, and counters.

    """

    time: int
    joint: str
    severity: Severity
    message: str
    values: Mapping[str, object]


Output = Send | PlanChanged | StatusChanged | Note | EstimateChanged
