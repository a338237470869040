"""
Guided run from an actuator's data sheet to moves without vibration.

It makes the moves with the initial parameters, an excitation, an identification, a choice of the
shaper for the uncertainty of the parameters, a parameter file, and the same moves again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa.api.actuator import Actuator
from hmsa.api.plan import Plan
from hmsa.errors import BadInputError, HmsaError
from hmsa.files import write_text, yaml_text
from hmsa.identification.excitation import Bounds, excite
from hmsa.identification.files import Belief, belief_in, file_text, read_belief
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement, recording_of
from hmsa.identification.quantities import free_of, Known, PREFIX
from hmsa.identification.result import Identification
from hmsa.interfaces.parameters import ACTUATOR_FIELDS
from hmsa.interfaces.topics import PLANNER
from hmsa.judge.records import worst
from hmsa.model.parameters import ActuatorParameters
from hmsa.report.comparison import Part, ringing
from hmsa.runs.bags import read_run
from hmsa.runs.parameters import Entries
from hmsa.runs.record import Run
from hmsa_ros.clients.experiment import conduct, Experiment, ExperimentProgress, prepare

if TYPE_CHECKING:
    from hmsa_ros.clients.processes import NodeProcess

#: Compared shapers, the fastest first.
CANDIDATES = ('two_step', 'zvd', 'robust', 'minimax', 'smooth')
_DRAWS = 24
# Fraction of the draws with at most the reported residual vibration.
_MOST = 0.95
# Smaller steps, in stretch, are not evaluated.
_STEP = 1e-9

# Largest vibration, as a fraction of the step, with which the fastest shaper is chosen.
_QUIET = 0.01
# Limit on identifications, each with the parameters named by the previous one.
_MOST_TRIES = 4
_DELAYS = ('coil_time_constant', 'sensor_latency')
# Range of the excitation beyond the setpoints, as a fraction of their range.
_BEYOND = 0.5


@dataclass(frozen=True)
class Expected:
    """Expected performance of a shaper with uncertain parameters."""

    shaper: str
    #: 95th percentile, over the possible parameters, of the residual vibration after the worst
    #: move, peak to peak, as a fraction of the step; NaN if the shaper rejects the moves
    vibration: float
    #: move time of the longest move in s
    move_time: float
    #: reason if the shaper rejects the moves; else empty
    reason: str = ''


def compare_shapers(
        actuator: Actuator, setpoints: Sequence[tuple[float, float]],
        known: Known) -> list[Expected]:
    """
    Return the expected residual vibration and move time of each of `CANDIDATES`.

    Parameters
    ----------
    actuator : Actuator
        The identified actuator.
    setpoints : pairs
        Stretches and durations in s.
    known : Known
        Values and covariance; other parameters count as exact.

    Returns
    -------
    list of Expected
        In the order of `CANDIDATES`.

    """
    places = [i for i, x in enumerate(known.names) if x in ACTUATOR_FIELDS and known.values]
    drawn = np.random.default_rng(0).multivariate_normal(
        np.zeros(len(places)), known.covariance[np.ix_(places, places)], _DRAWS)
    truths = [
        actuator.scaled(**{
            known.names[i]: 1.0 + max(by / known.values[i], -0.9)
            for i, by in zip(places, row, strict=True)}) for row in drawn.tolist()]
    found = []
    for shaper in CANDIDATES:
        try:
            plan = actuator.plan(setpoints, shaper)
        except BadInputError as error:
            found.append(Expected(shaper, math.nan, math.nan, str(error)))
            continue
        left = [_vibration(plan, x) for x in truths]
        found.append(Expected(
            shaper, float(np.quantile(left, _MOST)), float(np.max(plan.move_times))))
    return found


def choose(expected: Sequence[Expected], tolerance: float) -> Expected:
    """
    Return the fastest shaper whose residual vibration is within tolerance, else the best one.

    The tolerance is a fraction of the step.

    Raises
    ------
    BadInputError
        If every shaper rejects the moves.

    """
    able = [x for x in expected if not x.reason]
    if not able:
        raise BadInputError(f'no shaper plans the setpoints: {expected[0].reason}')
    good = [x for x in able if x.vibration <= tolerance]
    return min(good, key=lambda x: x.move_time) if good else min(able, key=lambda x: x.vibration)


def _vibration(plan: Plan, truth: Actuator) -> float:
    """Return the residual vibration of a plan, as a fraction of the step, after the worst move."""
    motion = plan.simulate(truth=truth)
    ends = np.cumsum(plan.setpoints[:, 1])
    arrivals = ends - plan.setpoints[:, 1] + plan.move_times
    before, worst = plan.segments[0].start.stretch, 0.0
    for target, arrival, end in zip(plan.setpoints[:, 0], arrivals, ends, strict=True):
        after = motion.stretches[(motion.times >= arrival) & (motion.times <= end)]
        if len(after) and abs(target - before) > _STEP:
            worst = max(worst, float(np.ptp(after)) / abs(target - before))
        before = target
    return worst


@dataclass(frozen=True)
class Tuning:
    """Settings of the tuning."""

    folder: Path  #: folder for the bags of all runs
    setpoints: tuple[tuple[tuple[float, ...], float], ...]  #: stretch and duration in s
    out: Path  #: parameter file to write
    entries: Entries  #: given parameters, as in a parameter file
    node: 'NodeProcess | None' = None  #: planner and plant to start; None if they are running
    namespace: str = ''
    duration: float | None = None  #: duration of the excitation in s
    stretch_min: float | None = None  #: limit of the excitation; default below the setpoints
    stretch_max: float | None = None  #: default above the setpoints
    free: str = ''  #: as for ``hmsa identify``
    known: Mapping[str, float] = field(default_factory=dict)  #: known values in SI
    uncertain: Mapping[str, float] = field(default_factory=dict)  #: standard deviations of these
    accept: bool = False  #: whether to accept a small, named defect


@dataclass(frozen=True, eq=False)
class Tuned:
    """Results of the tuning; those after a failure are empty."""

    before: Part
    identified: Identification
    shapers: tuple[Expected, ...] = ()
    shaper: str = ''
    file: Path | None = None
    after: Part | None = None

    @property
    def parts(self) -> list[Part]:
        """The runs with the setpoints."""
        return [self.before, *([] if self.after is None else [self.after])]

    @property
    def verdict(self) -> tuple[str, str]:
        """Overall verdict, and its reason with the next step."""
        if self.after is None:
            return self.identified.verdict, self.identified.reason
        found = worst(self.after.evaluation.findings)
        if found is None:
            return 'unobserved', 'the bag shows no setpoint after tuning'
        if found.arrived:
            return 'tuned', f'all moves arrived and stayed within tolerance{ringing([self.after])}'
        if found.verdict in ('undecided', 'unobserved'):
            return str(found.verdict), found.message
        lacks = self.identified.cost
        return str(found.verdict), found.message + (
            f'; what the model lacks costs {100.0 * lacks:.2g} % of a step' if lacks else
            '; the identification shows no defect: look for what has changed since, or use '
            'hmsa run --feedback adapt')


def tune(tuning: Tuning, progress: ExperimentProgress) -> Tuned:
    """
    Carry out a tuning.

    Parameters
    ----------
    tuning : Tuning
        Settings, with a folder that can be created.
    progress : callable
        Called with the current activity and its completed fraction.

    Returns
    -------
    Tuned
        Without a file and the second moves if the identification failed.

    Raises
    ------
    HmsaError
        If a run is not completed, or the planner refuses the identified parameters.

    """
    belief = read_belief(None, tuning.entries)
    before = Part.of(_run(tuning, 'before', progress, {}))
    progress('designing the excitation', 0.0)
    time = before.run.time
    levels = excitation(tuning, belief, 1e9 * (len(time) - 1) / float(time[-1] - time[0]))
    excited = _run(tuning, 'excitation', progress, {}, levels)
    progress('identifying', 0.0)
    recording, block, coil = recording_of(excited, belief.actuator)
    found = identified(tuning, belief, recording, block, coil)
    if found.verdict != 'identified' and not (tuning.accept and found.acceptable):
        return Tuned(before, found)
    progress('comparing shapers', 0.0)
    now = datetime.now().astimezone()
    shapers, settings = chosen(tuning, belief, found)
    shaper = settings['shaper']
    write_text(tuning.out, file_text(
        found, replace(belief, settings={**belief.settings, 'shaper': shaper}), str(excited.path),
        now))
    if tuning.node is None:
        _apply(tuning, settings)
    after = _run(tuning, 'after', progress, settings)
    return Tuned(before, found, tuple(shapers), shaper, tuning.out, Part.of(after))


def known_to(namespace: str) -> Entries:
    """
    Return the parameters of the running planner's only actuator, as in a parameter file.

    Raises
    ------
    BadInputError
        If it has several actuators.
    HmsaError
        If there is no planner.

    """
    from hmsa_ros.clients.remote import RemoteNode

    with RemoteNode(PLANNER, namespace) as planner:
        values = planner.get()
    if len(values['joints']) > 1:
        raise BadInputError(
            f'the planner has the joints {", ".join(values["joints"])}: expected one; tune each '
            'with a planner of its own')
    return [(PLANNER, x, y) for x, y in _of_planner(values).items() if y is not None]


def _of_planner(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the planner's parameters of an actuator among those of a file."""
    from hmsa_ros.nodes.planning import OWN

    own = {x.name for x in OWN}
    return {x: y for x, y in settings.items() if x in own}


def _run(
        tuning: Tuning, name: str, progress: ExperimentProgress, settings: Mapping[str, Any],
        levels: Sequence[tuple[float, float]] = ()) -> Run:
    """Run setpoints, or levels, with settings of the planner if it is started here."""
    parameters = {f'{PLANNER}:{x}': y for x, y in _of_planner(settings).items()}
    experiment = Experiment(
        tuning.folder / name, () if levels else tuning.setpoints,
        () if tuning.node is None else (
            replace(tuning.node, parameters={**tuning.node.parameters, **parameters}),),
        tuning.namespace, levels=levels)
    prepare(experiment.folder)
    done = conduct(experiment, lambda text, share: progress(f'{name}: {text}', share))
    if not done.measured:
        raise HmsaError(
            'no node publishes joint_states: expected a plant, or a driver with a sensor')
    # An unknown actuator that does not come to rest as predicted is not a failure.
    if levels and done.verdict.failure and not done.verdict.measured:
        raise HmsaError(f'the excitation failed: {done.verdict.failure}')
    return replace(read_run(experiment.bag), label=name)


def excitation(tuning: Tuning, belief: Belief, rate: float) -> list[tuple[float, float]]:
    """Return the levels to record, time in s and T, for a sensor rate in Hz."""
    rest = belief.actuator.rest
    stretches = [rest, *(x[0] for x, _ in tuning.setpoints)]
    beyond = _BEYOND * (max(stretches) - min(stretches))
    found = excite(
        belief.actuator, Bounds.of(
            belief,
            min(stretches) - beyond if tuning.stretch_min is None else tuning.stretch_min,
            max(stretches) + beyond if tuning.stretch_max is None else tuning.stretch_max),
        duration=tuning.duration, rate=rate,
        free=free_of(tuning.free, belief.actuator.law, tuning.known)).best
    return list(zip(found.level_times.tolist(), found.levels.tolist(), strict=True))


def identified(
        tuning: Tuning, belief: Belief, recording: Measurement, block: ActuatorParameters,
        coil: Mapping[str, float]) -> Identification:
    """Identify, with parameters indicated by the residuals added (see `recording_of`)."""
    known = {**coil, **belief.others, **tuning.known}

    def fit(free: tuple[str, ...]) -> Identification:
        return identify(
            recording, free=free, actuator=block, known={
                x: y for x, y in known.items() if x not in free}, uncertain=tuning.uncertain)

    free = free_of(tuning.free, block.law, tuning.known)
    found = fit(free)
    for _ in range(_MOST_TRIES):
        named = max(
            (x for x in found.signatures if x.found and x.remedy), key=lambda x: x.share,
            default=None)
        more = () if named is None else tuple(
            x for x in named.remedy.split(',') if x not in free and x not in tuning.known)
        if found.verdict == 'identified' or not more:
            break
        # Lag and latency are hard to distinguish, so each is tried alone and both together.
        ways = [more, *([*((x,) for x in _DELAYS if x not in (*more, *free, *tuning.known)),
                         tuple(x for x in _DELAYS if x not in (*free, *tuning.known))]
                        if set(more) & set(_DELAYS) else [])]
        tried = [(x, fit((*free, *x))) for x in dict.fromkeys(ways)]
        added, found = next(
            (x for x in tried if x[1].verdict == 'identified'),
            min(tried, key=lambda x: x[1].residual_rms))
        free = (*free, *added)
    if found.verdict == 'not_identifiable' and not tuning.free:
        # Moves hardly affected by J_lim can be planned with its given value.
        without = tuple(x for x in free if x != 'chain_limit')
        found = min(
            found, fit(without), key=lambda x: (x.verdict != 'identified', not x.acceptable))
    return found


def chosen(
        tuning: Tuning, belief: Belief, found: Identification
) -> tuple[list[Expected], dict[str, Any]]:
    """Return the comparison of the shapers, and the planner's settings after identification."""
    learnt = belief_in(file_text(found, belief, '', datetime.now().astimezone()))
    shapers = compare_shapers(
        Actuator.from_parameters(learnt.settings),
        [(x[0], span) for x, span in tuning.setpoints], learnt.known)
    # Defects of an accepted model, such as hysteresis, affect a smooth move least.
    smooth = [x for x in shapers if x.shaper == 'smooth' and not x.reason
              and found.verdict != 'identified']
    return shapers, {**learnt.settings, 'shaper': choose(smooth or shapers, _QUIET).shaper}


def _apply(tuning: Tuning, settings: Mapping[str, Any]) -> None:
    """Set the identified parameters on the running planner."""
    from hmsa_ros.clients.remote import RemoteNode

    with RemoteNode(PLANNER, tuning.namespace) as planner:
        before = planner.get()
        changed = {x: y for x, y in settings.items() if x in before and before[x] != y
                   and not x.startswith(PREFIX)}
        try:
            # Set together, since each viscoelastic branch has a ratio and a time.
            planner.set_all({x: y if isinstance(y, str) else yaml_text(y)
                             for x, y in changed.items()})
        except BadInputError as error:
            raise HmsaError(
                f'{tuning.out} is written, but the running planner rejects it ({error}): '
                f'start it again with --params-file {tuning.out}, then hmsa run') from error
