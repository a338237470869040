"""Feedback: what samples say of the actuators, and models that are learnt from them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
import math

from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.core.planner import Planner
from hmsa_ros.core.simulation import check_stretch
from hmsa_ros.core.timeline import Model, Plan
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.estimation import Estimate, Estimator, Options, Prior
from hmsa_ros.estimation.estimator import warm_up
from hmsa_ros.estimation.motion import rest
from hmsa_ros.estimation.words import differences, sentence
from hmsa_ros.runtime.records import EstimateChanged, Output, Settings, Severity
from hmsa_ros.runtime.slices import Clock

#: What the parameter `feedback` can be.
MODES = ('off', 'observe', 'adapt')
# How often samples are taken into account while a joint moves and while it rests, and how often
# the estimate is told, in ns.
_UPDATE, _RESTING, _TELL = 20_000_000, 200_000_000, 200_000_000
# Samples of a natural period that are looked at, and how many fewer at rest.
_DENSE, _SPARSE = 40, 10
# Periods after the last change of level from which on a joint rests.
_QUIET = 12.0
# A model is another one from this share of a parameter, and this many of its deviations, on.
_NEWS, _SURE = 1e-3, 2.0
# States further ahead than so many units of time are those of rest.
_AHEAD = 100.0


@dataclass(eq=False)
class _Joint:
    """What is known of one joint."""

    estimator: Estimator
    latest: Estimate | None = None
    newest: int = 0
    next_update: int = 0
    next_tell: int = 0
    amplitude: float = 0.0
    # Number of the plan and place of the setpoint under way, and the stretch before it.
    setpoint: tuple[int, int] = (0, -1)
    start: float = 1.0
    fresh: bool = False
    # Whether the latest estimate has not been held against the plan yet.
    news: bool = False


class Feedback:
    """
    Estimates from samples, reports what is wrong, and learns what to plan with.

    Parameters
    ----------
    group : PlannerGroup
        The joints.
    settings : Settings
        Mode, and what is estimated.
    outputs : list of Output
        Where estimates are appended.
    clock : callable
        Returns the present time in ns.

    Attributes
    ----------
    corrections : int
        Plans that were corrected.

    """

    def __init__(
            self, group: PlannerGroup, settings: Settings, outputs: list[Output],
            clock: Clock) -> None:
        """Begin with nothing seen."""
        self._group, self._outputs, self._clock = group, outputs, clock
        self._settings = settings
        self._joints: dict[str, _Joint] = {}
        self._nominal: dict[str, Model] = {}
        self.corrections = 0
        self.restart()

    # -- settings ------------------------------------------------------------------------------

    @property
    def mode(self) -> str:
        """One of `MODES`."""
        return self._settings.feedback

    @property
    def on(self) -> bool:
        """Whether samples count."""
        return self.mode != 'off'

    def restart(self) -> None:
        """Forget what was learnt: plan with what is given, from what is predicted."""
        for name, planner in self._group.planners.items():
            if name in self._nominal:
                planner.take_model(self._nominal[name])
            self._nominal[name] = planner.model
            planner.believed = partial(self._believed, name)
        self._joints = {}
        if self.on:
            warm_up()
            self._joints = {
                name: _Joint(Estimator(self._prior(model), Options(
                    slew_limit=model.options.slew_limit)))
                for name, model in self._nominal.items()}

    def change(self, settings: Settings, models: Mapping[str, Model]) -> Mapping[str, Model]:
        """
        Take other settings.

        Parameters
        ----------
        settings : Settings
            From now on.
        models : mapping of str to Model
            As given, by joint.

        Returns
        -------
        mapping of str to Model
            To plan with: with what was learnt, as long as block and coil are given as before.

        """
        same = (settings.feedback, settings.feedback_parameters) == (
            self.mode, self._settings.feedback_parameters) and all(
                model.actuator == self._nominal[name].actuator
                and model.options.coil_time_constant
                == self._nominal[name].options.coil_time_constant
                for name, model in models.items())
        self._settings = settings
        self._nominal.update(models)
        if not same:
            self.restart()
            return models
        if self.mode != 'adapt':
            return models
        return {name: self._learnt(name, model) for name, model in models.items()}

    def _prior(self, model: Model) -> Prior:
        return Prior.nominal(model.actuator, self._settings.feedback_parameters, others={
            'coil_time_constant': model.options.coil_time_constant})

    def _learnt(self, name: str, model: Model) -> Model:
        """Return a model with what is known better by now."""
        estimate = self._joints[name].latest
        if estimate is None or not estimate.trusted:
            return model
        try:
            learnt = Model(estimate.actuator, replace(
                model.options, coil_time_constant=estimate.values['coil_time_constant']))
            check_stretch(
                self._group.planners[name].plan.levels[-1].stretch, learnt.material, 'stretch')
        except BadInputError:
            return model
        return learnt

    # -- in ------------------------------------------------------------------------------------

    def looks_at(self, stamp: int) -> bool:
        """Return whether a sample with a stamp in ns is of use."""
        return any(
            not joint.newest <= stamp < joint.newest + self._cell(name, joint)
            for name, joint in self._joints.items())

    def _cell(self, name: str, joint: _Joint) -> int:
        """Return how far apart in ns samples are to be."""
        cell = round(self._nominal[name].units.time * NANOSECONDS) * 2 // _DENSE
        return cell * _SPARSE if self._quiet(name, joint) else cell

    def _quiet(self, name: str, joint: _Joint) -> bool:
        planner = self._group.planners[name]
        last = planner.plan.levels[-1].stamp
        span = round(2.0 * _QUIET * self._nominal[name].units.time * NANOSECONDS)
        return joint.newest > last + span

    def add(self, name: str, stamp: int, stretch: float) -> None:
        """Take in a stretch measured at a stamp in ns; samples may come in any order."""
        joint = self._joints.get(name)
        if joint is None:
            return
        joint.estimator.sample(stamp, stretch)
        joint.newest = max(joint.newest, min(stamp, self._clock()))
        joint.fresh = True

    # -- out -----------------------------------------------------------------------------------

    @property
    def wake(self) -> int | None:
        """Time in ns at which to look at samples next; None for never."""
        return min((x.next_update for x in self._joints.values() if x.fresh), default=None)

    def update(self, now: int) -> None:
        """Take samples into account that have come by a time in ns, and tell what they say."""
        for name, joint in self._joints.items():
            if not joint.fresh or now < joint.next_update:
                continue
            joint.fresh = False
            joint.next_update = now + (_RESTING if self._quiet(name, joint) else _UPDATE)
            planner = self._group.planners[name]
            joint.estimator.set_levels([(x.stamp, x.flux_density) for x in planner.plan.levels])
            found = joint.estimator.update(now)
            self._note_start(planner.plan, joint, now)
            joint.latest, joint.news = found, True
            if found is not None:
                self._look_at_vibration(planner.plan, joint, found)
            if found is not None and now >= joint.next_tell:
                joint.next_tell = now + _TELL
                self._tell(name, joint, found, now)

    def _tell(self, name: str, joint: _Joint, found: Estimate, now: int) -> None:
        words = self.words(name, now)
        prior = joint.estimator.prior.values
        values: dict[str, object] = {'mode': self.mode, 'trusted': found.trusted}
        for key in found.free:
            values |= {
                key: f'{found.values[key]:.9g}', f'{key}.std': f'{found.deviations[key]:.3g}',
                f'{key}.nominal': f'{prior[key]:.9g}'}
        screening = joint.estimator.screening
        values |= {
            'used_by_plans': self.mode == 'adapt' and found.trusted,
            'stretch': f'{found.stretch:.9g}', 'stretch_rate': f'{found.rate:.6g}',
            'noise': f'{found.noise:.3g}', 'corrections': self.corrections,
            'rejected': screening.rejected, 'frozen': screening.frozen,
            'unreadable': screening.unreadable, 'repeated': screening.repeated,
            'too_late': screening.late}
        bad = not found.trusted or (
            self.mode == 'observe' and bool(differences(found, prior)))
        self._outputs.append(EstimateChanged(
            now, name, Severity.WARN if bad else Severity.OK, words, values))

    def _note_start(self, plan: Plan, joint: _Joint, now: int) -> None:
        """Remember where a joint was before the setpoint under way."""
        place = plan.under_way(now)
        if (plan.number, place) == joint.setpoint:
            return
        again = plan.number == joint.setpoint[0] and place > joint.setpoint[1] >= 0
        joint.setpoint = plan.number, place
        if again:
            joint.start = plan.segments[place - 1].stretch
        else:
            joint.start = plan.levels[0].stretch if joint.latest is None else joint.latest.stretch

    def _look_at_vibration(self, plan: Plan, joint: _Joint, found: Estimate) -> None:
        """Keep the largest amplitude since the last arrival."""
        place = plan.under_way(found.time)
        segment = plan.segments[place] if place >= 0 else None
        if segment is None or segment.arrival is None or found.time < segment.arrival:
            joint.amplitude = 0.0
            return
        at = rest(found.values, (), plan.level(found.time).flux_density)
        if at is not None:
            joint.amplitude = max(joint.amplitude, math.hypot(
                found.stretch - at[0], found.rate / at[1]))

    def words(self, name: str, now: int) -> str:
        """Say in a sentence without its stop what is wrong with a joint at a time in ns."""
        joint, planner = self._joints[name], self._group.planners[name]
        found = joint.latest
        if found is None:
            return 'no estimate yet'
        plan, place = planner.plan, planner.plan.under_way(now)
        target = plan.segments[place].stretch if place >= 0 else joint.start
        return sentence(
            found, joint.estimator.prior.values, plan.level(now).flux_density, target, joint.start,
            joint.amplitude, adapting=self.mode == 'adapt')

    # -- for plans -----------------------------------------------------------------------------

    def _believed(self, name: str, time: int) -> tuple[float, float] | None:
        """Return stretch and rate in 1/s at a time in ns; None for what is predicted."""
        try:
            found = self.state(name, time)
        except HmsaError:
            return None
        return None if found is None else (found.stretch, found.rate)

    def state(self, name: str, time: int) -> Estimate | None:
        """
        Return what plans may begin from.

        Parameters
        ----------
        name : str
            Of the joint.
        time : int
            In ns.

        Returns
        -------
        Estimate or None
            None where predictions count.

        """
        joint = self._joints.get(name)
        if joint is None or self.mode != 'adapt' or joint.latest is None:
            return None
        latest = joint.latest
        if not latest.trusted or time - latest.time > (
                _AHEAD * latest.values['time_unit'] * NANOSECONDS):
            return None
        return joint.estimator.predict(time)

    def news(self) -> Iterator[tuple[str, Planner]]:
        """
        Learn from the latest estimates.

        Yields
        ------
        str
            Joint whose estimate is trusted, and has not been held against the plan yet.
        Planner
            Of that joint; it plans with what was learnt from now on.

        """
        if self.mode != 'adapt':
            return
        for name, joint in self._joints.items():
            if joint.news and joint.latest is not None and joint.latest.trusted:
                joint.news = False
                planner = self._group.planners[name]
                self._learn(name, joint.latest, planner)
                yield name, planner

    def _learn(self, name: str, estimate: Estimate, planner: Planner) -> None:
        """Plan with another model where it is known to be another."""
        before = planner.model.actuator
        for key in estimate.free:
            value = estimate.values[key]
            known = planner.model.options.coil_time_constant if key == 'coil_time_constant' \
                else getattr(before, key, value)
            if abs(value - known) > max(_NEWS * abs(value), _SURE * estimate.deviations[key]):
                planner.take_model(self._learnt(name, planner.model))
                return
