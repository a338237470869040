"""Feedback: estimates from samples, and models learnt from them."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import math
from typing import Any

from hmsa.judge.records import SensorModel
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.offload import ANSWER, at_once, Awaited, Doing, goes_on, here, is_ready, start
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Believed
from hmsa.planning.timeline import JointModel, PlannedSegment
from hmsa_lab.adapt.adaptive_joint import AdaptiveJoint, RESTING
from hmsa_lab.adapt.corrections import Corrections
from hmsa_lab.adapt.learnt import same_parameters, save
from hmsa_lab.adapt.messages import differences
from hmsa_lab.adapt.move_errors import error_of
from hmsa_ros.runtime.follower import Follower
from hmsa_ros.runtime.planning_task import Drafts, PlanningTask
from hmsa_ros.runtime.records import (
    Clock,
    EstimateChanged,
    Output,
    Samples,
    Settings,
    Severity,
    Verdict,
)

# Interval in ns at which the estimate is published.
_REPORT = 200_000_000
# Minimum delay of the next update, as a multiple of the time that an update or a correction took:
# that of one joint, and for each joint, so that all together take less than half of the time.
_IDLE, _SHARED = 6, 2
# Vibration, peak to peak, as a fraction of the step, that an actuator shows whatever its sensor:
# no bias or gain makes one at rest vibrate.
_RANG = 0.1
# Largest factor of that delay after updates have kept commands waiting, and its decay with each
# update.
_SELDOM, _OFTENER = 32.0, 0.8


class Feedback(Follower):
    """
    Estimate from samples, report discrepancies, and plan with the parameters learnt.

    ``joints`` contains all joints, or none if feedback is off.
    """

    open_loop = False

    def __init__(
            self, group: PlannerGroup, settings: Settings, outputs: list[Output], clock: Clock,
            report_ended: Callable[[str], None], doing: Doing = here) -> None:
        """Begin; ``report_ended`` is called with the reason why feedback of a joint has ended."""
        super().__init__(group, settings, doing)
        start(doing)
        self._outputs, self._clock, self._report_ended = outputs, clock, report_ended
        self.joints: dict[str, AdaptiveJoint] = {}
        self._corrections = Corrections(self, clock)
        self.corrections = 0  # number of corrected plans
        self._seldom = 1.0  # factor of the delay between updates
        self._reverted: list[AdaptiveJoint] = []  # joints whose plans are to be reverted
        for name, planner in group.planners.items():
            planner.believed = partial(self._believed, name)
        self._begin({name: x.base for name, x in group.planners.items()})

    @property
    def on(self) -> bool:
        """Whether samples are used."""
        return self._settings.feedback != 'off'

    @property
    def ready(self) -> bool:
        """Whether the processes that estimate have started, if plans use estimates."""
        return self._settings.feedback not in ('adapt', 'cautious') or is_ready(self.doing)

    def do(self, *work: Any) -> Awaited[Any]:
        """Execute work with `doing` if feedback is on, else in this process."""
        return self.doing(*work) if self.on else super().do(*work)

    def _believed(self, name: str, time: int) -> Believed | None:
        joint = self.joints.get(name)
        return self._group.planners[name].as_held(time) if joint is None else (
            joint.initial_state(time))

    def restart(self) -> None:
        """Discard the estimates: plan with the given parameters, from the predicted state."""
        for joint in self.joints.values():
            joint.planner.take_model(joint.given)
        self._begin({name: x.given for name, x in self.joints.items()})

    def _begin(self, models: Mapping[str, JointModel]) -> None:
        """Begin without samples, with models as given."""
        for joint in self.joints.values():
            # Without an estimate, corrections that are being drafted have no result.
            joint.latest = None
            joint.take_measured(self._clock())
        self.joints = {
            name: AdaptiveJoint(
                name, self._group.planners[name], model, self._settings, self._clock(),
                _SHARED * len(models) > _IDLE)
            for name, model in models.items()} if self.on else {}

    def change(self, settings: Settings, models: Mapping[str, JointModel]) -> Mapping[
            str, JointModel]:
        """
        Adopt new settings and given models; return the models to plan with.

        Estimates are kept as long as the given block and coil do not change.
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
        """Discard the estimates and return a confirmation; refused if feedback is off."""
        if not self.on:
            return super().reset()
        self.restart()
        return 'the estimates are discarded: plans use the parameters as given'

    def save(self, *, by_joint: bool) -> str:
        """Write the estimates to the configured file and return a confirmation, or refuse."""
        if not self.on:
            return super().save(by_joint=by_joint)
        return save(
            self._settings.feedback_file,
            {name: joint.latest for name, joint in self.joints.items()}, by_joint=by_joint)

    def observed(self, joint: str, samples: Samples) -> None:
        """Process samples of a joint."""
        if joint in self.joints:
            for stamp, stretch, _, flux_density, came in zip(*samples, strict=True):
                self.joints[joint].add(stamp, stretch, flux_density, came)

    def applied(self, joint: str, stamp: int, flux_density: float) -> None:
        """Record that a level in T has taken effect, before the plan does."""
        if joint in self.joints:
            self.joints[joint].applied(stamp, flux_density)

    def cautious(self, drafts: Drafts) -> Drafts:
        """Return the drafts of a request with more time for moves to be corrected."""
        return self._corrections.cautious(drafts)

    def due(self, now: int) -> Iterator[PlanningTask]:
        """Yield corrections that may help at a time in ns."""
        return self._corrections.due(now)

    def take(self, work: PlanningTask, drafts: Drafts, now: int) -> Verdict | None:
        """Adopt a correction made for a time in ns; None if nothing changes."""
        return self._corrections.take(work, drafts, now)

    def follows(self, name: str) -> bool:
        """Return whether plans for a joint do not begin from its newest sample."""
        joint = self.joints.get(name)
        return joint is not None and (
            joint.doubted and not joint.trust.rang
            or joint.adapted() and joint.state(self._clock()) is not None)

    def sensor(self, name: str) -> SensorModel:
        """Return the sensor of a joint as estimated; as given where there is no estimate."""
        return self.joints[name].sensor if name in self.joints else SensorModel()

    # -- looks at samples ----------------------------------------------------------------------

    @property
    def wake(self) -> int | None:
        """Time in ns of the next update; None for never, 0 for now."""
        joints = self.joints.values()
        if any(x.looking or x.choosing or x.auditing for x in joints):
            return self._clock() + ANSWER
        if any(x.ready or x.adapts and x.news for x in joints):
            return 0
        return min((x.next_look if x.fresh else 0 for x in joints if x.fresh or x.audits),
                   default=None)

    def wait_for(self, joint: AdaptiveJoint, segment: PlannedSegment) -> None:
        """Update a joint among many only when samples show how it has arrived."""
        # Sooner, it changes no plan, and keeps an update of another joint waiting.
        if joint.crowded:
            joint.next_update = max(joint.next_update, joint.shown_from(segment))

    def give_way(self, now: int) -> None:
        """Update less often from a time in ns on, since commands have been kept waiting."""
        self._seldom = min(2.0 * self._seldom, _SELDOM)
        for joint in self.joints.values():
            joint.not_before = max(joint.not_before, now + round(self._seldom * RESTING))

    def spent(self, joint: AdaptiveJoint, time: int) -> None:
        """Delay the next update, since work for a joint has taken a time in ns."""
        rest = round(max(_IDLE, _SHARED * len(self.joints)) * self._seldom * time)
        joint.not_before = max(joint.not_before, self._clock() + rest)

    def update(self, now: int) -> bool:
        """
        Process the samples of a joint that have arrived by a time in ns, and publish the estimate.

        Return whether this took long.
        """
        busy = False
        looking = sum(x.looking is not None for x in self.joints.values())
        # Updates under way end before others begin, first for the joint that waited longest.
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
                busy |= self._look(joint, joint.looking, now)
                continue
            elif joint.audits and not joint.fresh:
                joint.ready = len(joint.audits)
            elif joint.fresh and now >= joint.next_look and looking < at_once(self.doing):
                joint.looking, joint.spent = joint.update(now, self.doing), 0
                self._look(joint, joint.looking, now)
            else:
                continue
            # Commands are sent before the next joint is updated.
            return True
        return busy

    def _look(self, joint: AdaptiveJoint, looking: Iterator[None], now: int) -> bool:
        """Continue an update; return whether it has ended, which takes long."""
        begun = self._clock()
        if goes_on(looking):
            joint.spent += self._clock() - begun
            return False
        joint.looked()
        joint.spent += self._clock() - begun
        self.spent(joint, joint.spent)
        self._seldom = max(_OFTENER * self._seldom, 1.0)
        joint.next_update = now + joint.interval
        plan = joint.planner.plan
        place = plan.under_way(joint.planner.soonest(now))
        if place >= 0 and now >= joint.waits:
            self.wait_for(joint, plan.segments[place])
        if now >= joint.next_report:
            joint.next_report = now + _REPORT
            self._report(joint, now)
        joint.ready = len(joint.audits)
        return True

    def _report(self, joint: AdaptiveJoint, now: int) -> None:
        found, mode = joint.latest, self._settings.feedback
        bad = joint.trust.why or joint.sensor_changed or (
            found is not None and (found.trouble or mode == 'observe' and differences(
                found, joint.prior.values)))
        self._outputs.append(EstimateChanged(
            now, joint.name, Severity.WARN if bad else Severity.OK, joint.words(now),
            {'mode': mode, **joint.figures(),
             'used_by_plans': joint.adapts and joint.acting is not None,
             'corrections': self.corrections}))

    # -- results -------------------------------------------------------------------------------

    def audit(self, name: str, hold: SetpointSamples) -> None:
        """Audit a setpoint of a joint, once all samples that have arrived are processed."""
        joint = self.joints.get(name)
        if joint is not None and joint.doubted and not joint.stamped_ahead and (
                hold.found is not None and hold.found.vibration > _RANG * hold.setpoint.step):
            joint.trust.rang = joint.news = True
        if joint is not None and joint.adapts and not joint.trust.ended and (
                hold not in joint.audits):
            joint.audits.append(hold)

    def _audit(self, joint: AdaptiveJoint, hold: SetpointSamples) -> Awaited[None]:
        """Decide by the samples of a setpoint whether feedback ends."""
        if joint.lost or joint.trust.ended or joint.trust.why or (
                joint.estimator.screening.trouble or math.isfinite(joint.largest)):
            # With a failing sensor or another field, nothing can be concluded about the move.
            return
        plan = joint.planner.plan
        model = plan.levels[-1].model
        # Parameters as given cannot have made a move worse, whatever the temperature is by now.
        given = joint.without if joint.adapted(joint.based(model)) else (
            joint.given.at_temperature(model.temperature))
        why = yield from error_of(hold, plan, given, joint.sensor)
        if not why:
            return
        joint.news = joint.fresh = True
        self._reverted.append(joint)
        if joint.sensor_changed:
            # It has not, since the figures of that sensor are allowed for.
            joint.discard(self._clock())
            return
        joint.trust.end(why)
        self._report_ended(joint.words(self._clock()))

    def taken_back(self) -> list[AdaptiveJoint]:
        """Return joints, once each, whose plans must be reverted to the given parameters."""
        found, self._reverted = self._reverted, []
        return found

    def news(self) -> Iterator[AdaptiveJoint]:
        """Plan with the best known parameters, and yield joints with new estimates to use."""
        for joint in self.joints.values():
            if not joint.adapts or not joint.news or joint.choosing is not None:
                continue
            joint.news = False
            if joint.reverts:
                joint.reverts = False
                self._reverted.append(joint)
            latest = joint.acting
            if latest is None:
                joint.used = joint.learnt(joint.given)
                if not same_parameters(joint.used, joint.planner.base):
                    joint.planner.take_model(joint.used)
            elif joint.may_choose(latest):
                joint.choosing = joint.choose(latest, self.doing)
            else:
                joint.chosen = False
                yield joint
