"""What goes into a planner at work, what comes out, and what it asks its caller."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple, TYPE_CHECKING

from hmsa.errors import check_number, excerpt
from hmsa.interfaces.diagnostics import Outcome
from hmsa.judge.records import Finding, GoalTolerances, Tolerances
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa_ros.runtime.worker import Inline, Worker
from hmsa_ros.timekeeping import steady_ns

if TYPE_CHECKING:  # slow to import, and not needed by all nodes
    from hmsa.identification.quantities import Known
    from hmsa.planning.group import Progress

#: How velocities in a trajectory are treated: refused, as it rests at each point, or as a path.
TRAJECTORY_MODES = ('rest', 'path')
#: What to do after a coil was cut off: wait for a request, or continue with a shaped move.
AFTER_CUT_OFF = ('wait', 'resume')
#: Open loop; estimates from samples; corrected plans, too; slower moves where errors are likely.
FEEDBACK_MODES = ('off', 'observe', 'adapt', 'cautious')
#: Parameters that feedback estimates by default.
TRACKED = ('shear_modulus', 'damping_coefficient', 'stretch_bias')


@dataclass(frozen=True)
class Settings:
    """Settings of a planner runtime; times in ns."""

    # Interval at which the level in force is sent again; 0 for never.
    heartbeat_period: int = NANOSECONDS // 5
    replan_late: bool = True  # replan the rest of a sequence after a deviation
    lateness_tolerance: int = 5000  # largest lateness without a new plan
    takeover_timeout: int = NANOSECONDS // 2  # initial wait for plant and sample; 0: no wait
    takeover_max_age: int = NANOSECONDS // 2  # maximum age of such a sample
    temperature_max_age: int = 10 * NANOSECONDS  # age of a temperature from which it is old
    after_cut_off: str = 'wait'  # one of `AFTER_CUT_OFF`
    max_points: int = 100_000  # maximum number of setpoints in a request, summed over joints
    trajectory_mode: str = 'rest'  # one of `TRAJECTORY_MODES`
    allow_partial_joints: bool = False  # whether a trajectory may omit joints
    tolerances: Tolerances = field(default_factory=Tolerances)
    feedback: str = 'off'  # one of `FEEDBACK_MODES`
    feedback_parameters: tuple[str, ...] = TRACKED  # estimated in addition to the state
    feedback_cautious: bool = False  # whether ``adapt`` is ``cautious``
    feedback_tolerance: float = 5e-3  # large predicted error, as a fraction of the step
    feedback_trim: float = 0.0  # limit in T for trimming against a force; 0: off
    feedback_frozen: bool = False  # estimate only the state, keep the parameters
    feedback_file: str = ''  # file for learnt parameters; empty: none
    # By joint, prior uncertainty of the parameters.
    known: Mapping[str, 'Known'] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ('heartbeat_period', 'lateness_tolerance', 'takeover_timeout',
                     'takeover_max_age', 'temperature_max_age', 'max_points'):
            check_number(name, getattr(self, name), least=0)

    @property
    def adapts(self) -> bool:
        """Whether plans use the estimate."""
        return self.feedback in ('adapt', 'cautious')

    @property
    def cautious(self) -> bool:
        """Whether moves with a large predicted error are slowed down."""
        return self.feedback == 'cautious' or self.adapts and self.feedback_cautious


# -- in -----------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Trajectory:
    """
    A request to go through setpoints.

    Each point contains the stretch of each joint and the end of the setpoint in ns from the start.
    If ``raw``, it contains the flux density in T of each joint and the time from which it applies.
    Points are read in pieces, and again for each replanning; iterating them may raise
    `RefusedError`. Points of a ``path`` contain stretch, rate (1/s) and acceleration (1/s^2, or
    NaN) of each joint. The path is followed if the settings or ``follows`` request it. Without
    points, it is a stop.
    """

    joints: tuple[str, ...]
    points: Iterable[tuple[Sequence[Any], int]]
    count: int  # number of points
    stamp: int | None = None  # start in ns; None for now
    name: str = ''  # repeated in the verdict
    raw: bool = False
    path: Iterable[tuple[Sequence[Any], int]] | None = None
    follows: bool = False
    # Goal tolerances by joint, where they differ from the settings.
    goals: Mapping[str, GoalTolerances] = field(default_factory=dict)


@dataclass(frozen=True)
class StretchRequest:
    """A request to go to a stretch now and to hold it."""

    joint: str
    stretch: float
    name: str = ''

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that it moves."""
        return (self.joint,)


@dataclass(frozen=True)
class Stop:
    """A request to drop the remaining setpoints and to come to rest."""

    name: str = ''


Request = Trajectory | StretchRequest | Stop


def accepted(
        request: Request, joints: Sequence[str], settings: Settings, now: int, *,
        active: bool) -> Request:
    """
    Return what a request at a time in ns asks for, under the settings.

    Raises `RefusedError` if the planner is inactive or has no time, if a joint is unknown,
    repeated or missing, or if there are too many setpoints.
    """
    if not active:
        raise RefusedError(
            Code.INACTIVE, 'the planner is inactive: expected it active (ros2 lifecycle set NODE '
            'activate)')
    if now == 0:
        raise RefusedError(
            Code.NO_TIME,
            'simulated time has not started: expected messages on /clock (start the simulator, or '
            'set use_sim_time to false)')
    if isinstance(request, StretchRequest) and request.joint not in joints:
        raise RefusedError(
            Code.UNKNOWN_JOINT, f'joint {request.joint!r}: expected one of {", ".join(joints)}')
    if not isinstance(request, Trajectory):
        return request
    _check_joints(request, joints, settings)
    if not request.count:
        # As for a joint_trajectory_controller; goals are checked before.
        return Stop(request.name)
    count = request.count * len(request.joints)
    if count > settings.max_points:
        raise RefusedError(
            Code.TOO_LONG,
            f'the trajectory has {count} setpoints: expected at most {settings.max_points}, the '
            'parameter max_points; send it in parts, each with its start as timestamp')
    if settings.trajectory_mode == 'rest' and not request.follows:
        return replace(request, path=None)
    return request


def _check_joints(request: Trajectory, joints: Sequence[str], settings: Settings) -> None:
    """Refuse unknown joints, and repeated or missing ones of a trajectory that has points."""
    names = request.joints
    if request.count and len(joints) == 1 and names != tuple(joints):
        raise _unknown(f'is {excerpt(list(names))}: expected {list(joints)}')
    if request.count and (twice := sorted({x for x in names if names.count(x) > 1})):
        raise _unknown(f'has {excerpt(twice[0])} twice: expected each joint once')
    if unknown := [x for x in names if x not in joints]:
        raise _unknown(f'has {excerpt(unknown[0])}: expected names among {", ".join(joints)}')
    missing = [x for x in joints if x not in names]
    if request.count and (not names or missing and not settings.allow_partial_joints):
        raise _unknown(
            f'lacks {missing[0]!r}: expected all of {", ".join(joints)} (set '
            'allow_partial_joints to let a message name only some of them)')


def _unknown(reason: str) -> RefusedError:
    return RefusedError(Code.UNKNOWN_JOINT, f'joint_names {reason}')


# -- out ----------------------------------------------------------------------------------------

class Severity(IntEnum):
    """Severity, as in diagnostics."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Verdict:
    """Result of a request; an error if it is not carried out."""

    severity: Severity
    code: Code
    message: str  # one sentence
    request: str = ''  # name of the request
    figures: Mapping[str, float] = field(default_factory=dict)  # values behind the message


@dataclass(frozen=True)
class Send:
    """A command to send now: from a timestamp in ns on, a flux density in T for a joint's coil."""

    joint: str
    stamp: int
    flux_density: float


@dataclass(frozen=True)
class PlanChanged:
    """A preview of the plan, with a sample at each change of level of any joint."""

    stamps: tuple[int, ...]  # in ns, increasing; only the start of a long plan
    # By joint, for each timestamp: stretch, rate in 1/s, and flux density in T from then on.
    samples: Mapping[str, Sequence[tuple[float, float, float]]]


@dataclass(frozen=True)
class StatusChanged:
    """A new verdict or a change in the progress."""

    verdict: Verdict
    progress: 'Progress'
    each: Mapping[str, 'Progress']
    plan: int  # accepted requests so far
    late: int  # late commands
    replanned: int  # number of replannings
    findings: Mapping[str, Finding] = field(default_factory=dict)  # newest, by joint
    worst: Finding | None = None  # worst finding of the last request
    watching: bool = False  # whether started setpoints are still to be judged
    unheard: str = ''  # why commands are not carried out; empty if they are
    unseen: str = ''  # joint whose samples have stopped; empty for none
    measuring: bool = False  # whether there are recent samples
    # Name of each joint's position coordinate.
    coordinates: Mapping[str, str] = field(default_factory=dict)
    # Newest verdicts on recent requests by name, each with the number of plans then.
    answers: Mapping[str, tuple[Verdict, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Note:
    """A message for the log."""

    severity: Severity
    message: str


@dataclass(frozen=True)
class EstimateChanged:
    """An estimate of a joint from samples."""

    time: int  # in ns
    joint: str
    severity: Severity  # WARN if parameters differ from the given ones or samples are not trusted
    message: str
    values: Mapping[str, object]  # in SI, with standard deviations, given values and counters


Output = Send | PlanChanged | StatusChanged | Note | EstimateChanged | Outcome


# -- the caller -----------------------------------------------------------------------------------

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


class Samples(NamedTuple):
    """Samples of a joint, in order of arrival."""

    stamps: Sequence[int]  # in ns
    stretch: Sequence[float]
    rate: Sequence[float]  # in 1/s; NaN if it is not measured
    flux_density: Sequence[float]  # in T; NaN if it is not measured
    came: Sequence[int]  # times of arrival in ns


def by_joint(
        names: Sequence[str],
        rows: Iterable[tuple[int, Sequence[float], Sequence[float], Sequence[float], int]],
        ) -> Iterator[tuple[str, Samples]]:
    """
    Yield each joint with its samples.

    Each row contains a timestamp, stretch, rate and flux density of all joints, and the time of
    arrival, in the units of `Samples`.
    """
    stamps, *measured, came = zip(*rows, strict=True)
    for name, stretch, rate, flux_density in zip(
            names, *(zip(*x, strict=True) for x in measured), strict=True):
        yield name, Samples(stamps, stretch, rate, flux_density, came)


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
