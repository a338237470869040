"""
The plan that runs: its levels are handed out, and what took effect is taken into it.

Times are integer nanoseconds of whatever clock the caller keeps.
"""

from bisect import bisect_left, bisect_right
from dataclasses import replace
import math

from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.model.equations import elastic_stiffness, equilibrium_stretch
from hmsa_ros.model.moves import State
from hmsa_ros.model.simulation import check_stretch, longest_motion
from hmsa_ros.planning.history import Deviation, History
from hmsa_ros.planning.timeline import ALWAYS, Draft, Model, Plan, PlannedLevel, PlannedSegment

# Stretch rates of a sample below this share of the natural frequency are rest, where the model
# would have it move: the model is off then, and not the actuator in motion.
_SAMPLED_AT_REST = 1e-4
# How far the model may be off a sample at rest to be believed nevertheless, and without a field,
# where every model rests alike and the difference is noise or bias of the sensor.
_AGREES, _AGREES_WITHOUT_FIELD = 1e-3, 5e-3
# Amplitude of stretch up to which drafts hold that were begun before news came.
_LITTLE = 1e-4
# Levels that are kept for news of when they took effect.
_REMEMBERED = 32


class RunningPlan:
    """
    One timeline, of which the past is what really took effect.

    ``revision`` grows whenever what is going to happen changes: drafts made before are no good.
    """

    def __init__(self, model: Model, stretch: float) -> None:
        """Start at rest."""
        check_stretch(stretch, model.material, 'initial stretch')
        self.model = model
        #: How late, in ns, levels to come are expected to take effect, all of them.
        self.delay = 0
        self._strayed = 0.0
        self._initial = stretch
        self._history = History(Plan(0, (), ()))
        self.revision = 0
        self.restart()

    @property
    def plan(self) -> Plan:
        """What is going to happen."""
        return self._history.plan

    def restart(self) -> None:
        """Drop all plans: at rest where it was before the first request, as the clock begins."""
        model, stretch = self.model, self._initial
        load = model.holding(stretch)
        self._begin_with(PlannedLevel(
            ALWAYS, model.flux_density(load), State(stretch, 0.0, load), model))

    def clock_set(self, by: int) -> None:
        """Take in that the clock was set ahead by some ns: what is planned goes on as before."""
        self._history = replace(self._history, plan=self.plan.shifted(by))
        self.revision += 1

    def _begin_with(self, level: PlannedLevel, *, keep: bool = False) -> None:
        """Begin anew from a level; if its setpoints are kept, so is what was not sent yet."""
        old = self.plan if keep else Plan(self.plan.number, (), ())
        ahead = old.levels[self._history.sent:]
        self._history = History(
            replace(old, levels=(level, *ahead)), stale=1 if ahead else None)
        self.revision += 1

    def take_over(
            self, stamp: int, stretch: float, rate: float, in_force: float,
            flux_density: float | None = None, *, keep: bool = False) -> None:
        """
        Drop plans and go on from a state measured at a stamp in ns, with the rate in 1/s.

        ``in_force`` is the field in T, ``flux_density`` the level that a slew limit still ramps
        to. A state that the block cannot have is a `BadInputError`. The setpoints ahead may be
        kept, to be planned anew.
        """
        model, units = self.model, self.model.units
        check_stretch(stretch, model.material, 'stretch in force')
        level = in_force if flux_density is None else flux_density
        if not math.isfinite(rate + in_force + level):
            raise BadInputError(
                f'state in force is rate {rate:g} 1/s, {units.drive.name} {in_force:g}'
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
                f'{units.drive.name} {in_force:g}{units.load_name}: expected one that the model '
                'can follow')
        self._begin_with(begin, keep=keep)

    def follows(self, flux_density: float) -> bool:
        """Return whether motion under a level in T can be predicted: what is planned can."""
        options, model = self.model.options, self.model
        # With room for the motion that it may find.
        more = 2.0 * flux_density
        return options.flux_density_min <= flux_density <= options.flux_density_max or (
            math.isfinite(more) and _can_be_followed(PlannedLevel(
                0, more, State(model.actuator.rest, 0.0, 0.0), model)))

    def abandon(self) -> None:
        """Drop what is not known to have taken effect, and the setpoints: nobody obeys."""
        count = self._history.known + 1
        plan = self._history.predicted(count).plan
        self._history = History(Plan(plan.number, plan.levels[:count], ()), count, count - 1)
        self.revision += 1

    def take(self, draft: Draft | None, now: int) -> Plan:
        """Replace everything from a draft of the present revision on; return the plan in force."""
        if draft is None:
            return self.plan
        history, old, begin = self._history, self.plan, draft.begin
        kept = bisect_left(old.levels, begin, key=lambda x: x.stamp)
        begun = bisect_right(old.levels, now, key=lambda x: x.stamp)
        # What is over and handed out is forgotten, but for the level in force, and for those
        # that there may still be news of.
        over = max(min(history.sent, kept, begun) - 1, 0)
        first = max(min(over, history.known), over - _REMEMBERED)
        new = draft.resumed is None
        before = _running(old, begin, now) if new else old.segments[:draft.resumed]
        stale = history.stale
        self._history = History(
            Plan(old.number + new, old.levels[first:kept] + draft.levels, before + draft.segments,
                 len(before) if new else min(old.kept, len(before))),
            min(history.sent, kept) - first, max(min(history.known, kept - 1) - first, 0),
            stale - first if stale is not None and stale < kept else None)
        self.revision += 1
        return self.plan

    def due(self, now: int) -> tuple[PlannedLevel, ...]:
        """Hand out the commands to send now, each once: those stamped up to lead_time ahead."""
        first, latest = self._history.sent, now + self.model.options.lead_time
        if not self.pending or self.plan.levels[first].stamp > latest:
            return ()
        end = bisect_right(self.plan.levels, latest, first, key=lambda x: x.stamp)
        self._history = replace(self._history.predicted(end), sent=end)
        return self.plan.levels[first:end]

    def moves(self, now: int) -> bool:
        """Return whether setpoints are under way at a time in ns."""
        segments = self.plan.segments
        return bool(segments) and (segments[-1].arrival is None or now < segments[-1].arrival)

    @property
    def pending(self) -> bool:
        """Whether commands remain to be handed out."""
        return self._history.sent < len(self.plan.levels)

    @property
    def next_stamp(self) -> int | None:
        """Stamp in ns of the next command to be handed out; None if there is none."""
        return self.plan.levels[self._history.sent].stamp if self.pending else None

    @property
    def last_sent(self) -> PlannedLevel:
        """Level that was handed out last, or the one in force before the first."""
        return self.plan.levels[self._history.sent - 1]

    def beat_stamp(self, now: int) -> int:
        """Return the time in ns to stamp the level handed out last with when it is repeated."""
        return self.model.on_grid(
            max(now + self.model.options.lead_time, self.last_sent.stamp))

    def drop_missed(self, now: int, tolerance: int) -> int:
        """
        Drop levels never sent, where one is late by more than a tolerance (ns); return how many.

        Those that are less than lead_time ahead belong to a motion that will not happen.
        """
        first = self._history.sent
        if not self.pending or self.plan.levels[first].stamp >= now - tolerance:
            return 0
        soonest = now + self.model.options.lead_time
        end = bisect_left(self.plan.levels, soonest, first, key=lambda x: x.stamp)
        self._leave_out(first, end, soonest)
        return end - first

    def _leave_out(self, first: int, end: int, now: int) -> None:
        """Take levels out of the plan: what is over by a time in ns and needs them is not done."""
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

    def unheard(self, now: int) -> int | None:
        """Return the stamp in ns of the last level that never took effect; None for none."""
        count = self._history.unheard(now)
        return self.plan.levels[self._history.known + count].stamp if count else None

    def drop_unheard(self, stamp: int) -> None:
        """Take out of the plan what `unheard` has found."""
        first = self._history.known + 1
        self._leave_out(first, first + self._history.unheard(stamp), stamp)

    def applied(self, stamp: int, flux_density: float, tolerance: int) -> Deviation | None:
        """Take in a change of level as `History.with_news` does; None if it is no news."""
        self._history, deviation = self._history.with_news(stamp, flux_density, tolerance)
        if deviation is not None:
            deviation = replace(deviation, effect=self._effect(deviation, tolerance))
            self._strayed += deviation.effect
            if self._strayed > _LITTLE:
                self._strayed = 0.0
                self.revision += 1
        return deviation

    def _effect(self, deviation: Deviation, tolerance: int) -> float:
        """Return how far off the plan news leave the actuator, as a stretch."""
        punctual = replace(deviation, late=deviation.late - self.delay)
        if not punctual.beyond(tolerance):
            return 0.0
        return math.inf if replace(punctual, late=0).beyond(0) else self.vibration(
            punctual.late, deviation.change)

    def vibration(self, late: int, change: float) -> float:
        """Return the amplitude of stretch that a change in T leaves which is so many ns late."""
        # It has had as much less momentum: omega times the delay, of the change of its rest.
        level = self.plan.levels[self._history.known]
        model = level.model
        stretch = equilibrium_stretch(level.load, model.material)
        stiffness = elastic_stiffness(stretch, model.material)
        return float(
            abs(model.time(late) * model.units.change(level.flux_density, change) / stiffness)
            * model.frequency(float(stretch)))

    @property
    def awaiting(self) -> bool:
        """Whether there is no news yet of levels that have been handed out."""
        return self._history.sent > self._history.known + 1

    def unknown(self, now: int) -> tuple[PlannedLevel, tuple[PlannedLevel, ...]]:
        """Return what is in force at a time in ns, as far as there is news, and what follows."""
        levels, place = self.plan.levels, self._history.known
        known, rest = levels[place], levels[place + 1:]
        time = min(now, rest[0].stamp) if self.awaiting else now
        if time > known.stamp:
            known = PlannedLevel(time, known.flux_density, known.at(time), known.model)
        return known, rest

    def state(self, time: int) -> State:
        """Predict the nondimensional state at a time in ns, in the units of the next request."""
        self._history = self._history.predicted(self.plan.place(time) + 1)
        level = self.plan.level(time)
        return self.model.taken_from(level.at(time), level.model)

    def _delayed(self, time: int) -> State:
        """Predict the state `delay` after a time in ns, with levels to come as late as that."""
        state, rest = self.unknown(ALWAYS)
        late = [x for x in rest[:_REMEMBERED + 1] if x.stamp <= time]
        if not self.delay or len(late) > _REMEMBERED:
            return self.state(time)
        for level in late:
            state = replace(
                level, stamp=max(level.due + self.delay, state.stamp)).after(state)
        return self.model.taken_from(state.at(time + self.delay), state.model)

    def segment(self, now: int) -> tuple[int, PlannedSegment] | None:
        """Return place and record of the setpoint under way, None before the first begins."""
        index = self.plan.under_way(now)
        return None if index < 0 else (index, self.plan.segments[index])


def _running(plan: Plan, begin: int, now: int) -> tuple[PlannedSegment, ...]:
    """Return the setpoints of a plan from the one under way to those a draft replaces."""
    end = bisect_left(plan.segments, begin, key=lambda x: x.since)
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
