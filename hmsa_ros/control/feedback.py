"""Feedback: what samples say of the actuators, and models that are learnt from them."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
import math
from typing import Any

from hmsa_ros.control.aside import ANSWER, Awaited, Doing, goes_on, here
from hmsa_ros.control.choice import clearly_better
from hmsa_ros.control.field import Field
from hmsa_ros.control.holds import Hold
from hmsa_ros.control.learnt import alike, as_of_path, believed, differs, learnt_model, save
from hmsa_ros.control.ledger import Ledger, Moves
from hmsa_ros.control.records import EstimateChanged, Output, Settings, Severity
from hmsa_ros.control.sensing import sensor_of
from hmsa_ros.control.slices import Clock
from hmsa_ros.control.tracked import Joint
from hmsa_ros.control.trust import Trust
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.estimation import Estimate, Estimator, Options, Prior
from hmsa_ros.estimation.motion import rest
from hmsa_ros.estimation.words import differences
from hmsa_ros.identification.known import Known
from hmsa_ros.judge.records import Sensor
from hmsa_ros.model.equations import equilibrium_stretch
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.group import PlannerGroup
from hmsa_ros.planning.planner import Believed, Planner
from hmsa_ros.planning.timeline import Model

#: What the parameter `feedback` can be.
MODES = ('off', 'observe', 'adapt')
# How often samples are taken into account while a joint moves, at least and in units of its time,
# and while it rests, and how often the estimate is told, in ns.
_UPDATE, _OFTEN, _RESTING, _TELL = 20_000_000, 0.45, 200_000_000, 200_000_000
# Units of time from one choice of the parameters to plan with to the next.
_CHOICE = 3.0
# Units of time after an arrival that show it.
_LOOK = 3.0
# How many times as seldom where a joint rings after its last change of level.
_RINGING = 4
# How many times as long as a look or a correction took, and as there are joints, the next look is
# later at least.
_IDLE = 6
# How many times as seldom at most where looks have kept commands waiting, and how it becomes less
# with each look.
_SELDOM, _OFTENER = 32.0, 0.8
# Samples of a natural period that are looked at, and how many fewer at rest.
_DENSE, _SPARSE = 40, 10
# Periods after the last change of level from which on a joint rests.
_QUIET = 12.0
# States further ahead than so many units of time are those of rest.
_AHEAD = 100.0


class Feedback:
    """Estimates from samples, reports what is wrong, and learns what to plan with."""

    def __init__(
            self, group: PlannerGroup, settings: Settings, outputs: list[Output],
            clock: Clock) -> None:
        self._group, self._outputs, self._clock = group, outputs, clock
        #: Called with a sentence that says why feedback of a joint has ended.
        self.tell_ended: Callable[[str], None] = lambda words: None
        #: Does what takes long.
        self.doing: Doing = here
        self._settings = settings
        self._joints: dict[str, Joint] = {}
        self._nominal: dict[str, Model] = {}
        self.corrections = 0  # plans that were corrected
        self._seldom = 1.0  # how many times as seldom samples are looked at
        self._ended: list[str] = []  # joints whose plans are to be taken back
        self.restart()

    @property
    def mode(self) -> str:
        """One of `MODES`."""
        return self._settings.feedback

    @property
    def on(self) -> bool:
        """Whether samples count."""
        return self.mode != 'off'

    def do(self, *work: Any) -> Awaited[Any]:
        """Do work as what takes long is done, where samples count."""
        return (self.doing if self.on else here)(*work)

    def restart(self) -> None:
        """Forget what was learnt: plan with what is given, from what is predicted."""
        for name, planner in self._group.planners.items():
            if name in self._nominal:
                planner.take_model(self._nominal[name])
            self._nominal[name] = planner.model
            planner.believed = partial(self._believed, name)
        self._begin()

    def _begin(self) -> None:
        """Begin with nothing seen."""
        self._joints = {}
        if self.on:
            self._joints = {
                name: Joint(
                    Estimator(self._prior(name, model), Options(
                        slew_limit=model.options.slew_limit,
                        learn=not self._settings.feedback_frozen)),
                    Trust(self._clock(), at_once=self._settings.feedback_cautious), Field(),
                    Ledger(), model.actuator.rest)
                for name, model in self._nominal.items()}

    def change(self, settings: Settings, models: Mapping[str, Model]) -> Mapping[str, Model]:
        """
        Take other settings and models as given; return the models to plan with.

        What was learnt stays in them, as long as block and coil are given as before.
        """
        same = settings.feedback_parameters == self._settings.feedback_parameters and (
            (settings.feedback == 'off') is not self.on) and all(
                model.actuator == self._nominal[name].actuator
                and model.others == self._nominal[name].others
                for name, model in models.items())
        self._settings = settings
        self._nominal.update(models)
        if not same:
            self._begin()
            return models
        for joint in self._joints.values():
            joint.estimator.learning = not settings.feedback_frozen
        if self.mode != 'adapt':
            return models
        return {name: self._learnt(name, model) for name, model in models.items()}

    def _prior(self, name: str, model: Model) -> Prior:
        return Prior.nominal(
            model.actuator, self._settings.feedback_parameters, suspects=True,
            others=model.others).informed(
                self._settings.known.get(name, Known()))

    def _learnt(self, name: str, model: Model) -> Model:
        """Return a model with what is known better by now, or was when samples fitted last."""
        joint = self._joints[name]
        if joint.acts and joint.latest is not None:
            return learnt_model(
                model, joint.latest, self._group.planners[name].plan.levels[-1].stretch)
        confirmed = joint.trust.confirmed
        return model if confirmed is None else Model(
            confirmed.actuator, replace(model.options, **confirmed.others))

    def latest(self, name: str) -> Estimate | None:
        """Return what is believed of a joint, where a whole move has shown that samples fit."""
        joint = self._joints.get(name)
        return joint.latest if joint is not None and joint.acts else None

    def reset(self) -> str:
        """Forget what was learnt and say so; refused where nothing is learnt at all."""
        self._check_on()
        self.restart()
        return 'what was learnt is forgotten: plans use the parameters as given'

    def save(self, *, by_joint: bool) -> str:
        """Write what was learnt to the file of the settings and say so; refused without any."""
        self._check_on()
        return save(
            self._settings.feedback_file,
            {name: joint.latest for name, joint in self._joints.items()}, by_joint=by_joint)

    def _check_on(self) -> None:
        if not self.on:
            raise BadInputError(
                'feedback is off and nothing is learnt: expected observe or adapt')

    def looks_at(self, stamp: int) -> bool:
        """Return whether a sample with a stamp in ns is of use."""
        return any(not x.newest <= stamp < x.next_sample for x in self._joints.values())

    def _cell(self, name: str, joint: Joint) -> int:
        """Return how far apart in ns samples are to be."""
        cell = round(self._nominal[name].units.time * NANOSECONDS) * 2 // _DENSE
        return cell * _SPARSE if joint.latest and self._quiet(name, joint) else cell

    def _quiet(self, name: str, joint: Joint) -> bool:
        planner = self._group.planners[name]
        last = planner.plan.levels[-1].stamp
        span = round(2.0 * _QUIET * self._nominal[name].units.time * NANOSECONDS)
        return joint.newest > last + span

    def _rings(self, name: str, joint: Joint) -> bool:
        """Return whether no level has changed for a while."""
        last = self._group.planners[name].plan.levels[-1].stamp
        return joint.newest > last + round(3.0 * joint.unit * NANOSECONDS)

    def add(
            self, name: str, stamp: int, stretch: float, flux_density: float, now: int) -> None:
        """
        Take in stretch and field in T measured at a stamp, which come at a time, both in ns.

        Samples come in any order; those between others that are close enough are of no use.
        """
        joint = self._joints.get(name)
        if joint is None or joint.newest <= stamp < joint.next_sample:
            return
        lost = joint.lost = joint.coil.measured(
            self._group.planners[name].plan, stamp, flux_density)
        if lost and joint.trust.why != lost and joint.trust.doubt(lost, now, at_once=True):
            joint.begin_anew()
        joint.add(stamp, math.nan if lost else stretch, now)
        joint.next_sample = joint.newest + self._cell(name, joint)

    def applied(self, name: str, stamp: int, flux_density: float) -> None:
        """Take in that a level in T has taken effect at a stamp in ns, before the plan does."""
        joint = self._joints.get(name)
        if joint is not None:
            joint.coil.applied(self._group.planners[name].plan, stamp, flux_density)

    def possible(self, name: str) -> float:
        """Return the largest level in T that a joint's coil is known to follow."""
        joint = self._joints.get(name)
        return math.inf if joint is None else joint.coil.largest

    @property
    def wake(self) -> int | None:
        """Time in ns at which to look at samples next; None for never, 0 for now."""
        joints = self._joints.values()
        if any(x.looking or x.choosing or x.auditing for x in joints):
            return self._clock() + ANSWER
        if any(x.ready or self.mode == 'adapt' and x.news for x in joints):
            return 0
        return min((x.next_look if x.fresh else 0 for x in joints if x.fresh or x.audits),
                   default=None)

    def give_way(self, now: int) -> None:
        """Look seldom from a time in ns on: commands have been kept waiting."""
        self._seldom = min(2.0 * self._seldom, _SELDOM)
        for joint in self._joints.values():
            joint.not_before = max(joint.not_before, now + round(self._seldom * _RESTING))

    def spent(self, name: str, time: int) -> None:
        """Take in that work for a joint has taken a time in ns: the next look comes later."""
        joint = self._joints.get(name)
        if joint is not None:
            rest = round(_IDLE * len(self._joints) * self._seldom * time)
            joint.not_before = max(joint.not_before, self._clock() + rest)

    def update(self, now: int) -> bool:
        """
        Process the samples of a joint that have come by a time in ns, and publish the estimate.

        Returned is whether that has taken a while.
        """
        busy = False
        # A look that is under way is ended before the next one, which has waited longest.
        for name, joint in sorted(
                self._joints.items(), key=lambda x: (x[1].looking is None, x[1].next_look)):
            if joint.choosing is not None:
                if not goes_on(joint.choosing):
                    joint.choosing, joint.chosen, joint.news = None, True, True
                    busy = True
                continue
            if joint.ready:
                joint.auditing = joint.auditing or self._audit(name, joint, joint.audits.pop(0))
                if goes_on(joint.auditing):
                    continue
                joint.auditing, joint.ready = None, joint.ready - 1
            elif joint.looking is not None:
                return self._look(name, joint, joint.looking, now) or busy
            elif joint.audits and not joint.fresh:
                joint.ready = len(joint.audits)
            elif joint.fresh and now >= joint.next_look:
                joint.looking, joint.spent = joint.update(
                    self._group.planners[name].plan, now, self.doing), 0
                self._look(name, joint, joint.looking, now)
            else:
                continue
            # Commands go out before the next joint has its turn.
            return True
        return busy

    def _look(self, name: str, joint: Joint, looking: Iterator[None], now: int) -> bool:
        """Go on with a look at samples; return whether it has ended, which takes a while."""
        begun = self._clock()
        if goes_on(looking):
            joint.spent += self._clock() - begun
            return False
        joint.looked()
        joint.spent += self._clock() - begun
        self.spent(name, joint.spent)
        self._seldom = max(_OFTENER * self._seldom, 1.0)
        joint.next_update = now + (
            _RESTING if self._quiet(name, joint)
            else min(_UPDATE, round(_OFTEN * joint.unit * NANOSECONDS)) * (
                _RINGING if self._rings(name, joint) else 1))
        if now >= joint.next_tell:
            joint.next_tell = now + _TELL
            self._tell(name, joint, now)
        joint.ready = len(joint.audits)
        return True

    def _tell(self, name: str, joint: Joint, now: int) -> None:
        found = joint.latest
        bad = joint.trust.why or found is not None and self.mode == 'observe' and differences(
            found, joint.estimator.prior.values)
        self._outputs.append(EstimateChanged(
            now, name, Severity.WARN if bad else Severity.OK, self.words(name, now),
            {'mode': self.mode, **joint.figures(), **self.sensor(name).to_dict(),
             'used_by_plans': self.mode == 'adapt' and joint.acts,
             'corrections': self.corrections}))

    def words(self, name: str, now: int) -> str:
        """Say in a sentence without its stop what is wrong with a joint at a time in ns."""
        return self._joints[name].words(
            self._group.planners[name].plan, now, adapting=self.mode == 'adapt')

    def _believed(self, name: str, time: int) -> Believed | None:
        """Return what `hmsa_ros.planning.planner.Planner` is to believe of a time in ns."""
        try:
            found = self.state(name, time) if self.adapted(name) else None
        except HmsaError:
            return None
        if found is None:
            return None
        # What the model in use does not know shifts its rest: a plan keeps to its own stretches.
        planner = self._group.planners[name]
        level, model = planner.plan.levels[-1].flux_density, planner.model
        at = rest(found.values, (), level)
        if at is None:
            return None
        shift = float(equilibrium_stretch(model.load(level), model.material)) - at[0]
        stretch, rate, behind = believed(found, creeps=bool(model.material.creep))
        return stretch + shift, rate, behind

    def state(self, name: str, time: int) -> Estimate | None:
        """Return what plans may begin from at a time in ns; None where predictions count."""
        joint = self._joints.get(name)
        if joint is None or self.mode != 'adapt' or joint.latest is None or not joint.acts:
            return None
        latest = joint.latest
        if time - latest.time > _AHEAD * latest.values['time_unit'] * NANOSECONDS:
            return None
        return self._predicted(name, joint, time)

    def adapted(self, name: str, model: Model | None = None) -> bool:
        """Return whether plans, or one by a model, use parameters that were learnt."""
        return (model or self._group.planners[name].model) != self._nominal[name]

    def follows(self, name: str) -> bool:
        """Return whether plans for a joint begin from what is estimated."""
        return self.adapted(name) and self.state(name, self._clock()) is not None

    def _predicted(self, name: str, joint: Joint, time: int) -> Estimate | None:
        """Return what is believed of a time in ns under the plan in force by now."""
        joint.take_levels(self._group.planners[name].plan, time)
        return joint.estimator.predict(time)

    def foreseen(self, name: str, time: int) -> Estimate | None:
        """Return what moves are corrected from at a time in ns; cautious ones before samples."""
        joint = self._joints.get(name)
        if joint is None or joint.latest is not None or math.isinf(self.tolerance):
            return self.state(name, time)
        return self._predicted(name, joint, time)

    def sensor(self, name: str) -> Sensor:
        """
        Return what was found of the sensor of a joint; one as given where nothing was.

        What a force leaves open of a bias counts.
        """
        found = self.latest(name)
        if found is None:
            return Sensor()
        joint = self._joints[name]
        if joint.sensor is None or joint.sensor[0] is not found:
            joint.sensor = found, sensor_of(found, joint.estimator.prior)
        return joint.sensor[1]

    # -- what moves have left ------------------------------------------------------------------

    def audit(self, name: str, hold: Hold) -> None:
        """Look at the samples of a setpoint of a joint, once all that have come are looked at."""
        joint = self._joints.get(name)
        if joint is not None and self.mode == 'adapt' and not joint.trust.ended and (
                hold not in joint.audits):
            joint.audits.append(hold)

    def _audit(self, name: str, joint: Joint, hold: Hold) -> Awaited[None]:
        """Find whether what a setpoint has left ends feedback."""
        if joint.lost or joint.trust.ended or joint.trust.why or (
                joint.estimator.screening.trouble):
            # Of a sensor that fails, nothing follows for the move.
            return
        plan = self._group.planners[name].plan
        why = yield from joint.ledger.take(
            hold, plan, self._nominal[name], joint.moves, self.sensor(name))
        if not why:
            joint.trust.confirm(plan.levels[-1].model, joint.ledger.left)
            return
        joint.trust.end(why)
        joint.news, joint.fresh = True, True
        self._ended.append(name)
        self.tell_ended(self.words(name, self._clock()))

    def taken_back(self) -> list[str]:
        """Return joints, once, whose plans are to be as if nothing had been learnt."""
        found, self._ended = self._ended, []
        return found

    def planned(self, name: str, model: Model, expected: float) -> None:
        """Take in that moves were planned with a model, and the amplitude they may leave."""
        joint = self._joints.get(name)
        if joint is not None:
            joint.moves = Moves(not alike(model, self._nominal[name]), expected)
            joint.next_update = joint.next_sample = joint.waits = 0

    def corrected(self, name: str, stamp: int, expected: float) -> None:
        """Take in that a plan was corrected from a stamp in ns on."""
        self.corrections += 1
        joint = self._joints.get(name)
        if joint is not None:
            joint.next_sample = 0
            joint.moves.corrected.append(stamp)
            joint.moves.expected = expected

    def use(self, name: str, model: Model) -> None:
        """Plan with what a path under way was corrected by."""
        self._joints[name].used = model
        self._group.planners[name].take_model(model)

    @property
    def named(self) -> int:
        """How many parameters are estimated by name."""
        return len(self._settings.feedback_parameters)

    @property
    def trim(self) -> float:
        """How far in T holding levels may be changed; 0 for not at all."""
        return self._settings.feedback_trim if self.mode == 'adapt' else 0.0

    @property
    def tolerance(self) -> float:
        """Share of its step that a move may be expected to leave without taking longer."""
        cautious = self.mode == 'adapt' and self._settings.feedback_cautious
        return self._settings.feedback_tolerance if cautious else math.inf

    def _choose(self, name: str, joint: Joint, latest: Estimate) -> Awaited[None]:
        """Plan with what is learnt, once that is clearly better, or while a move waits for it."""
        planner = self._group.planners[name]
        used, segments = joint.used or planner.model, planner.plan.segments
        model, waits = used, latest.time < joint.waits
        if differs(used, latest):
            learnt = self._learnt(name, used)
            if segments[-1].path is not None:
                learnt = as_of_path(learnt, used, latest)
            better = partial(
                clearly_better, given=used == self._nominal[name], shown=not waits)
            if (yield from self.doing(
                    better, latest, learnt, used, joint.start, segments[-1].stretch)):
                model = learnt
        if not joint.acts:
            return
        if not waits:
            joint.next_choice = latest.time + round(_CHOICE * joint.unit * NANOSECONDS)
            joint.used = model
        planner.take_model(model)

    def _may_choose(self, name: str, joint: Joint, latest: Estimate) -> bool:
        """Return whether the parameters to plan with are to be chosen by an estimate."""
        # A plan that other parameters take over on the way begins from what it does not know.
        return not joint.chosen and bool(self._group.planners[name].plan.segments) and (
            latest.time < joint.waits
            or latest.time >= joint.next_choice and self.shown(name, latest.time))

    def shown(self, name: str, time: int) -> bool:
        """Return whether samples until a time in ns show how a joint has arrived."""
        planner = self._group.planners[name]
        plan = planner.plan
        place = plan.under_way(planner.soonest(time))
        look = round(_LOOK * self._joints[name].unit * NANOSECONDS)
        return place >= 0 and time >= (plan.segments[place].arrival or 0) + look

    def start(self, name: str) -> float:
        """Return the stretch from which the setpoint under way of a joint began, uncorrected."""
        return self._joints[name].start

    def takes_longer(self, name: str, arrival: int) -> None:
        """Take in that a move has until an arrival in ns to be corrected in."""
        joint = self._joints.get(name)
        if joint is not None:
            joint.waits = arrival

    def news(self) -> Iterator[tuple[str, Planner]]:
        """Plan with what is known best by now, and yield joints with new estimates to act upon."""
        if self.mode != 'adapt':
            return
        for name, joint in self._joints.items():
            if not joint.news or joint.choosing is not None:
                continue
            joint.news = False
            planner = self._group.planners[name]
            if joint.acts and joint.latest is not None:
                if self._may_choose(name, joint, joint.latest):
                    joint.choosing = self._choose(name, joint, joint.latest)
                    continue
                joint.chosen = False
                yield name, planner
            else:
                model = self._learnt(name, self._nominal[name])
                joint.used = model
                if not alike(model, planner.model):
                    planner.take_model(model)
