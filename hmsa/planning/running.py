"""
The running plan: it hands out its levels and records those that took effect.

Times are integer nanoseconds of the caller's clock.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace
import math

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.equations import elastic_stiffness, equilibrium_stretch
from hmsa.model.moves import State
from hmsa.model.simulation import longest_motion
from hmsa.model.units import NANOSECONDS
from hmsa.planning.history import Deviation, History
from hmsa.planning.timeline import (
    ALWAYS,
    Draft,
    JointModel,
    PlannedLevel,
    PlannedSegment,
    SINCE,
    STAMP,
    Timeline,
)

# Rates of a sample below this fraction of the natural frequency are rest. If the model predicts
# motion there, the model is in error.
_SAMPLED_AT_REST = 1e-4
# Deviation of the model from a sample at rest up to which the model is used nevertheless; without
# a field, where all models have the same equilibrium, the difference is sensor noise or bias.
_AGREES, _AGREES_WITHOUT_FIELD = 1e-3, 5e-3
# Unplanned amplitude of stretch up to which drafts made before the report remain valid.
_LITTLE = 1e-4
# Number of past levels that are kept, since reports of their effect may still arrive.
_REMEMBERED = 32
# Time in ns for which the levels that a plan has forgotten are kept to compare samples with, and
# their largest number.
_PAST, _PAST_LEVELS = 3 * NANOSECONDS, 1000


class RunningPlan:
    """
    One timeline, whose past contains the levels that took effect.

    ``revision`` increases with every change of the future: earlier drafts are then invalid.
    """

    def __init__(self, model: JointModel, stretch: float) -> None:
        """Start at rest."""
        model.material.check(stretch, 'initial stretch')
        self.model = model
        #: Expected lateness, in ns, of all future levels.
        self.delay = 0
        #: Spread of that, in ns.
        self.uneven = 0
        #: Whether the newest level that took effect was not commanded.
        self.foreign = False
        self._strayed = 0.0
        self._initial = stretch
        self._history = History(Timeline(0, (), ()))
        # Levels before those of the plan, in order.
        self._past: list[PlannedLevel] = []
        self.revision = 0
        self.restart()

    @property
    def plan(self) -> Timeline:
        """Levels that took effect recently, and the plan from the present level on."""
        return self._history.plan

    def caught_up(self) -> Timeline:
        """Return the plan, with the levels that were sent predicted from what took effect."""
        if self._history.stale is not None:
            self._history = self._history.predicted(self._history.sent)
        return self.plan

    def restart(self) -> None:
        """Drop all plans and return to the initial state at rest, as the clock has restarted."""
        model, stretch = self.model, self._initial
        load = model.holding(stretch)
        self._begin_with(PlannedLevel(
            ALWAYS, model.flux_density(load), State(stretch, 0.0, load), model))

    def clock_set(self, by: int) -> None:
        """Shift the plan by the ns that the clock was set ahead."""
        self._history = replace(self._history, plan=self.plan.shifted(by))
        self._past = [x.shifted(by) for x in self._past]
        self.revision += 1

    def _begin_with(self, level: PlannedLevel, *, keep: bool = False) -> None:
        """Start a new plan from a level, optionally with setpoints and unsent levels kept."""
        old = self.plan if keep else Timeline(self.plan.number, (), ())
        ahead = old.levels[self._history.sent:]
        self._past.clear()
        self._history = History(
            replace(old, levels=(level, *ahead)), stale=1 if ahead else None)
        self.revision += 1

    def take_over(
            self, stamp: int, stretch: float, rate: float, in_force: float,
            flux_density: float | None = None, *, keep: bool = False) -> None:
        """
        Drop plans and continue from a state measured at a timestamp in ns, with the rate in 1/s.

        ``in_force`` is the field in T; ``flux_density`` is the level to which a slew limit still
        ramps. The future setpoints may be kept, to be planned again. Raise `BadInputError` if the
        block cannot be in this state.
        """
        model, units = self.model, self.model.units
        model.material.check(stretch, 'stretch in force')
        level = in_force if flux_density is None else flux_density
        if not math.isfinite(rate + in_force + level):
            raise BadInputError(
                f'state in force is rate {rate:g} 1/s, flux density {in_force:g}'
                f'{units.load_name}: expected finite numbers')
        begin = PlannedLevel(stamp, level, State(
            stretch, rate * units.time, model.load(in_force)), model)
        held = float(equilibrium_stretch(begin.load, model.material))
        at_rest = abs(begin.state.rate) <= _SAMPLED_AT_REST * model.frequency(stretch)
        if at_rest and level == in_force:
            agrees = abs(held - stretch) <= (_AGREES if level else _AGREES_WITHOUT_FIELD)
            begin = replace(begin, stamp=ALWAYS, state=replace(
                begin.state, rate=0.0, stretch=held if agrees else stretch))
        if not _can_be_followed(begin):
            raise BadInputError(
                f'state in force is {units.coordinate} {stretch:g}, rate {rate:g} 1/s, '
                f'flux density {in_force:g}{units.load_name}: expected one that the model '
                'can follow')
        self._begin_with(begin, keep=keep)

    def follows(self, flux_density: float) -> bool:
        """Return whether motion under a level in T can be predicted; True within the limits."""
        options, model = self.model.options, self.model
        # With a margin for the present motion.
        more = 2.0 * flux_density
        return options.flux_density_min <= flux_density <= options.flux_density_max or (
            math.isfinite(more) and _can_be_followed(PlannedLevel(
                0, more, State(model.actuator.rest, 0.0, 0.0), model)))

    def abandon(self) -> None:
        """Drop setpoints and levels not known to have taken effect, as no plant obeys them."""
        count = self._history.known + 1
        plan = self._history.predicted(count).plan
        self._history = History(Timeline(plan.number, plan.levels[:count], ()), count, count - 1)
        self.revision += 1

    def take(self, draft: Draft | None, now: int) -> Timeline:
        """Replace the plan from the start of a draft of this revision on; return the plan."""
        if draft is None:
            return self.plan
        old, begin = self.caught_up(), draft.begin
        history = self._history
        kept = bisect_left(old.levels, begin, key=STAMP)
        begun = bisect_right(old.levels, now, key=STAMP)
        # Forget levels that were sent and are over, except the present one and those for which
        # reports may still arrive.
        over = max(min(history.sent, kept, begun) - 1, 0)
        first = max(min(over, history.known), over - _REMEMBERED)
        new = draft.resumed is None
        self._past += old.levels[:first]
        over = bisect_right(self._past, now - _PAST, key=STAMP) - 1
        del self._past[:max(over, len(self._past) - _PAST_LEVELS, 0)]
        before = _running(old, begin, now) if new else old.segments[:draft.resumed]
        stale = history.stale
        self._history = History(
            Timeline(
                old.number + new, (*old.levels[first:kept], *draft.levels),
                before + draft.segments, len(before) if new else min(old.kept, len(before))),
            min(history.sent, kept) - first, max(min(history.known, kept - 1) - first, 0),
            stale - first if stale is not None and stale < kept else None)
        self.revision += 1
        return self.plan

    def due(self, now: int) -> Sequence[PlannedLevel]:
        """Return the commands to send now, each once: those up to lead_time ahead."""
        history, latest = self._history, now + self.model.options.lead_time
        first, levels = history.sent, history.plan.levels
        if first == len(levels) or levels[first].stamp > latest:
            return ()
        end = bisect_right(levels, latest, first, key=STAMP)
        self._history = replace(history, sent=end)
        return levels[first:end]

    def moves(self, now: int) -> bool:
        """Return whether setpoints are still to be reached at a time in ns."""
        segments = self.plan.segments
        return bool(segments) and (segments[-1].arrival is None or now < segments[-1].arrival)

    @property
    def pending(self) -> bool:
        """Whether levels remain to be sent."""
        return self._history.sent < len(self.plan.levels)

    @property
    def next_stamp(self) -> int | None:
        """Timestamp in ns of the next command to send; None if there is none."""
        return self.plan.levels[self._history.sent].stamp if self.pending else None

    @property
    def last_sent(self) -> PlannedLevel:
        """Level that was sent last, or the initial one."""
        return self.caught_up().levels[self._history.sent - 1]

    def beat_stamp(self, now: int) -> int:
        """Return the timestamp in ns for a heartbeat that repeats the last level."""
        return self.model.on_grid(
            max(now + self.model.options.lead_time, self.last_sent.stamp))

    def drop_missed(self, now: int, tolerance: int) -> int:
        """
        Drop unsent levels if one is late by more than a tolerance (ns); return their number.

        The dropped levels are those less than lead_time ahead: their motion will not happen.
        """
        first = self._history.sent
        if not self.pending or self.plan.levels[first].stamp >= now - tolerance:
            return 0
        soonest = now + self.model.options.lead_time
        end = bisect_left(self.plan.levels, soonest, first, key=STAMP)
        self._leave_out(first, end, soonest)
        return end - first

    def _leave_out(self, first: int, end: int, now: int) -> None:
        """Remove levels from the plan; mark setpoints before a time in ns that need them."""
        plan, missing = self.plan, self.plan.levels[first].stamp
        over = max(plan.under_way(now), 0)
        reached = bisect_left(plan.segments[:over], missing, key=lambda x: x.arrival or x.begin)
        if reached < over:
            self._history = replace(self._history, plan=replace(plan, segments=(
                *plan.segments[:reached],
                *(replace(x, carried_out=False) for x in plan.segments[reached:over]),
                *plan.segments[over:])))
        self._history = self._history.without(first, end)
        self.revision += 1

    def unheard(self, now: int, lost: int) -> int | None:
        """Return the timestamp in ns of the last level that `History.unheard` finds, or None."""
        count = self._history.unheard(now, lost)
        return self.plan.levels[self._history.known + count].stamp if count else None

    def drop_unheard(self, stamp: int) -> None:
        """Remove the levels found by `unheard` from the plan."""
        first = self._history.known + 1
        self._leave_out(first, first + self._history.unheard(stamp, stamp), stamp)

    def near(self, one: float, other: float) -> bool:
        """Return whether two levels in T are equal for hardware that rounds them."""
        return self._history.near(one, other)

    def applied(self, stamp: int, flux_density: float, tolerance: int) -> Deviation | None:
        """Record a change of level as `History.with_news` does; None if it is already known."""
        self._history, deviation = self._history.with_news(stamp, flux_density, tolerance)
        if deviation is not None:
            self.foreign = deviation.foreign
            deviation = replace(deviation, effect=self._effect(deviation, tolerance))
            self._strayed += deviation.effect
            if self._strayed > _LITTLE:
                self._strayed = 0.0
                self.revision += 1
        return deviation

    def _effect(self, deviation: Deviation, tolerance: int) -> float:
        """Return the amplitude of stretch by which a deviation changes the planned motion."""
        punctual = replace(deviation, late=deviation.late - self.delay)
        if not punctual.beyond(tolerance):
            return 0.0
        return math.inf if replace(punctual, late=0).beyond(0) else self.vibration(
            punctual.late, deviation.change)

    def vibration(self, late: int, change: float) -> float:
        """Return the amplitude of stretch left by a change in T that is late by some ns."""
        # The missing momentum is omega times the delay, relative to the change of equilibrium.
        level = self.plan.levels[self._history.known]
        model = level.model
        stretch = equilibrium_stretch(level.load, model.material)
        stiffness = elastic_stiffness(stretch, model.material)
        return float(
            abs(model.time(late) * model.units.of_level(change) / stiffness)
            * model.frequency(float(stretch)))

    @property
    def awaiting(self) -> bool:
        """Whether the effect of a sent level has not been reported yet."""
        return self._history.sent > self._history.known + 1

    @property
    def awaiting_change(self) -> bool:
        """Whether one of these levels is another than the one in force."""
        return self._history.awaiting_change

    def unknown(self, now: int) -> tuple[PlannedLevel, Sequence[PlannedLevel]]:
        """Return the last level known to apply by a time in ns, and the levels after it."""
        levels, place = self.plan.levels, self._history.known
        known, rest = levels[place], levels[place + 1:]
        time = min(now, rest[0].stamp) if self.awaiting else now
        if time > known.stamp:
            known = PlannedLevel(time, known.flux_density, known.at(time), known.model)
        return known, rest

    def state(self, time: int) -> State:
        """Predict the nondimensional state at a time in ns, in the units of the next request."""
        place = self.plan.place(time)
        if self._history.stale is not None:
            self._history = self._history.predicted(place + 1)
        level = self.plan.levels[place]
        if time < level.stamp and self._past:
            before = bisect_right(self._past, time, key=STAMP) - 1
            level = self._past[max(before, 0)]
        return self.model.taken_from(level.at(time), level.model)

    def changed(self, time: int) -> int:
        """Return the timestamp in ns of the last change of level by a time in ns."""
        levels, place = self.plan.levels, self.plan.place(time)
        while place and levels[place].flux_density == levels[place - 1].flux_density:
            place -= 1
        return levels[place].stamp

    def _delayed(self, time: int) -> State:
        """Predict the state `delay` after a time in ns, with future levels late by `delay`."""
        state, rest = self.unknown(ALWAYS)
        late = [x for x in rest[:_REMEMBERED + 1] if x.stamp <= time]
        if len(late) > _REMEMBERED:
            return self.state(time)
        for level in late:
            state = replace(
                level, stamp=max(level.due + self.delay, state.stamp)).after(state)
        return self.model.taken_from(state.at(time + self.delay), state.model)

    def segment(self, now: int) -> tuple[int, PlannedSegment] | None:
        """Return index and record of the current setpoint, None before the first begins."""
        index = self.plan.under_way(now)
        return None if index < 0 else (index, self.plan.segments[index])


def _running(plan: Timeline, begin: int, now: int) -> tuple[PlannedSegment, ...]:
    """Return the setpoints of a plan from the current one to those that a draft replaces."""
    end = bisect_left(plan.segments, begin, key=SINCE)
    running = plan.segments[max(min(plan.under_way(now), end - 1), 0):end]
    if running and running[-1].arrival is not None and running[-1].arrival > begin:
        running = (*running[:-1], replace(running[-1], arrival=None))
    return running


def _can_be_followed(level: PlannedLevel) -> bool:
    """Return whether motion from a level on can be predicted until it has settled."""
    model, load = level.model, level.load
    if level.stamp == ALWAYS:
        return True
    period = 2.0 * math.pi / model.frequency(model.actuator.rest)
    try:
        for time in (period, longest_motion(load, model.material)):
            model.follow(level.at(level.stamp), load, time)
    except (HmsaError, OverflowError, ValueError):
        return False
    return True
