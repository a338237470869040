"""Feedback: what samples say of the actuators, and models that are learnt from them."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from hmsa_ros.control.aside import ANSWER, Awaited, Doing, goes_on, here
from hmsa_ros.control.holds import Hold
from hmsa_ros.control.learnt import alike, save
from hmsa_ros.control.records import EstimateChanged, Output, Settings, Severity
from hmsa_ros.control.slices import Clock
from hmsa_ros.control.tracked import Joint, RESTING
from hmsa_ros.errors import BadInputError
from hmsa_ros.estimation.words import differences
from hmsa_ros.judge.records import Sensor
from hmsa_ros.planning.group import PlannerGroup
from hmsa_ros.planning.planner import Believed
from hmsa_ros.planning.timeline import Model

#: What the parameter `feedback` can be.
MODES = ('off', 'observe', 'adapt')
# How often the estimate is told, in ns.
_TELL = 200_000_000
# How many times as long as a look or a correction took, and as there are joints, the next look is
# later at least.
_IDLE = 6
# How many times as seldom at most where looks have kept commands waiting, and how it becomes less
# with each look.
_SELDOM, _OFTENER = 32.0, 0.8


class Feedback:
    """
    Estimates from samples, reports what is wrong, and learns what to plan with.

    ``joints`` are those that are looked at: all, or none where feedback is off.
    """

    def __init__(
            self, group: PlannerGroup, settings: Settings, outputs: list[Output], clock: Clock,
            tell_ended: Callable[[str], None]) -> None:
        """Begin; what is called with a sentence that says why feedback of a joint has ended."""
        self._group, self._outputs, self._clock = group, outputs, clock
        self._tell_ended = tell_ended
        #: Does what takes long.
        self.doing: Doing = here
        self._settings = settings
        self.joints: dict[str, Joint] = {}
        self.corrections = 0  # plans that were corrected
        self._seldom = 1.0  # how many times as seldom samples are looked at
        self._ended: list[Joint] = []  # those whose plans are to be taken back
        for name, planner in group.planners.items():
            planner.believed = partial(self._believed, name)
        self._begin({name: x.model for name, x in group.planners.items()})

    @property
    def on(self) -> bool:
        """Whether samples count."""
        return self._settings.feedback != 'off'

    def do(self, *work: Any) -> Awaited[Any]:
        """Do work as what takes long is done, where samples count."""
        return (self.doing if self.on else here)(*work)

    def _believed(self, name: str, time: int) -> Believed | None:
        joint = self.joints.get(name)
        return None if joint is None else joint.believed(time)

    def restart(self) -> None:
        """Forget what was learnt: plan with what is given, from what is predicted."""
        for joint in self.joints.values():
            joint.planner.take_model(joint.given)
        self._begin({name: x.given for name, x in self.joints.items()})

    def _begin(self, models: Mapping[str, Model]) -> None:
        """Begin with nothing seen, and with models as given."""
        for joint in self.joints.values():
            # What is being worked out from it comes to nothing.
            joint.latest = None
        self.joints = {
            name: Joint(name, self._group.planners[name], model, self._settings, self._clock())
            for name, model in models.items()} if self.on else {}

    def change(self, settings: Settings, models: Mapping[str, Model]) -> Mapping[str, Model]:
        """
        Take other settings and models as given; return the models to plan with.

        What was learnt stays in them, as long as block and coil are given as before.
        """
        before, self._settings = self._settings, settings
        if not (self.on and self.joints
                and settings.feedback_parameters == before.feedback_parameters
                and all(models[name].actuator == x.given.actuator
                        and models[name].others == x.given.others
                        for name, x in self.joints.items())):
            self._begin(models)
            return models
        for name, joint in self.joints.items():
            joint.settings, joint.given = settings, models[name]
            joint.estimator.learning = not settings.feedback_frozen
        return {name: x.learnt(x.given) if x.adapts else x.given
                for name, x in self.joints.items()}

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
            {name: joint.latest for name, joint in self.joints.items()}, by_joint=by_joint)

    def _check_on(self) -> None:
        if not self.on:
            raise BadInputError(
                'feedback is off and nothing is learnt: expected observe or adapt')

    def looks_at(self, stamp: int) -> bool:
        """Return whether a sample with a stamp in ns is of use."""
        return any(x.wants(stamp) for x in self.joints.values())

    def follows(self, name: str) -> bool:
        """Return whether plans for a joint begin from what is estimated."""
        joint = self.joints.get(name)
        return joint is not None and joint.adapted() and joint.state(self._clock()) is not None

    def sensor(self, name: str) -> Sensor:
        """Return what was found of the sensor of a joint; one as given where nothing was."""
        return self.joints[name].sensor if name in self.joints else Sensor()

    # -- looks at samples ----------------------------------------------------------------------

    @property
    def wake(self) -> int | None:
        """Time in ns at which to look at samples next; None for never, 0 for now."""
        joints = self.joints.values()
        if any(x.looking or x.choosing or x.auditing for x in joints):
            return self._clock() + ANSWER
        if any(x.ready or x.adapts and x.news for x in joints):
            return 0
        return min((x.next_look if x.fresh else 0 for x in joints if x.fresh or x.audits),
                   default=None)

    def give_way(self, now: int) -> None:
        """Look seldom from a time in ns on: commands have been kept waiting."""
        self._seldom = min(2.0 * self._seldom, _SELDOM)
        for joint in self.joints.values():
            joint.not_before = max(joint.not_before, now + round(self._seldom * RESTING))

    def spent(self, joint: Joint, time: int) -> None:
        """Take in that work for a joint has taken a time in ns: the next look comes later."""
        rest = round(_IDLE * len(self.joints) * self._seldom * time)
        joint.not_before = max(joint.not_before, self._clock() + rest)

    def update(self, now: int) -> bool:
        """
        Process the samples of a joint that have come by a time in ns, and publish the estimate.

        Returned is whether that has taken a while.
        """
        busy = False
        # A look that is under way is ended before the next one, which has waited longest.
        for joint in sorted(
                self.joints.values(), key=lambda x: (x.looking is None, x.next_look)):
            if joint.choosing is not None:
                if not goes_on(joint.choosing):
                    joint.choosing, joint.chosen, joint.news = None, True, True
                    busy = True
                continue
            if joint.ready:
                joint.auditing = joint.auditing or self._audit(joint, joint.audits.pop(0))
                if goes_on(joint.auditing):
                    continue
                joint.auditing, joint.ready = None, joint.ready - 1
            elif joint.looking is not None:
                return self._look(joint, joint.looking, now) or busy
            elif joint.audits and not joint.fresh:
                joint.ready = len(joint.audits)
            elif joint.fresh and now >= joint.next_look:
                joint.looking, joint.spent = joint.update(now, self.doing), 0
                self._look(joint, joint.looking, now)
            else:
                continue
            # Commands go out before the next joint has its turn.
            return True
        return busy

    def _look(self, joint: Joint, looking: Iterator[None], now: int) -> bool:
        """Go on with a look at samples; return whether it has ended, which takes a while."""
        begun = self._clock()
        if goes_on(looking):
            joint.spent += self._clock() - begun
            return False
        joint.looked()
        joint.spent += self._clock() - begun
        self.spent(joint, joint.spent)
        self._seldom = max(_OFTENER * self._seldom, 1.0)
        joint.next_update = now + joint.interval
        if now >= joint.next_tell:
            joint.next_tell = now + _TELL
            self._tell(joint, now)
        joint.ready = len(joint.audits)
        return True

    def _tell(self, joint: Joint, now: int) -> None:
        found, mode = joint.latest, self._settings.feedback
        bad = joint.trust.why or found is not None and mode == 'observe' and differences(
            found, joint.estimator.prior.values)
        self._outputs.append(EstimateChanged(
            now, joint.name, Severity.WARN if bad else Severity.OK, joint.words(now),
            {'mode': mode, **joint.figures(),
             'used_by_plans': joint.adapts and joint.acting is not None,
             'corrections': self.corrections}))

    # -- what comes of them --------------------------------------------------------------------

    def audit(self, name: str, hold: Hold) -> None:
        """Look at the samples of a setpoint of a joint, once all that have come are looked at."""
        joint = self.joints.get(name)
        if joint is not None and joint.adapts and not joint.trust.ended and (
                hold not in joint.audits):
            joint.audits.append(hold)

    def _audit(self, joint: Joint, hold: Hold) -> Awaited[None]:
        """Find whether what a setpoint has left ends feedback."""
        if joint.lost or joint.trust.ended or joint.trust.why or (
                joint.estimator.screening.trouble):
            # Of a sensor that fails, nothing follows for the move.
            return
        plan = joint.planner.plan
        why = yield from joint.ledger.take(hold, plan, joint.given, joint.moves, joint.sensor)
        if not why:
            joint.trust.confirm(plan.levels[-1].model, joint.ledger.left)
            return
        joint.trust.end(why)
        joint.news, joint.fresh = True, True
        self._ended.append(joint)
        self._tell_ended(joint.words(self._clock()))

    def taken_back(self) -> list[Joint]:
        """Return joints, once, whose plans are to be as if nothing had been learnt."""
        found, self._ended = self._ended, []
        return found

    def news(self) -> Iterator[Joint]:
        """Plan with what is known best by now, and yield joints with new estimates to act upon."""
        for joint in self.joints.values():
            if not joint.adapts or not joint.news or joint.choosing is not None:
                continue
            joint.news = False
            latest = joint.acting
            if latest is None:
                joint.used = joint.learnt(joint.given)
                if not alike(joint.used, joint.planner.model):
                    joint.planner.take_model(joint.used)
            elif joint.may_choose(latest):
                joint.choosing = joint.choose(latest, self.doing)
            else:
                joint.chosen = False
                yield joint
