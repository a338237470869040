"""
The planner over time: requests in, a timeline of stamped flux densities out.

Knows no ROS: times are integer nanoseconds of whatever clock the caller keeps. The node around
it converts messages and publishes what `Planner.due` hands out.

A request is worked out as a draft, which changes nothing, and then taken: several planners can
so take all of a request or none of it (`hmsa_ros.core.group`).
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace
import math

from hmsa_ros.core import kernels
from hmsa_ros.core.history import Deviation, History
from hmsa_ros.core.model import equilibrium_stretch
from hmsa_ros.core.moves import Level, Move, State
from hmsa_ros.core.parameters import ActuatorParameters
from hmsa_ros.core.sequence import plan_sequence, Segment, Setpoint
from hmsa_ros.core.simulation import check_stretch
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.stopping import brake, holdable
from hmsa_ros.core.timeline import (
    ALWAYS,
    Draft,
    Model,
    Options,
    Plan,
    PlannedLevel,
    PlannedSegment,
)
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import BadInputError

__all__ = ['Options', 'Plan', 'PlannedLevel', 'PlannedSegment', 'Planner']

# Stretch rates of a sample below this share of the natural frequency are rest, where the model
# would have it move: the model is off then, and not the actuator in motion.
_SAMPLED_AT_REST = 1e-4
# How far the model may be off a sample at rest to be believed nevertheless.
_AGREES = 1e-3
# How hard to brake where the hardest does not lead to a plan, from the nearest stop on.
_BRAKE_SHARES = (0.5, 0.1, 0.02, 0.0)
# How many natural periods later to try again where a plan cannot be made anew at once.
_PATIENCE = (0.0, 0.15, 0.3, 0.45, 0.6)
# Levels that are kept for news of when they took effect.
_REMEMBERED = 32


class Planner:
    """
    Keeps one timeline and replaces its future on request.

    Parameters
    ----------
    actuator : ActuatorParameters
        The block.
    options : Options
        How to plan.
    stretch : float
        Stretch at rest before the first request.

    Attributes
    ----------
    plan : Plan
        In force.
    model : Model
        Under which the next request is planned.

    Raises
    ------
    BadInputError
        If the stretch or the options are out of range.

    """

    def __init__(
            self, actuator: ActuatorParameters, options: Options, *,
            stretch: float = 1.0) -> None:
        """Start at rest."""
        self.model = Model(actuator, options)
        check_stretch(stretch, self.model.material, 'initial stretch')
        self._work = kernels.work_space()
        self._initial = stretch
        self._rest(stretch, 0)

    @property
    def options(self) -> Options:
        """How the next request is planned."""
        return self.model.options

    def set_options(
            self, options: Options, actuator: ActuatorParameters | None = None) -> None:
        """
        Plan the next requests with other options, or for another block.

        Parameters
        ----------
        options : Options
            Taken from the next request on; the running plan stays.
        actuator : ActuatorParameters, optional
            Likewise; default the same as before.

        Raises
        ------
        BadInputError
            If the limits are not in order, or the block cannot be where it is; the old
            options stay.

        """
        self.take_model(self.checked_model(options, actuator or self.model.actuator))

    def checked_model(self, options: Options, actuator: ActuatorParameters) -> Model:
        """Return a model after checking that it can be taken; `set_options` says more."""
        if (options, actuator) == (self.model.options, self.model.actuator):
            return self.model
        model = Model(actuator, options)
        segments = self.plan.segments
        check_stretch(
            segments[-1].stretch if segments else self.plan.levels[-1].stretch,
            model.material, 'the stretch that is held')
        return model

    def take_model(self, model: Model) -> None:
        """Plan the next requests under a model."""
        self.model = model

    def _rest(self, stretch: float, number: int) -> None:
        flux_density = self.model.holding(stretch) * self.model.units.load
        self._begin_with(
            PlannedLevel(ALWAYS, flux_density, stretch, 0.0, flux_density, self.model), number)

    def _begin_with(self, level: PlannedLevel, number: int) -> None:
        self.plan = Plan(number, (level,), ())
        self._unsent = 1
        # Place of the last level that is known to have taken effect.
        self._known = 0

    def restart(self) -> None:
        """
        Drop all plans, after the clock has jumped back.

        Time begins again for a simulation that begins again: the actuator is taken to be at
        rest where it was before the first request.
        """
        self._rest(self._initial, self.plan.number)

    def take_over(
            self, stamp: int, stretch: float, rate: float, in_force: float,
            flux_density: float | None = None) -> None:
        """
        Go on from a state that was measured; plans are dropped.

        Parameters
        ----------
        stamp : int
            Time in ns that it belongs to.
        stretch, rate : float
            The rate in 1/s.
        in_force : float
            Flux density in T.
        flux_density : float, optional
            Level in T that a slew limit is still ramping to; default the one in force.

        Raises
        ------
        BadInputError
            If a number is not finite, or the stretch is outside the limits.

        """
        model = self.model
        check_stretch(stretch, model.material, 'stretch in force')
        level = in_force if flux_density is None else flux_density
        if not math.isfinite(rate + in_force + level):
            raise BadInputError(
                f'state in force is rate {rate:g} 1/s, flux density {in_force:g} T: expected '
                'finite numbers')
        begin = PlannedLevel(stamp, level, stretch, rate, in_force, model)
        held = equilibrium_stretch(level / model.units.load, model.material)
        at_rest = abs(rate) * model.units.time <= _SAMPLED_AT_REST * self.model.frequency(stretch)
        if at_rest and level == in_force and abs(float(held) - stretch) > _AGREES:
            begin = replace(begin, stamp=ALWAYS, rate=0.0)
        self._begin_with(begin, self.plan.number)

    # -- requests ------------------------------------------------------------------------------

    def request(
            self, points: Sequence[tuple[float, int]], stamp: int | None, now: int) -> Plan:
        """
        Take a setpoint sequence.

        Parameters
        ----------
        points : sequence of (float, int)
            Stretch, and time in ns from the start of the sequence until which it lasts,
            strictly increasing.
        stamp : int or None
            Start of the sequence in ns; None for now. A future one keeps the running plan
            until then, a past one joins the sequence in the middle.
        now : int
            Current time in ns.

        Returns
        -------
        Plan
            The new plan; the running one where the request changes nothing.

        Raises
        ------
        RefusedError
            If the request cannot be carried out; the running plan goes on.

        """
        return self.take(self.draft_request(points, stamp, now), now)

    def setpoint(self, stretch: float, now: int) -> Plan:
        """
        Go to one stretch as soon as possible and hold it.

        Parameters
        ----------
        stretch : float
            Target.
        now : int
            Current time in ns.

        Returns
        -------
        Plan
            The new plan; the running one where it leads there already.

        Raises
        ------
        RefusedError
            If it cannot be had; the running plan goes on.

        """
        return self.take(self.draft_setpoint(stretch, now), now)

    def stop(self, now: int) -> Plan:
        """
        Drop what is ahead and come to rest as near as the flux density limits allow.

        The load that brakes hardest is held until the first turning point, then the load that
        holds that stretch: a two-step command whose target is chosen by its beta_p.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        Plan
            The new plan.

        """
        return self.take(self.draft_stop(now), now)

    def draft_request(
            self, points: Sequence[tuple[float, int]], stamp: int | None,
            now: int) -> Draft | None:
        """
        Work out what `request` takes.

        Parameters
        ----------
        points : sequence of (float, int)
            As for `request`.
        stamp : int or None
            Start of the sequence in ns.
        now : int
            Current time in ns.

        Returns
        -------
        Draft or None
            For `take`; None where the request changes nothing.

        Raises
        ------
        RefusedError
            If the request cannot be carried out.

        """
        self._check_points(points)
        soonest = self._soonest(now)
        base = soonest if stamp is None else stamp
        begin = self._on_grid(max(base, soonest))
        ahead = [
            (x, self._on_grid(base + t)) for x, t in points if base + t > begin]
        if points[0][1] == 0 and len(points) > 1 and base == begin:
            # A first point at time 0 that repeats where the actuator is asks for nothing.
            self._check_first(points[0][0], begin)
        if not ahead:
            last = points[-1][1]
            if last == 0:
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'stretch {points[-1][0]:g} is due at time_from_start 0: expected time for '
                    'the move')
            raise RefusedError(
                Code.IN_THE_PAST,
                f'the sequence stamped {base / NANOSECONDS:.3f} s ends at '
                f'{(base + last) / NANOSECONDS:.3f} s, now is {now / NANOSECONDS:.3f} s: '
                'expected an end ahead by more than lead_time; do sender and planner use the '
                'same clock (use_sim_time)?')
        if len(ahead) == 1 and self._is_target(ahead[0][0], begin):
            return None
        setpoints = []
        left = begin
        for stretch, end in ahead:
            if end == left:
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'stretch {stretch:g} begins and ends within one command period of '
                    f'{self.options.period / NANOSECONDS:g} s: expected a longer span')
            setpoints.append(Setpoint(
                stretch, self.model.time(end - left)))
            left = end
        return self._plan(begin, setpoints)

    def draft_setpoint(self, stretch: float, now: int) -> Draft | None:
        """Work out what `setpoint` takes; None where it changes nothing."""
        self._check_stretch(stretch)
        begin = self._soonest(now)
        if self._is_target(stretch, begin):
            return None
        return self._plan(begin, [Setpoint(stretch, math.inf)])

    def draft_stop(self, now: int) -> Draft:
        """Work out what `stop` takes."""
        begin = self._soonest(now)
        state = self.state(begin)
        found = brake(self.model, self._work, state)
        if (holdable(self.model, found.stretch) != found.stretch
                or not self.model.delivery.ideal and found.duration > 0.0):
            return self._gentle_stop(begin, state)
        move = Move(Code.HOLD, tuple(
            [Level(0.0, found.load)] * (found.duration > 0.0)
            + [Level(found.duration, self.model.holding(found.stretch))]),
            found.duration, 'stopped')
        end = State(found.stretch, 0.0, move.levels[-1].load)
        return self._place(
            begin, [Segment(Setpoint(found.stretch, math.inf), 0.0, state, end, move)])

    def draft_resumption(self, now: int) -> Draft | None:
        """
        Plan what is left of the running plan anew, from where the actuator really is.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        Draft or None
            From the first time that a command can reach, or, where there is no way from the
            motion it meets, a part of a period later. Setpoints end when they did; one that
            there is no time left for is left out. None if there is nothing left to do.

        Raises
        ------
        RefusedError
            If it cannot be carried out from there.

        """
        begin = self._soonest(now)
        period = 2.0 * math.pi / self.model.frequency(self.state(begin).stretch)
        for share in _PATIENCE:
            try:
                return self._resumption(self._on_grid(begin + self.model.ns(share * period)))
            except RefusedError:
                # From another phase of the motion it may be possible.
                continue
        return self._resumption(begin)

    def _resumption(self, begin: int) -> Draft | None:
        """Plan from a time on what is left of the running plan."""
        segments = self.plan.segments
        ends = [x.spell for x in segments[1:]]
        first = bisect_right(ends, begin)
        refusal: RefusedError | None = None
        for index in range(first, len(segments)):
            # Left out setpoints make room for the next one, which is gone to at once.
            start = begin if index > first else max(begin, segments[index].spell)
            left = start
            setpoints = []
            for segment, end in zip(segments[index:], [*ends[index:], None], strict=True):
                setpoints.append(Setpoint(
                    segment.stretch, math.inf if end is None else self.model.time(end - left)))
                left = left if end is None else end
            try:
                draft = self._plan(start, setpoints)
            except RefusedError as error:
                refusal = refusal or error
                if error.code is not Code.SPELL_TOO_SHORT:
                    break
                continue
            anew = replace(
                draft.segments[0], spell=min(segments[index].spell, draft.segments[0].spell))
            return replace(
                draft, segments=(anew, *draft.segments[1:]), resumed=first,
                missed=index - first)
        if refusal is not None:
            raise refusal
        return None

    # -- what comes of them --------------------------------------------------------------------

    def take(self, draft: Draft | None, now: int) -> Plan:
        """
        Replace everything from the begin of a draft on.

        Parameters
        ----------
        draft : Draft or None
            Made by this planner since it last took one; None changes nothing.
        now : int
            Current time in ns, as the draft was made with.

        Returns
        -------
        Plan
            The one in force now.

        """
        if draft is None:
            return self.plan
        old = self.plan
        begin = draft.begin
        stamps = [x.stamp for x in old.levels]
        kept = bisect_left(stamps, begin)
        # What is over and handed out is forgotten, but for the level in force, and for those
        # that there may still be news of.
        over = max(min(self._unsent, kept, bisect_right(stamps, now)) - 1, 0)
        first = max(min(over, self._known), over - _REMEMBERED)
        self._known = max(min(self._known, kept - 1) - first, 0)
        self._unsent = min(self._unsent, kept) - first
        levels = old.levels[first:kept] + draft.levels
        if draft.resumed is None:
            running = [x for x in old.segments if x.spell < begin]
            done = max(bisect_right([x.spell for x in running], now) - 1, 0)
            segments = tuple(
                replace(x, arrival=None) if x.arrival is not None and x.arrival > begin else x
                for x in running[done:])
            self.plan = Plan(
                old.number + 1, levels, segments + draft.segments, len(segments), over - first)
        else:
            before = old.segments[:draft.resumed]
            self.plan = Plan(
                old.number, levels, before + draft.segments, min(old.kept, len(before)),
                over - first)
        return self.plan

    def due(self, now: int) -> tuple[PlannedLevel, ...]:
        """
        Hand out the commands to send now, each once.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        tuple of PlannedLevel
            Stamped up to lead_time ahead.

        """
        levels = self.plan.levels
        end = self._unsent
        while end < len(levels) and levels[end].stamp <= now + self.model.options.lead_time:
            end += 1
        handed = levels[self._unsent:end]
        self._unsent = end
        return handed

    @property
    def pending(self) -> bool:
        """Whether commands remain to be handed out."""
        return self._unsent < len(self.plan.levels)

    @property
    def next_due(self) -> int | None:
        """Time in ns from which the next command is to be handed out; None if there is none."""
        if not self.pending:
            return None
        return self.plan.levels[self._unsent].stamp - self.model.options.lead_time

    @property
    def last_sent(self) -> PlannedLevel:
        """Level that was handed out last, or the one in force before the first."""
        return self.plan.levels[self._unsent - 1]

    def drop_missed(self, now: int, tolerance: int) -> int:
        """
        Take out of the plan what should have been in force already and was never handed out.

        Parameters
        ----------
        now : int
            Current time in ns.
        tolerance : int
            In ns: what is late by less may still be handed out.

        Returns
        -------
        int
            How many levels; the level before them is taken to stay in force.

        """
        levels = self.plan.levels
        end = self._unsent
        while end < len(levels) and levels[end].stamp < now - tolerance:
            end += 1
        missed = end - self._unsent
        if missed:
            self._remember(self._history.without(self._unsent, end))
        return missed

    def unheard(self, now: int) -> int | None:
        """
        Look for changes of level that never took effect, although nobody told.

        Parameters
        ----------
        now : int
            Time in ns up to which everything that took effect has been told.

        Returns
        -------
        int or None
            Stamp of the last of them in ns, for `drop_unheard`.

        """
        history = self._history
        count = history.unheard(now)
        return history.levels[history.known + count].stamp if count else None

    def drop_unheard(self, stamp: int) -> None:
        """Take out of the plan what `unheard` has found."""
        history = self._history
        first = history.known + 1
        self._remember(history.without(first, first + history.unheard(stamp)))

    def applied(self, stamp: int, flux_density: float, tolerance: int) -> Deviation | None:
        """
        Take into the timeline a change of level that has taken effect.

        Parameters
        ----------
        stamp : int
            Time in ns at which it did.
        flux_density : float
            Level in T from then on.
        tolerance : int
            In ns: planned changes this near to it are the same.

        Returns
        -------
        Deviation or None
            All zero if it is as planned; None if it is no news.

        """
        history, deviation = self._history.with_news(stamp, flux_density, tolerance)
        self._remember(history)
        return deviation

    @property
    def _history(self) -> History:
        return History(self.plan.levels, self._unsent, self._known)

    def _remember(self, history: History) -> None:
        self.plan = replace(self.plan, levels=history.levels, past=0)
        self._unsent, self._known = history.sent, history.known

    def state(self, time: int) -> State:
        """
        Predict the nondimensional state at a time.

        Parameters
        ----------
        time : int
            In ns, not before the level in force began.

        Returns
        -------
        State
            Under the plan as it stands, in the units of the model for the next request.

        """
        level = self.plan.level(time)
        return self.model.taken_from(level.at(time), level.model)

    def segment(self, now: int) -> tuple[int, PlannedSegment] | None:
        """
        Return the setpoint under way.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        tuple of int and PlannedSegment, or None
            Its place in the plan; None before the first begins.

        """
        index = bisect_right([x.spell for x in self.plan.segments], now) - 1
        return None if index < 0 else (index, self.plan.segments[index])

    # -- parts -------------------------------------------------------------------------------

    def _soonest(self, now: int) -> int:
        """Return the first time that a command can still reach in time."""
        return self._on_grid(now + self.model.options.lead_time)

    def _on_grid(self, time: int) -> int:
        """Return the next multiple of the command period."""
        period = self.model.options.period
        return time if period == 0 else -(-time // period) * period

    def _check_stretch(self, stretch: float) -> None:
        if not (math.isfinite(stretch) and stretch > 0.0):
            raise RefusedError(
                Code.BAD_INPUT,
                f'stretch is {stretch:g}: expected a finite number greater than 0')

    def _check_points(self, points: Sequence[tuple[float, int]]) -> None:
        if not points:
            raise RefusedError(
                Code.BAD_INPUT, 'the trajectory has no points: expected at least one')
        previous = -1
        for number, (stretch, time) in enumerate(points):
            self._check_stretch(stretch)
            if time <= previous:
                raise RefusedError(
                    Code.NOT_INCREASING,
                    f'time_from_start of point {number} is {time / NANOSECONDS:g} s'
                    + (f' after {previous / NANOSECONDS:g} s: expected strictly increasing '
                       'times' if number else ': expected at least 0 s'))
            previous = time

    def _check_first(self, stretch: float, begin: int) -> None:
        """Refuse a jump: a first point at time 0 somewhere else than the actuator is."""
        here = self.state(begin).stretch
        if abs(stretch - here) > 1e-6:
            raise RefusedError(
                Code.SPELL_TOO_SHORT,
                f'the first point asks for stretch {stretch:g} at time_from_start 0, the '
                f'actuator is at {here:.6g}: expected a time that leaves room for the move')

    def _is_target(self, stretch: float, begin: int) -> bool:
        """Whether the running plan ends at a stretch, is on the way and has nothing between."""
        segments = self.plan.segments
        return bool(segments) and segments[-1].stretch == stretch \
            and segments[-1].spell <= begin

    def _plan(
            self, begin: int, setpoints: Sequence[Setpoint], shaper: str = '') -> Draft:
        """Plan setpoints from a time on and place the result on the timeline."""
        model = self.model
        options = model.options
        return self._place(begin, plan_sequence(
            setpoints, model.material, start=self.state(begin),
            shaper=shaper or options.shaper, limits=model.limits, delivery=model.delivery,
            order=options.order, units=model.units, short_spell=options.short_spell))

    def _place(self, begin: int, segments: Sequence[Segment]) -> Draft:
        """Place planned moves on the timeline, in SI units."""
        model = self.model
        unit = model.units
        levels = []
        placed = []
        for segment in segments:
            start = begin + model.ns(segment.begin)
            state = segment.start
            if math.isnan(state.load):
                raise ValueError('a segment on the timeline knows the load it starts from')
            time = 0.0
            for number, level in enumerate(segment.move.levels):
                if number:
                    state = model.follow(
                        state, segment.move.levels[number - 1].load, level.time - time)
                time = level.time
                levels.append(PlannedLevel(
                    start + model.ns(time), level.load * unit.load, state.stretch,
                    state.rate / unit.time, state.load * unit.load, model))
            duration = segment.move.duration
            placed.append(PlannedSegment(
                segment.setpoint.stretch, start,
                None if math.isinf(duration) else start + model.ns(duration),
                segment.move.code, segment.move.reason, start))
        return Draft(begin, tuple(levels), tuple(placed))

    def _gentle_stop(self, begin: int, state: State) -> Draft:
        """Plan a stop that a single brake does not make: on a grid, through ramps, at a limit."""
        for share in _BRAKE_SHARES:
            stretch = holdable(self.model, brake(self.model, self._work, state, share).stretch)
            try:
                return self._plan(begin, [Setpoint(stretch, math.inf)], 'two_step')
            except RefusedError:
                continue
        # Nothing stops it at once: let it settle.
        return self._plan(
            begin, [Setpoint(holdable(self.model, state.stretch), math.inf)], 'step')
