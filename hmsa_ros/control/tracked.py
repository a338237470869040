"""One joint that feedback looks at: its estimator, and what the estimate says of the plan."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
import math

from hmsa_ros.control.aside import Awaited, Doing
from hmsa_ros.control.field import Field
from hmsa_ros.control.holds import Hold
from hmsa_ros.control.ledger import Ledger, Moves
from hmsa_ros.control.trust import Trust
from hmsa_ros.estimation import Estimate, Estimator
from hmsa_ros.estimation.motion import held
from hmsa_ros.estimation.words import sentence
from hmsa_ros.judge.records import Sensor
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.timeline import Model, Plan

# Levels before those of the samples that count: the field of a coil that lags remembers them.
_BEFORE = 8
# A sample may lie ahead of the clock by this share of the unit of time, since clocks differ.
_AHEAD = 0.1


@dataclass(eq=False)
class Joint:
    """What is known of one joint; times in ns."""

    estimator: Estimator
    trust: Trust
    coil: Field
    ledger: Ledger
    start: float  # stretch before the setpoint under way
    latest: Estimate | None = None
    newest: int = 0  # time of the newest sample
    next_sample: int = 0  # time from which on another one is of use
    # What was found of its sensor, and by which estimate.
    sensor: tuple[Estimate, Sensor] | None = None
    next_update: int = 0  # when to look at samples
    not_before: int = 0  # so that looks take a share of the time only
    next_tell: int = 0  # when to tell the estimate
    next_choice: int = 0  # when to choose the parameters to plan with
    used: Model | None = None  # what was chosen; None for what the planner has
    choosing: Iterator[None] | None = None  # the choice under way
    chosen: bool = False  # whether that was made since the latest estimate
    waits: int = 0  # arrival of a move that takes longer, so that it can be corrected
    amplitude: float = 0.0  # largest of the vibration since the last arrival
    setpoint: tuple[int, int] = (0, -1)  # number of the plan, and place of the setpoint under way
    fresh: bool = False  # whether there are samples that have not been looked at
    looking: Iterator[None] | None = None  # the look at them under way
    # Samples that came meanwhile: stamp, stretch, and when.
    waiting: list[tuple[int, float, int]] = field(default_factory=list)
    spent: int = 0  # on that
    audits: list[Hold] = field(default_factory=list)  # setpoints to be looked at after one
    ready: int = 0  # how many of these follow it now
    auditing: Iterator[None] | None = None  # the look at the first of them
    lost: str = ''  # why the field is not as commanded; empty where it is
    moves: Moves = field(default_factory=Moves)  # those of the plan in force
    news: bool = False  # whether the latest estimate has not been held against the plan yet

    @property
    def unit(self) -> float:
        """Unit of time in s, as given."""
        return float(self.estimator.prior.values['time_unit'])

    @property
    def next_look(self) -> int:
        """When to look at samples, a time in ns; one that an audit follows is due at once."""
        return max(self.not_before, 0 if self.audits else self.next_update)

    @property
    def acts(self) -> bool:
        """Whether there is an estimate to act upon."""
        return self.latest is not None and self.latest.trusted and self.trust.acts

    def add(self, stamp: int, stretch: float, now: int) -> None:
        """Take in a stretch measured at a stamp, which is not ahead of the clock."""
        self.fresh = True
        if not self._is_ahead(stamp, now):
            self.newest = max(self.newest, min(stamp, now))
        if self.looking is None:
            self._take(stamp, stretch, now)
        else:
            self.waiting.append((stamp, stretch, now))

    def _is_ahead(self, stamp: int, now: int) -> bool:
        return stamp > now + _AHEAD * self.unit * NANOSECONDS

    def _take(self, stamp: int, stretch: float, now: int) -> None:
        if self._is_ahead(stamp, now):
            self.estimator.screening.refuse_ahead((stamp - now) / NANOSECONDS)
        else:
            self.estimator.sample(stamp, stretch)

    def take_levels(self, plan: Plan, until: int) -> None:
        """Have the estimator know the levels of a plan that count until a time."""
        first = max(plan.place(self.estimator.since) - _BEFORE, 0)
        self.estimator.set_levels([
            (x.stamp, x.flux_density) for x in plan.levels[first:plan.place(until) + 1]])

    def update(self, plan: Plan, now: int, doing: Doing) -> Awaited[None]:
        """Take samples into account that have come, and find what is believed of a time."""
        self.fresh = False
        self.take_levels(plan, max(now, self.newest))
        before = self.estimator.screening.lost
        estimator, found = yield from doing(_updated, self.estimator, now)
        estimator.learning, self.estimator = self.estimator.learning, estimator
        screening = estimator.screening
        self.note_start(plan, now)
        trouble = screening.trouble if found is None else found.trouble
        if screening.lost > before and not self.trust.acts:
            # Others that came with them have fitted again.
            trouble = trouble or screening.last_trouble
        trust = self.trust
        if trust.doubt(trouble, now) if trouble else found is not None and trust.fits(
                plan, self.unit, self.estimator, now):
            self.estimator.restart()
        if found is not None and not trust.why:
            self._look_at_vibration(plan, found)
        if found is not None and self.trust.why:
            found = replace(found, trusted=False, trouble=self.trust.why)
        self.latest, self.news = found, True

    def begin_anew(self) -> None:
        """Forget what has been learnt, and the look under way."""
        self.estimator.restart()
        self.latest, self.news = None, True
        self.looked()

    def looked(self) -> None:
        """End the look under way, and take in the samples that came meanwhile."""
        self.looking = None
        for sample in self.waiting:
            self._take(*sample)
        self.waiting.clear()

    def note_start(self, plan: Plan, now: int) -> None:
        """Remember where the joint was before the setpoint under way at a time."""
        place = plan.under_way(now)
        if (plan.number, place) == self.setpoint:
            return
        again = plan.number == self.setpoint[0] and place > self.setpoint[1] >= 0
        self.setpoint = plan.number, place
        if again:
            self.start = plan.segments[place - 1].stretch
        else:
            self.start = plan.levels[0].stretch if self.latest is None else self.latest.stretch

    def _look_at_vibration(self, plan: Plan, found: Estimate) -> None:
        """Keep the largest amplitude since the last arrival."""
        place = plan.under_way(found.time)
        segment = plan.segments[place] if place >= 0 else None
        if segment is None or segment.arrival is None or found.time < segment.arrival:
            self.amplitude = 0.0
            return
        level = plan.level(found.time)
        at = held(found.values, found.stretch, level.flux_density)
        if at is None:
            return
        self.amplitude = max(self.amplitude, math.hypot(
            found.stretch - at[0], found.rate / at[1]))

    def words(self, plan: Plan, now: int, *, adapting: bool) -> str:
        """Say in a sentence without its stop what is wrong at a time."""
        trust = self.trust
        why = trust.why or self.estimator.screening.trouble
        if trust.ended:
            return (f'{why}: feedback has ended, open loop with {trust.parameters}; '
                    '~/reset_estimate begins it anew')
        if why:
            more = f', with {trust.parameters}' if adapting else ''
            anew = ('; the estimate has begun anew and counts after a move that samples fit; '
                    '~/reset_estimate forgets all') if trust.beginnings else ''
            return f'{why}: open loop until samples fit again{more}{anew}'
        if self.latest is None:
            return 'no estimate yet'
        place = plan.under_way(now)
        target = plan.segments[place].stretch if place >= 0 else self.start
        use = 'plans use it' if trust.acts else 'plans use it after a move that samples fit'
        return sentence(
            self.latest, self.estimator.prior.values, plan.level(now).flux_density, target,
            self.start, self.amplitude, use if adapting else '')

    def figures(self) -> dict[str, object]:
        """Return parameters in SI, with deviations and given values, and counters."""
        prior, screening = self.estimator.prior.values, self.estimator.screening
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
            'new_beginnings': self.trust.beginnings, 'ended': self.trust.ended}


def _updated(estimator: Estimator, now: int) -> tuple[Estimator, Estimate | None]:
    """Return an estimator with its samples taken into account, and what it believes of a time."""
    return estimator, estimator.update(now)
