"""One joint under feedback: its estimate, and how plans use it."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, InitVar, replace
from functools import partial
import math
from typing import Any

from hmsa.errors import HmsaError
from hmsa.identification.quantities import coordinates, Known, TEMPERATURE, THERMAL
from hmsa.judge.records import SensorModel
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.model.equations import equilibrium_stretch
from hmsa.model.units import flux_text, NANOSECONDS
from hmsa.offload import Awaited, Doing
from hmsa.planning.lateness import LEAST_STEP
from hmsa.planning.planner import Believed, Planner
from hmsa.planning.timeline import JointModel, PlannedSegment, Timeline
from hmsa_lab.adapt.estimator import Estimator, EstimatorOptions, StateEstimate
from hmsa_lab.adapt.expected_error import clearly_better
from hmsa_lab.adapt.learnt import (
    as_of_path,
    differs,
    initial_state,
    learnt_model,
    same_parameters,
    sensor_of,
)
from hmsa_lab.adapt.messages import differences, sentence
from hmsa_lab.adapt.motion import held, rest
from hmsa_lab.adapt.prior import Prior
from hmsa_lab.adapt.trust import Trust
from hmsa_ros.runtime.records import Settings

# Earlier levels that still affect the samples: the field of a coil with lag depends on them.
_BEFORE = 8
# Fraction of the time scale by which a sample may be ahead of the clock, since clocks differ.
_AHEAD = 0.1
# Time scales ahead from which the predicted state is that at rest.
_FAR = 100.0
# Intervals between updates: at most these ns and this many time scales while a joint moves, and
# these ns while it rests.
_UPDATE, _OFTEN, RESTING = 20_000_000, 0.45, 200_000_000
# Factor of the interval while a joint rings, and the time scales after its last change of level
# from which it rings, and from which it rests.
_SELDOM, _RINGING, _QUIET = 4, 3.0, 24.0
# Samples used per natural period, of a joint among many, and the factor by which there are fewer
# at rest; number that may follow each other faster after a pause while no estimate is in use:
# only together those of a buffer with timestamps of their arrival show that these are wrong.
_DENSE, _CROWDED, _SPARSE, _BURST = 40, 16, 10, 10
# Time scales between two choices of the parameters to plan with.
_CHOICE = 3.0
# Time scales after an arrival that show whether it succeeded.
_LOOK = 3.0
# Tolerance of the measured field: this fraction of its value or of the unit of load, and this many
# time scales and coil time constants, after a change or in all. A field that is measured some ms
# before or after the stretch differs for that long at each change of level.
_OFF, _LEAST, _FOLLOWED = 0.05, 0.01, 3.0
# Log odds from which the sensor counts as changed, and part of the possible log odds against a
# change from which it counts as before; a drift of 1e-2 a second reaches 0.67.
_JUMPED, _AS_BEFORE = 2.0, 0.7
# Part of the negative log probability of learnt parameters that others may have which replace
# them: a remanence 8 % in error leaves 0.56 of it once the gain of the sensor falls by 2 %.
_NEARER = 0.5
# Smallest deviation, relative to the noise, to which the samples of a move show a bias beside a
# modulus that jumps: with 0, test_feedback_trust.py has 0.56 of the odds for one, with 0.3 0.77.
_SHOWS = 0.3
# Number of samples kept to be explained anew.
_KEPT = 600
# Difference in K of an estimated temperature that plans follow; 2e-4 of a level.
_WARMER = 0.05
# Fraction by which the report of an applied level may be rounded.
_ROUNDED = 0.01
# Natural period, in time scales, of a block of H/L = 1; slower ones need more time to be seen.
_PERIOD = 2.565


@dataclass(eq=False)
class AdaptiveJoint:
    """State of one joint under feedback; times in ns."""

    name: str
    planner: Planner
    given: JointModel
    settings: Settings
    begun: InitVar[int]
    crowded: bool  # whether it is one of many joints
    prior: Prior = field(init=False)  # of the given parameters
    estimator: Estimator = field(init=False)
    trust: Trust = field(init=False)
    latest: StateEstimate | None = None
    newest: int = 0  # time of the newest sample
    next_sample: int = 0  # time from which another sample is useful
    next_update: int = 0  # time of the next update
    not_before: int = 0  # earliest time of an update, which limits the CPU time
    next_report: int = 0  # when to publish the estimate
    next_choice: int = 0  # when to choose the parameters to plan with
    used: JointModel | None = None  # chosen model; None for that of the planner
    choosing: Iterator[None] | None = None  # the choice under way
    chosen: bool = False  # whether a choice was made since the latest estimate
    waits: int = 0  # arrival of a move slowed down to be corrected
    next_path: int = 0  # when to check a path again
    planning: int = 0  # how long planning a path took
    amplitude: float = 0.0  # largest vibration since the last arrival
    fresh: bool = False  # whether there are unprocessed samples
    stamped_ahead: bool = False  # whether the timestamp of the last one is ahead of the clock
    looking: Iterator[None] | None = None  # the update under way
    spent: int = 0  # time spent on the update
    audits: list[SetpointSamples] = field(
        default_factory=list)  # setpoints to be audited after an update
    ready: int = 0  # number of audits to do now
    auditing: Iterator[None] | None = None  # the audit under way
    lost: str = ''  # why the field is not as commanded; empty if it is
    largest: float = math.inf  # level in T at which the amplifier saturated
    _took_effect: tuple[int, int] = 0, 0  # timestamps of the last two applied levels
    news: bool = False  # whether the latest estimate awaits comparison with the plan
    # Samples that arrived during an update: timestamp, stretch, and time of arrival.
    _waiting: list[tuple[int, float, int]] = field(default_factory=list)
    # Samples in use, by arrival: timestamp and stretch.
    _kept: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    _fitted: int = 0  # time of the newest sample of the last update that fitted
    _since: int = 0  # timestamp from which samples are explained
    _anew: bool = False  # whether samples that have arrived before are explained anew
    # Explanations of these samples that have been tried: whether the sensor has changed.
    _tried: set[bool] = field(default_factory=set)
    _sensor: tuple[StateEstimate, SensorModel] | None = None  # estimate, and its sensor
    _measured: bool = False  # whether the field is measured
    _thermometer: float = field(init=False)  # the newest measured temperature in use
    differs_since: int | None = None  # timestamp since which the field differs; None if not
    sensor_changed: bool = False  # whether the estimator allows for any bias and gain
    reverts: bool = False  # whether the plan is to be reverted to the given parameters
    _bias: tuple[float, float] = 0.0, 0.0  # of the sensor as confirmed, and its deviation
    mismatch: int = 0  # longest time in ns for which it differed, and then not any more

    def __post_init__(self, begun: int) -> None:
        given, settings = self.given, self.settings
        self.prior = self._as_identified(given)
        self._thermometer = self.prior.values[TEMPERATURE]
        place = self.prior.free.index('stretch_bias') if 'stretch_bias' in self.prior.free else -1
        self._bias = self.prior.values['stretch_bias'], math.sqrt(
            self.prior.covariance[place, place]) if place >= 0 else 0.0
        self.estimator = Estimator(self.prior, EstimatorOptions(
            slew_limit=given.options.slew_limit, learn=not settings.feedback_frozen))
        self.trust = Trust(begun)

    @property
    def _known(self) -> Known:
        return self.settings.known.get(self.name, Known())

    def _as_identified(self, model: JointModel) -> Prior:
        """Return the prior of a model and a sensor as given."""
        return self._as_warm(Prior.nominal(
            model.actuator, self.settings.feedback_parameters, suspects=True,
            others=model.others).informed(self._known))

    def _as_warm(self, prior: Prior) -> Prior:
        """Return a prior at the temperature that plans take."""
        warmth = self.planner.warmth
        return prior if warmth is None else prior.at_temperature(warmth.temperature)

    @property
    def unit(self) -> float:
        """Given time scale in s."""
        return float(self.prior.values['time_unit'])

    @property
    def _pace(self) -> float:
        """Given time scale in s, or more for an actuator whose natural period is longer."""
        given = self.given
        return self.unit * max(
            1.0, 2.0 * math.pi / given.frequency(given.actuator.rest) / _PERIOD)

    @property
    def adapts(self) -> bool:
        """Whether plans use the estimate."""
        return self.settings.adapts

    @property
    def tolerance(self) -> float:
        """Predicted error, as a fraction of the step, up to which a move is not slowed down."""
        return self.settings.feedback_tolerance if self.settings.cautious else math.inf

    @property
    def fitting(self) -> StateEstimate | None:
        """The latest estimate if a whole move has shown that it fits."""
        latest = self.latest
        return latest if latest is not None and latest.trusted and self.trust.acts else None

    @property
    def acting(self) -> StateEstimate | None:
        """The fitting estimate if it is to be used: not that of a sensor that has changed."""
        return None if self.sensor_changed else self.fitting

    @property
    def doubted(self) -> bool:
        """Whether samples may be wrong, so that plans begin from the prediction."""
        return self.adapts and not self.lost and bool(self.trust.why or self.sensor_changed)

    # -- samples -------------------------------------------------------------------------------

    @property
    def next_look(self) -> int:
        """Time in ns of the next update; only `not_before` delays it while audits wait."""
        return max(self.not_before, 0 if self.audits else self.next_update)

    @property
    def interval(self) -> int:
        """Time in ns from one update to the next."""
        if self._still(_QUIET * self.given.units.time) and not self.trust.doubts:
            return RESTING
        return min(_UPDATE, round(_OFTEN * self.unit * NANOSECONDS)) * (
            _SELDOM if self._still(_RINGING * self.unit) else 1)

    def _still(self, span: float) -> bool:
        """Return whether no level has changed for a duration in s."""
        last = self.planner.plan.levels[-1].stamp
        return self.newest > last + round(span * NANOSECONDS)

    def wants(self, stamp: int) -> bool:
        """Return whether a timestamp is far enough from the previous sample's."""
        return not self.newest <= stamp < self.next_sample

    def add(self, stamp: int, stretch: float, flux_density: float, now: int) -> None:
        """
        Add stretch and field in T measured at a timestamp, which arrive at a time.

        Samples may arrive in any order.
        """
        if not self.wants(stamp):
            return
        lost = self.lost = self._off(stamp, flux_density)
        if lost and self.trust.why != lost and self.trust.doubt(lost, now, at_once=True):
            # The estimate is discarded, and the update under way ends.
            self._restart(stamp + 1)
            self.latest, self.news = None, True
            self.looked()
        sample = stamp, math.nan if lost else stretch, now
        self.fresh, self.stamped_ahead = True, self._is_ahead(stamp, now)
        if not self.stamped_ahead:
            self.newest = max(self.newest, min(stamp, now))
        if self.looking is None:
            self._take(*sample)
        else:
            self._waiting.append(sample)
        cell = round(self.given.units.time * NANOSECONDS) * 2 // (
            _CROWDED if self.crowded else _DENSE)
        rests = self.latest and self._still(_QUIET * self.given.units.time)
        cell *= _SPARSE if rests else 1
        burst = 0 if self.trust.acts else _BURST * cell
        self.next_sample = min(max(self.next_sample, self.newest - burst), self.newest) + cell

    def _is_ahead(self, stamp: int, now: int) -> bool:
        return stamp > now + _AHEAD * self.unit * NANOSECONDS

    def _take(self, stamp: int, stretch: float, now: int) -> None:
        if self._is_ahead(stamp, now):
            self.estimator.screening.refuse_ahead((stamp - now) / NANOSECONDS)
        elif self.estimator.sample(stamp, stretch):
            self._kept.append((stamp, stretch))

    def applied(self, stamp: int, flux_density: float) -> None:
        """Record that a level in T has taken effect, before the plan does."""
        self._took_effect = self._took_effect[1], stamp
        plan = self.planner.plan
        place = plan.place(stamp)
        wanted, *early = (x.flux_density for x in plan.levels[place:place + 2])
        if abs(flux_density) > self.largest:
            self.largest = math.inf
        # The next level, if it takes effect early, is none of an amplifier that saturated.
        if wanted and 0.0 < flux_density / wanted < 1.0 - _ROUNDED and not any(
                math.isclose(flux_density, x, rel_tol=_ROUNDED) for x in early):
            self.largest = abs(flux_density)

    def _off(self, stamp: int, field: float) -> str:
        """Return why the field differs from the commanded one for too long; empty if not."""
        plan = self.planner.plan
        level = plan.level(stamp)
        wanted, options, units = level.flux_density, level.model.options, level.model.units
        ramp = abs(wanted - level.in_force) / options.slew_limit
        follows = round(NANOSECONDS * (
            _FOLLOWED * (units.time + options.coil_time_constant) + ramp))
        known = not math.isnan(field)
        self._measured |= known
        if not plan.segments or not self._measured or stamp < level.stamp + follows and known or (
                abs(field - wanted) <= max(
                    _OFF * max(abs(field), abs(wanted)), _LEAST * units.load)):
            if self.differs_since is not None and not self.lost:
                self.mismatch = max(self.mismatch, stamp - self.differs_since)
            self.differs_since = None
            return ''
        if self.differs_since is None:
            self.differs_since = stamp
        if stamp < self.differs_since + follows:
            return self.lost
        return (
            f'the coil has {flux_text(field)} where {flux_text(wanted)} were commanded'
            if known else 'the field is no longer reported, and may differ from the command')

    # -- looks at them -------------------------------------------------------------------------

    def _take_levels(self, until: int) -> None:
        """Pass the levels of the plan that matter until a time to the estimator."""
        plan = self.planner.plan
        first = max(plan.place(self.estimator.since) - _BEFORE, 0)
        self.estimator.set_levels([
            (x.stamp, x.flux_density) for x in plan.levels[first:plan.place(until) + 1]],
            self._took_effect)

    def update(self, now: int, doing: Doing) -> Awaited[None]:
        """Update the estimate with new samples, and predict the state at a time."""
        plan = self.planner.plan
        self.fresh = False
        self._take_levels(max(now, self.newest))
        warmth = self.planner.warmth
        if warmth is not None and warmth.measured is not None:
            stamp, celsius = warmth.measured
            self.estimator.unmeasured = now - stamp > self.settings.temperature_max_age
            self.estimator.warmed(celsius - self._thermometer)
            self._thermometer = celsius
        self.estimator.actuator_may_jump = (
            self.trust.acts and self.estimator.since > self.trust.begin)
        before = self.estimator.screening.lost
        estimator, found = yield from doing(_updated, self.estimator, now)
        estimator.learning, self.estimator = self.estimator.learning, estimator
        screening, trust = estimator.screening, self.trust
        trouble = screening.trouble if found is None else found.trouble
        jumped = found is not None and not trouble and found.jumped > _JUMPED
        if jumped:
            trouble = 'samples fit better if the sensor has changed'
        if screening.lost > before and not trust.acts:
            # Later samples of the same update have fitted again.
            trouble = trouble or screening.last_trouble
        if self._anew and found is not None and found.poor:
            self._restart(self._since)
            self.latest, self.news = None, True
            return
        if found is not None and found.poor and trust.acts:
            trouble = trouble or 'samples fit worse than their noise'
        self._anew &= found is None
        acted = trust.acts or trust.ended
        if found is not None and not trouble:
            trust.fits(plan, self._pace, estimator, now, waits=now < self.waits)
        if trouble and trust.doubt(
                trouble, now, used=not self.sensor_changed, fitted=self._fitted > 0):
            if acted:
                self._tried.clear()
            # Samples that an estimate in use has fitted do not show what has changed since. Until
            # a move confirms one, a mode that the model lacks looks like a sensor that changes.
            self._restart(self._since if trust.confirmed is None else (
                found.jump if found is not None and jumped else max(
                    estimator.since, self._fitted if acted else 0)), jumped=jumped)
        elif found is not None and trust.acts and trust.failed and (
                self._look_at_sensor(found, now, anew=not acted)):
            found = None
        if not trouble:
            self._fitted = max(self._fitted, estimator.newest)
        if found is not None and not trust.why:
            self._look_at_arrival(plan, found)
        if found is not None and trust.why:
            found = replace(found, trusted=False, trouble=trust.why)
        self.latest, self.news = found, True
        trust.rang &= self.fitting is None
        if self.adapts and self.acting is not None:
            self._take_temperature(self.acting.values[TEMPERATURE], now)
        elif trust.kept is None:
            self.take_measured(now)

    def take_measured(self, now: int) -> None:
        """Plan for the temperature as measured."""
        warmth = self.planner.warmth
        if warmth is not None and warmth.offset:
            self.planner.take_temperature(warmth.temperature - warmth.offset, now, estimated=True)

    def _take_temperature(self, celsius: float, now: int) -> None:
        """Plan for an estimated temperature."""
        warmth = self.planner.foreseen(now)
        if warmth is not None and abs(celsius - warmth.temperature) > _WARMER:
            self.planner.take_temperature(celsius, now, estimated=True)

    def _restart(self, since: int, *, healthy: bool = False, jumped: bool = False) -> None:
        """
        Restart the estimator with the samples kept from a time in ns on, and another explanation.

        With parameters learnt, the first one is the actuator and the sensor as given. The second
        one is a sensor that has changed, and the actuator as moves have confirmed it. If both have
        been tried with these samples, later ones are explained. If ``healthy``, the sensor is as
        given, and the actuator as confirmed. Before, a sensor that has ``jumped`` has any bias.
        """
        model = self.trust.confirmed or self.given
        ways = [False] * (self._learnt or not self.trust.failed) + [True] * self.trust.failed
        left = [x for x in ways if x not in self._tried]
        if healthy:
            prior, self.sensor_changed = self._as_identified(model), False
        else:
            self.sensor_changed = (left or ways)[0]
            prior = self.prior if not self.sensor_changed else Prior.of_changed_sensor(
                model.actuator, self.settings.feedback_parameters, self._known,
                others=model.others, bias=self._bias)
        if jumped and self.trust.confirmed is None:
            prior = prior.with_any_bias
        self._anew = bool(left) and not healthy
        if not (healthy or left):
            self._tried.clear()
            since = self.newest + 1
        self._tried.add(self.sensor_changed)
        self._since = since
        # The level that has held the block may not have been the one commanded.
        self.estimator.restart(self._as_warm(prior), settled=not (healthy or left))
        self.trust.begin = since
        for stamp, stretch in self._kept:
            if stamp >= since:
                self.fresh |= self.estimator.sample(stamp, stretch)

    def _look_at_sensor(self, found: StateEstimate, now: int, *, anew: bool) -> bool:
        """
        Decide whether the sensor has changed, after an estimate that failed; ``anew``: it fits.

        Return whether the estimator has restarted.
        """
        trust = self.trust
        if self.sensor_changed:
            plan = self.planner.plan
            # In the middle of a move, several errors look alike.
            if found.changed > -_AS_BEFORE or (
                    plan.segments[plan.under_way(now)].path is None and not self.shown(now)):
                return False
            trust.recover(given=False)
            self._restart(self.estimator.since, healthy=True)
            return True
        learnt = self._as_identified(trust.confirmed or self.given).values
        if differences(found, learnt) and (
                not differences(found, self.prior.values)
                or self._unlikely(found.values) < _NEARER * self._unlikely(
                    {**learnt, **{x: found.values[x] for x in ('stretch_bias', *THERMAL)}})):
            # Samples need neither what was learnt nor another sensor.
            trust.recover(given=True)
            self.used = self.given
            self.reverts = not same_parameters(self.given, self.planner.base)
            self.planner.take_model(self.given)
            return False
        if anew:
            trust.wait(now)
            self._restart(self.estimator.since)
        return False

    def discard(self, now: int) -> None:
        """Explain the samples with the given actuator: as confirmed, it makes moves worse."""
        self.trust.recover(given=True)
        self.trust.wait(now)
        self._restart(self.estimator.since, healthy=True)
        self.latest = None

    def _unlikely(self, values: Mapping[str, Any]) -> float:
        """Return the negative log probability of values before any sample, up to a constant."""
        off = self.prior.departures(coordinates(values, self.prior.free))
        return 0.5 * float(off @ off)

    @property
    def _learnt(self) -> bool:
        """Whether moves have confirmed other than the given parameters."""
        confirmed = self.trust.confirmed
        return confirmed is not None and not same_parameters(confirmed, self.given)

    def _confirm(self, model: JointModel, found: StateEstimate, left: float) -> None:
        """Record the error of a move planned with a model, as a fraction of its step."""
        if self.sensor_changed:
            return
        self.trust.confirm(self.based(model), left)
        if self.acting is not None and not self.trust.failed:
            # That of confirmed parameters: what a force may hide of a bias does not count.
            place = found.free.index('stretch_bias')
            known = float(found.sure_of(self.prior.named).covariance[place, place])
            self._bias = found.values['stretch_bias'], math.hypot(
                math.sqrt(max(known, 0.0)), _SHOWS * found.noise)

    def looked(self) -> None:
        """End the update under way, and add the samples that arrived during it."""
        self.looking = None
        for sample in self._waiting:
            self._take(*sample)
        self._waiting.clear()

    def start(self, time: int) -> float:
        """Return the stretch before the setpoint that is under way at a time."""
        plan = self.planner.plan
        place = plan.under_way(time)
        return (plan.segments[place - 1] if place > 0 else plan.levels[0]).stretch

    def _look_at_arrival(self, plan: Timeline, found: StateEstimate) -> None:
        """Update the largest amplitude since the last arrival, and confirm parameters at rest."""
        place = plan.under_way(found.time)
        segment = plan.segments[place] if place >= 0 else None
        if segment is None or segment.arrival is None or found.time < segment.arrival:
            self.amplitude = 0.0
            return
        level = plan.level(found.time)
        at = held(found.values, found.stretch, level.flux_density)
        if at is None:
            return
        rings = math.hypot(found.stretch - at[0], found.rate / at[1])
        self.amplitude = max(self.amplitude, rings)
        if segment.path is None and found.time >= self.shown_from(segment) and math.isinf(
                self.largest):
            self._confirm(level.model, found, (rings + abs(at[0] - segment.stretch)) / max(
                abs(segment.stretch - self.start(found.time)), LEAST_STEP))

    # -- initial states of plans ---------------------------------------------------------------

    def predicted(self, time: int) -> StateEstimate | None:
        """Return the estimate for a time under the plan in force."""
        self._take_levels(time)
        return self.estimator.predict(time)

    def state(self, time: int) -> StateEstimate | None:
        """Return the initial state of plans at a time; None if the plan's prediction applies."""
        latest = self.acting
        if latest is None or not self.adapts or (
                time - latest.time > _FAR * latest.values['time_unit'] * NANOSECONDS):
            return None
        return self.predicted(time)

    def foreseen(self, time: int) -> StateEstimate | None:
        """Return the state for slowing down moves; a cautious joint has one before any sample."""
        return self.predicted(time) if self.latest is None else self.state(time)

    @property
    def without(self) -> JointModel:
        """The model of plans without feedback: as given, at the temperature if measured."""
        warmth = self.planner.warmth
        return self.given if warmth is None or warmth.measured is None else (
            self.given.at_temperature(warmth.measured[1]))

    def based(self, model: JointModel) -> JointModel:
        """Return a model of the plan at the reference of the given temperature coefficients."""
        return model.at_temperature(self.given.temperature)

    def adapted(self, model: JointModel | None = None) -> bool:
        """Return whether a model, by default that of the plans, uses learnt parameters."""
        return (model or self.planner.base) != self.given

    def initial_state(self, time: int) -> Believed | None:
        """Return the state for `hmsa.planning.planner.Planner` to plan from at a time."""
        try:
            found = self.state(time) if self.adapted() else None
        except HmsaError:
            return None
        if found is None:
            return self.planner.as_held(time)
        # Effects missing in the model shift its equilibrium: a plan uses the stretches of its
        # model.
        level, model = self.planner.plan.levels[-1].flux_density, self.planner.model
        at = rest(found.values, (), level)
        if at is None:
            return None
        shift = float(equilibrium_stretch(model.load(level), model.material)) - at[0]
        return initial_state(found, model, shift)

    @property
    def sensor(self) -> SensorModel:
        """The sensor as estimated; as given where there is no estimate."""
        found = self.fitting
        if found is None:
            return SensorModel()
        if self._sensor is None or self._sensor[0] is not found:
            self._sensor = found, sensor_of(found, self.estimator.prior)
        return self._sensor[1]

    # -- models of plans -----------------------------------------------------------------------

    def learnt(self, model: JointModel) -> JointModel:
        """Return a model updated by the estimate, or by the last confirmed parameters."""
        if self.acting is not None:
            return learnt_model(model, self.acting, self.planner.plan.levels[-1].stretch)
        kept = self.trust.kept
        return model if kept is None else JointModel(
            kept.actuator, replace(model.options, **kept.others))

    def may_choose(self, latest: StateEstimate) -> bool:
        """Return whether an estimate may be used to choose the parameters to plan with."""
        # A plan with changed parameters begins from an unknown state, so moves are not
        # interrupted.
        return not self.chosen and bool(self.planner.plan.segments) and (
            latest.time < self.waits or self._actuator_jumps(self._segment(latest.time))
            or latest.time >= self.next_choice and self.shown(latest.time))

    def shown(self, time: int) -> bool:
        """Return whether samples until a time show how the joint has arrived."""
        segment = self._segment(time)
        return segment is not None and (
            time >= self.shown_from(segment) or self._actuator_jumps(segment))

    def _segment(self, time: int) -> PlannedSegment | None:
        """Return the setpoint that a change of levels at a time would affect."""
        plan = self.planner.plan
        place = plan.under_way(self.planner.soonest(time))
        return plan.segments[place] if place >= 0 else None

    def _actuator_jumps(self, segment: PlannedSegment | None) -> bool:
        """Return whether the actuator has jumped since a setpoint that is no path began."""
        return segment is not None and segment.path is None and (
            self.estimator.actuator_jump > segment.since)

    def shown_from(self, segment: PlannedSegment) -> int:
        """Return the time from which samples show how the joint has arrived at a setpoint."""
        return (segment.arrival or 0) + round(_LOOK * self.unit * NANOSECONDS)

    def choose(self, latest: StateEstimate, doing: Doing) -> Awaited[None]:
        """Adopt learnt parameters once clearly better, or while a move waits for them."""
        used, segments = self.used or self.planner.base, self.planner.plan.segments
        model, waits = used, latest.time < self.waits
        if differs(used, latest):
            learnt = self.learnt(used)
            if segments[-1].path is not None:
                learnt = as_of_path(learnt, used, latest)
            # Parameters as given are no longer after a jump.
            better = partial(clearly_better, given=used == self.given and not (
                self.estimator.actuator_jump), shown=not waits)
            if (yield from doing(
                    better, latest, learnt, used, self.start(latest.time),
                    segments[-1].stretch)):
                model = learnt
        if self.acting is None:
            return
        if not waits:
            self.next_choice = latest.time + round(_CHOICE * self.unit * NANOSECONDS)
            self.used = model
        self.planner.take_model(model)

    # -- words ---------------------------------------------------------------------------------

    def words(self, now: int) -> str:
        """Return the problem at a time, in a sentence without full stop."""
        trust = self.trust
        why = trust.why or self.estimator.screening.trouble or (
            '' if self.latest is None else self.latest.trouble)
        if trust.ended:
            return (f'{why}: feedback has ended, open loop with {trust.parameters}; '
                    '~/reset_estimate restarts it')
        if why:
            more = f', with {trust.parameters}' if self.adapts else ''
            restart = ('; the estimate has restarted and is used after a move that samples fit; '
                       '~/reset_estimate discards it') if trust.beginnings else ''
            return f'{why}: open loop until samples fit again{more}{restart}'
        if self.latest is None:
            return 'no estimate yet'
        plan = self.planner.plan
        place = plan.under_way(now)
        start = self.start(now)
        target = plan.segments[place].stretch if place >= 0 else start
        use = 'plans do not use it' if self.sensor_changed else (
            'plans use it' if trust.acts else 'plans use it after a move that samples fit')
        words = sentence(
            self.latest, self.prior.values, plan.level(now).flux_density, target,
            start, self.amplitude, use if self.adapts else '')
        return words + (
            '; the sensor has changed, according to the samples, or a constant force or the coil, '
            f'which look alike, and plans keep {trust.parameters}: check the sensor, or '
            '~/reset_estimate to take it as it is'
            if self.sensor_changed else '')

    def figures(self) -> dict[str, object]:
        """Return parameters in SI, with standard deviations and given values, and counters."""
        prior, screening = self.prior.values, self.estimator.screening
        found = self.latest
        values: dict[str, object] = {'trusted': found is not None and found.trusted}
        if found is not None:
            for key in found.free:
                values |= {
                    key: f'{found.values[key]:.9g}', f'{key}.std': f'{found.deviations[key]:.3g}',
                    f'{key}.nominal': f'{prior[key]:.9g}'}
            values |= {
                'stretch': f'{found.stretch:.9g}', 'stretch_rate': f'{found.rate:.6g}',
                'noise': f'{found.noise:.3g}'}
        return values | {
            'learning': self.estimator.learning,
            'rejected': screening.rejected, 'frozen': screening.frozen,
            'unreadable': screening.unreadable, 'repeated': screening.repeated,
            'too_late': screening.late, 'ahead_of_clock': screening.ahead,
            'field_mismatch_ms': f'{self.mismatch / 1e6:.3g}',
            'new_beginnings': self.trust.beginnings, 'ended': self.trust.ended,
            **self.sensor.to_dict()}


def _updated(estimator: Estimator, now: int) -> tuple[Estimator, StateEstimate | None]:
    """Return an estimator updated with its samples, and its estimate for a time."""
    return estimator, estimator.update(now)
