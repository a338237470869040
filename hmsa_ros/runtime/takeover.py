"""The actual state of the joints, from samples before the first and before later requests."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
import math

from hmsa.errors import BadInputError, HmsaError
from hmsa.judge.fit import Stillness
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Planner
from hmsa_ros.runtime.follower import Follower
from hmsa_ros.runtime.receipts import Receipts
from hmsa_ros.runtime.records import Environment, ObservedSample, Settings

# Largest age of a sample that shows where a joint is, in ns by the steady clock; and of one that
# does although its level has changed since, as it does all the time along a path.
_RECENT, _FRESH = 2 * NANOSECONDS, 100_000_000
# Largest age of a sample in ns, compared with the newest one, that arrives after it.
_DISORDER = NANOSECONDS // 2
# Samples older than this, in ns, are not the newest available.
_OLDEST = 60 * NANOSECONDS
# Times that differ by more, in ns, come from clocks with different epochs.
_ANOTHER_CLOCK = 100_000_000 * NANOSECONDS
# Tolerated deviation of a sample from the prediction: a stretch, a fraction of the distance from
# rest without a field, and a fraction of the step during and after a move. A wrong model deviates
# by less.
_LEAST, _WAY, _MOVING, _ARRIVED = 0.03, 0.5, 0.6, 0.25
# Time scales after an arrival until which a joint counts as moving.
_QUIET = 20.0
# Longest gap between samples: in ns by the steady clock, and in sampling intervals.
_SILENCE, _INTERVALS = 2 * NANOSECONDS, 3


class Takeover:
    """
    Wait for samples of the joints before the first request, and start from them.

    Samples without a rate show the state of a joint once they show that it rests.
    """

    def __init__(
            self, planners: Mapping[str, Planner], environment: Environment, receipts: Receipts,
            newest: Mapping[str, tuple[int, float]], follower: Follower,
            note: Callable[[str], None]) -> None:
        """
        Begin with unknown positions.

        ``newest`` contains timestamp in ns and level in T of the newest change of each joint.
        """
        self._planners, self._around, self._receipts = planners, environment, receipts
        self._newest, self._note = newest, note
        #: A joint that it follows is left to it; feedback may take its place.
        self.follower = follower
        self._until: int | None = None
        # Whether the positions of the joints are known, or assumed at rest.
        self.engaged = False
        # The newest sample of each joint.
        self._samples: dict[str, ObservedSample] = {}
        self._still: defaultdict[str, Stillness] = defaultdict(Stillness)
        # Joints to check before they are planned for, and those that may not be where predicted.
        self._unsure: set[str] = set()
        self._doubted: set[str] = set()
        self._look_until: int | None = None

    @property
    def waiting(self) -> bool:
        """Whether it is waiting for samples."""
        return self._until is not None or self._look_until is not None

    def begin(self, settings: Settings) -> bool:
        """
        Begin with the prediction, or wait for samples; return whether it is ``engaged``.

        It waits if there is a publisher of samples, or if discovery is not complete.
        """
        if self._until is None and not self.engaged:
            if settings.takeover_timeout and (
                    self._around.observable() or self._around.unheard()):
                self._until = self._around.steady() + settings.takeover_timeout
            else:
                self.engaged = True
        return self.engaged

    def observe(self, joint: str, seen: ObservedSample) -> None:
        """Record a sample; ignore unknown joints, unknown values and samples out of order."""
        if joint not in self._planners or math.isinf(seen.rate) or not math.isfinite(
                seen.stretch + seen.flux_density):
            return
        last, steady = self._samples.get(joint), self._around.steady()
        if last is not None and (seen.came or steady) < last.came:
            # It has waited to be read, and a newer one has not.
            return
        if math.isnan(seen.rate):
            self._still[joint].add(seen.stamp, seen.stretch)
        # Samples are out of order by less than that; else, a clock was set.
        if last is None or seen.stamp >= last.stamp or last.stamp - seen.stamp > _DISORDER or (
                steady - last.came > _RECENT):
            self._samples[joint] = seen._replace(came=seen.came or steady)

    def drop(self) -> None:
        """Stop waiting, and discard the samples."""
        self._until = self._look_until = None
        self._samples.clear()
        self._still.clear()
        self._unsure.clear()
        self._doubted.clear()

    def forget(self, joint: str) -> None:
        """Discard the samples of a joint whose clock was set."""
        self._samples.pop(joint, None)
        self._still.pop(joint, None)

    def clock_set(self, by: int) -> None:
        """Shift samples by the ns that the clock was set ahead, so that they do not age."""
        self._samples = {
            name: x._replace(stamp=x.stamp + by) for name, x in self._samples.items()}
        self._still.clear()

    def go_on(self, settings: Settings) -> bool:
        """
        Start from the samples available, once there is nothing more to wait for.

        Returns whether it does. Raises `RefusedError` for samples of another clock.
        """
        if self._until is None:
            return False
        now = self._around.clock()
        samples = {
            name: x for name, x in self._samples.items()
            if abs(now - x.stamp) <= settings.takeover_max_age}
        over = self._around.steady() > self._until
        for name, seen in self._samples.items():
            if name in samples:
                self._check_ahead(name, seen)
            elif (over and seen.came >= self._until - settings.takeover_timeout
                  or abs(now - seen.stamp) > _ANOTHER_CLOCK):
                self._check_age(name, seen, settings)
                # It is old, but the newest available.
                samples[name] = seen
        samples = {name: y for name, x in samples.items() if (y := self._complete(name, x))}
        if not over and (len(samples) < len(self._planners) or self._around.unheard()):
            return False
        self._until, self.engaged = None, True
        observable = self._around.observable()
        for name in self._planners:
            if name in samples:
                self._take(name, samples[name])
            elif observable:
                self._note(
                    (f'samples of joint {name} contain no rate, and do not show rest'
                     if name in self._samples else f'no sample of joint {name} on joint_states')
                    + ': it is assumed at rest where it began (initial_stretch)')
        return True

    def _complete(self, name: str, seen: ObservedSample) -> ObservedSample | None:
        """Return a sample with a rate, which is zero if the joint is seen to rest; else None."""
        if not math.isnan(seen.rate):
            return seen
        level = self._newest.get(name)
        since = max(self._planners[name].changed(seen.stamp), 0 if level is None else level[0])
        model = self._planners[name].model
        rest = self._still[name].rest(
            lambda x: model.frequency(x) / model.units.time, since)
        return None if rest is None else seen._replace(stretch=rest, rate=0.0)

    def _take(self, name: str, seen: ObservedSample, *, keep: bool = False) -> bool:
        """Start a joint from a sample; return whether it can. ``keep`` retains its setpoints."""
        level = self._newest.get(name)
        try:
            self._planners[name].take_over(
                seen.stamp, seen.stretch, seen.rate, seen.flux_density,
                level[1] if level is not None and level[0] <= seen.stamp else None, keep=keep)
        except BadInputError as error:
            self._note(f'sample of joint {name} ignored: {error}')
            return False
        return True

    # -- clocks --------------------------------------------------------------------------------

    def _check_age(self, name: str, seen: ObservedSample, settings: Settings) -> None:
        """Refuse a sample that is older or newer than possible by the planner's clock."""
        if seen.lag is None and abs(self._around.clock() - seen.stamp) <= _ANOTHER_CLOCK:
            return
        lag = self._around.clock() - seen.stamp if seen.lag is None else seen.lag
        known, most = self._receipts.clock(name).lag, settings.takeover_max_age
        agrees = known is not None and abs(known) <= most
        if abs(lag) <= most or 0 < lag <= _OLDEST and agrees:
            # It is in time, or the clocks agree and the sample itself is delayed.
            return
        raise RefusedError(
            Code.CLOCKS_DIFFER,
            f'samples of joint {name} come {abs(lag) / NANOSECONDS:.3f} s '
            f'{"after" if lag > 0 else "before"} their timestamps, by the clock of the planner: '
            f'expected at most {settings.takeover_max_age / NANOSECONDS:g} s (takeover_max_age). '
            + ('One side has simulated time, or time since a start: set use_sim_time alike'
               if abs(lag) > _ANOTHER_CLOCK else
               'The clocks differ, or samples are that late: set the clocks of planner, plant and '
               'sensor by one source, or see what delays samples'))

    def _check_ahead(self, name: str, seen: ObservedSample) -> None:
        """Refuse to command a device whose clock is so far ahead that all commands are late."""
        lead = self._planners[name].options.lead_time
        if seen.lag is None or -seen.lag <= lead:
            return
        raise RefusedError(
            Code.CLOCKS_DIFFER,
            f'timestamps of samples of joint {name} are {-seen.lag / NANOSECONDS:.3f} s ahead '
            'of the clock of the planner, more than lead_time, and every command would come too '
            'late: set the clocks of planner, plant and sensor by one source')

    # -- before later requests -----------------------------------------------------------------

    def check(self, joints: Iterable[str]) -> None:
        """Compare joints with their samples before they are planned for again."""
        self._unsure |= {*joints} & self._planners.keys()

    def doubt(self, joint: str) -> None:
        """Have a joint planned from a sample next, since it may not be where predicted."""
        self._doubted.add(joint)
        self._unsure.add(joint)
        self._still.pop(joint, None)

    def look(self, settings: Settings, *, keep: bool) -> bool:
        """
        Compare the joints to be checked with their samples; return False to wait for a sample.

        A joint that is not where predicted continues from its sample, and ``keep`` retains its
        remaining setpoints. Raises `RefusedError` if samples have stopped or come from another
        clock.
        """
        for name in sorted(self._unsure):
            if name not in self._doubted and self.follower.follows(name):
                continue
            seen = self._samples.get(name)
            if seen is None or not self._around.observable():
                # No sample shows the position: use the prediction.
                continue
            new = self._look_until is not None and (
                seen.came > self._look_until - settings.takeover_timeout)
            contradicts = self._contradicts(name, seen)
            outdated = contradicts and self._is_outdated(name, seen)
            decides = contradicts or name in self._doubted
            state = self._complete(name, seen) if decides else seen
            if state is None:
                # A later sample of a vibration may agree by chance.
                self._doubted.add(name)
            if state is None or not self._is_current(seen, settings) or outdated or (
                    name in self._doubted and not new):
                if not settings.takeover_timeout:
                    continue
                if not self._is_over(name, seen, settings, outdated=outdated):
                    return False
            if state is None:
                self._note(
                    f'joint {name} is at {seen.stretch:.4g} on joint_states, but its samples '
                    'contain no rate, and do not show rest: planning continues from the '
                    'prediction')
                continue
            self._compare(name, state, settings, keep=keep)
        self._settle()
        return True

    def _is_current(self, seen: ObservedSample, settings: Settings) -> bool:
        """Return whether a sample is recent by the steady clock, or by a shared one, if paused."""
        return self._around.steady() - seen.came <= _RECENT or self._around.one_clock() and (
            abs(self._around.clock() - seen.stamp) <= settings.takeover_max_age)

    def _is_outdated(self, name: str, seen: ObservedSample) -> bool:
        """Return whether the level of a joint has changed since a sample that can be."""
        planner, level = self._planners[name], self._newest.get(name)
        return planner.follows(seen.flux_density) and seen.stamp < max(
            planner.changed(self._around.clock()), 0 if level is None else level[0])

    def _is_over(
            self, name: str, seen: ObservedSample, settings: Settings, *,
            outdated: bool) -> bool:
        """Wait for a new sample; return True after a vain wait, or refuse to continue without."""
        steady = self._around.steady()
        if self._look_until is None:
            self._look_until = steady + settings.takeover_timeout
        if steady <= self._look_until:
            return False
        self._settle(keep=name)
        if self._is_current(seen, settings) and not (
                outdated and steady - seen.came > _FRESH):
            return True
        silence = (steady - seen.came) / NANOSECONDS
        raise RefusedError(
            Code.UNSEEN,
            f'no sample of joint {name} for {silence:.1f} s, although joint_states has a '
            'publisher: expected a sample before the actuator is moved; repair the sensor, or '
            'end its publisher')

    def _settle(self, keep: str = '') -> None:
        """Stop waiting, and keep doubting only a joint of which nothing is known."""
        self._look_until = None
        self._unsure.clear()
        self._doubted &= {keep}

    def _compare(self, name: str, seen: ObservedSample, settings: Settings, *, keep: bool) -> None:
        """Continue from a sample if it contradicts the prediction for its time."""
        self._check_age(name, seen, settings)
        self._check_ahead(name, seen)
        predicted, contradicts = self._predicted(name, seen.stamp), self._contradicts(name, seen)
        if not contradicts and name not in self._doubted:
            return
        if self._take(name, seen, keep=keep) and contradicts:
            expected = 'nothing' if math.isnan(predicted) else f'{predicted:.4g}'
            self._note(
                f'joint {name} is at {seen.stretch:.4g} on joint_states, where {expected} was '
                'predicted: planning continues from the sample')

    def _predicted(self, name: str, time: int) -> float:
        """Return the stretch of a joint predicted for a time in ns; NaN for none."""
        try:
            return self._planners[name].state(time).stretch
        except HmsaError:
            # The model of the plan cannot be followed, and may have been set by mistake.
            return math.nan

    def _contradicts(self, name: str, seen: ObservedSample) -> bool:
        """Return whether a sample contradicts the plan that was in force at its time."""
        predicted = self._predicted(name, seen.stamp)
        return not abs(seen.stretch - predicted) <= _tolerance(
            self._planners[name], seen.stamp, predicted)


def _tolerance(planner: Planner, time: int, predicted: float) -> float:
    """Return the tolerated deviation of a stretch from its prediction at a time in ns."""
    plan, rest = planner.plan, planner.model.actuator.rest
    found = planner.segment(time)
    if found is None:
        return max(_LEAST, _WAY * abs(predicted - rest))
    place, segment = found
    arrived = segment.arrival is not None and (
        time > segment.arrival + planner.model.ns(_QUIET))
    share = _ARRIVED if arrived else _MOVING
    return max(_LEAST, _WAY * abs(predicted - rest), share * plan.step(place))


@dataclass
class _LastSample:
    """The newest sample of a joint; times in ns."""

    stamp: int
    came: int  # time of arrival by the steady clock
    time: int  # time of arrival by the clock of the timestamps, which may be paused
    interval: int  # from the previous sample
    silent: bool = False


class SampleTimeout:
    """
    Detect that samples stop while their publisher still exists.

    A publisher that ends normally disappears at once.
    """

    def __init__(self, environment: Environment) -> None:
        self._around = environment
        self._joints: dict[str, _LastSample] = {}

    def restart(self) -> None:
        """Discard all samples."""
        self._joints.clear()

    def record(self, joint: str, stamp: int) -> None:
        """Record the timestamp of the newest sample of a joint."""
        before = self._joints.get(joint)
        self._joints[joint] = _LastSample(
            stamp, self._around.steady(), self._around.clock(),
            0 if before is None else stamp - before.stamp)

    @property
    def words(self) -> str:
        """The joint whose samples have stopped, in a sentence; empty for none."""
        steady, now = self._around.steady(), self._around.clock()
        for name, joint in self._joints.items():
            if not joint.silent and steady - joint.came > _SILENCE and (
                    now - joint.time > _INTERVALS * joint.interval):
                joint.silent = self._around.observable()
            if joint.silent:
                return (
                    f'no sample of joint {name} for more than {_SILENCE / NANOSECONDS:g} s, '
                    'though samples came before: its sensor has failed, or cannot be reached')
        return ''
