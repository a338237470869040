"""
The planner over time: requests in, a timeline of timestamped flux densities out.

Times are integer nanoseconds of the caller's clock. A request first becomes a draft
(`hmsa.planning.drafting`), which changes nothing, and is then taken. Several planners can thus
take all of a request or none of it (`hmsa.planning.group`).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
import math

from hmsa.errors import BadInputError
from hmsa.model.equations import equilibrium_stretch
from hmsa.model.moves import check_target, Setpoint
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning import Check, drafting, proceed
from hmsa.planning.drafting import PathPoint, PlanStart
from hmsa.planning.given_levels import check_levels, draft_levels
from hmsa.planning.running import RunningPlan
from hmsa.planning.timeline import Draft, JointModel, Options, PlannedLevel, Timeline, Warmth

__all__ = ['Options', 'Planner']

#: Stretch, rate in 1/s and branch states.
Believed = tuple[float, float, tuple[float, ...]]


class Planner(RunningPlan):
    """Planner that keeps one timeline and replaces its future on request."""

    def __init__(
            self, actuator: ActuatorParameters, options: Options, *,
            stretch: float | None = None) -> None:
        """Start at rest."""
        base = JointModel(actuator, options)
        #: The temperature of the block; None if it changes nothing.
        self.warmth = Warmth.of(base) if actuator.thermal else None
        super().__init__(
            base if self.warmth is None else self.warmth.model(base),
            actuator.rest if stretch is None else stretch)
        #: Returns the estimate of stretch, rate in 1/s and branch states at a time in ns; None to
        #: use the prediction.
        self.believed: Callable[[int], Believed | None] = lambda time: None
        #: Called after each bounded amount of work on a draft.
        self.check: Check = proceed

    def snapshot(self, starts: Iterable[int]) -> 'Planner':
        """Return a planner with the present plan, to draft from starts in ns in another thread."""
        planner = copy(self)
        planner.believed = {
            x + self.delay: self.believed(x + self.delay) for x in starts}.__getitem__
        return planner

    def checked(self, check: Check) -> 'Planner':
        """Return a planner with the same plan whose drafts call ``check``."""
        planner = copy(self)
        planner.check = check
        return planner

    @property
    def options(self) -> Options:
        """Options of the next request."""
        return self.model.options

    @property
    def base(self) -> JointModel:
        """The model at the reference of its temperature coefficients."""
        return self.model if self.warmth is None else self.warmth.base

    def checked_model(self, options: Options, actuator: ActuatorParameters) -> JointModel:
        """
        Return the model of options and an actuator that can hold the present position.

        Raise `BadInputError` if it cannot, or if its position is another quantity.
        """
        if (options, actuator) == (self.base.options, self.base.actuator):
            return self.base
        was, made = self.model.actuator.coordinate.plural, actuator.coordinate.plural
        if was != made:
            raise BadInputError(
                f'parameter law.name would turn {was} into {made}: expected a law that has {was}, '
                'or a planner that is started with the other')
        model = JointModel(actuator, options)
        segments = self.plan.segments
        model.material.check(
            segments[-1].stretch if segments else self.plan.levels[-1].stretch,
            'the stretch that is held')
        return model

    def take_model(self, model: JointModel) -> None:
        """
        Plan the next requests with a model; the running plan does not change.

        With temperature coefficients, its values hold at its reference, and plans are made for the
        present temperature.
        """
        if not model.actuator.thermal:
            self.warmth = None
        elif self.warmth is None or model not in (self.model, self.warmth.base):
            self.warmth = Warmth.of(model) if self.warmth is None else replace(
                self.warmth, base=model)
            model = self.warmth.model(model)
        else:
            return
        if model is not self.model:
            self.model = model
            self.revision += 1

    # -- temperature ---------------------------------------------------------------------------

    def take_temperature(self, temperature: float, time: int, *, estimated: bool = False) -> None:
        """
        Plan the next requests for a temperature in degrees Celsius at a time in ns.

        It is measured, or ``estimated`` from the motion. Raise `BadInputError` if the model has no
        parameters there.
        """
        if self.warmth is not None:
            found = self.warmth.shown(
                temperature, self._levels_until(time), time, estimated=estimated)
            # Drafts under way were made for nearly this temperature, and stay valid.
            self.model, self.warmth = found.model(self.model), found

    def foreseen(self, time: int) -> Warmth | None:
        """Return the temperature at a time in ns under the plan; None if it changes nothing."""
        return None if self.warmth is None else self.warmth.along(self._levels_until(time), time)

    def _levels_until(self, time: int) -> Sequence[PlannedLevel]:
        """Return the levels from the known temperature on until a time in ns."""
        known = time if self.warmth is None or self.warmth.time is None else self.warmth.time
        return self.plan.levels[self.plan.place(known):self.plan.place(max(known, time)) + 1]

    def draft_warmed(self, now: int) -> Draft | None:
        """
        Draft the plan again for the present temperature, from the next time that it can change.

        That is now where a setpoint is held, else the next setpoint. None if there is none.
        """
        begin, plan = self.soonest(now), self.plan
        place = plan.under_way(begin)
        held = plan.segments[place] if place >= 0 else None
        if held is not None and held.arrival is not None and held.arrival <= begin and (
                held.path is None and held.code is not Code.LEVELS
                and not self.model.material.creeps):
            return drafting.draft_warmed(self._plan_start(begin), place, held)
        if place + 1 >= len(plan.segments):
            return None
        return drafting.draft_warmed(self._plan_start(plan.segments[place + 1].since), place + 1)

    def restart(self) -> None:
        """Drop all plans and return to the initial state at rest, as the clock has restarted."""
        if self.warmth is not None:
            # It goes on with the present temperature.
            self.warmth = replace(self.warmth, time=None)
        super().restart()

    def clock_set(self, by: int) -> None:
        """Shift the plan by the ns that the clock was set ahead."""
        super().clock_set(by)
        if self.warmth is not None:
            self.warmth = self.warmth.shifted(by)

    def take(self, draft: Draft | None, now: int) -> Timeline:
        """Replace the plan from the start of a draft of this revision on; return the plan."""
        # Before the levels that have warmed the block are forgotten.
        self.warmth = self.foreseen(now)
        return super().take(draft, now)

    # -- requests ------------------------------------------------------------------------------

    def request(
            self, points: Sequence[tuple[float, int]], stamp: int | None, now: int) -> Timeline:
        """Plan and take a setpoint sequence; see `draft_request`."""
        return self.take(self.draft_request(points, stamp, now), now)

    def setpoint(self, stretch: float, now: int) -> Timeline:
        """Move to one stretch as soon as possible and hold it."""
        return self.take(self.draft_setpoint(stretch, now), now)

    def stop(self, now: int) -> Timeline:
        """Drop the rest of the plan and come to rest as near as the flux density limits allow."""
        return self.take(self.draft_stop(now), now)

    def draft_request(
            self, points: Sequence[tuple[float, int]], stamp: int | None,
            now: int) -> Draft | None:
        """
        Draft a sequence of points (stretch, end in ns from the start), strictly increasing.

        ``stamp`` is the start in ns, or None for now. Until a future start the running plan
        continues; with a past one the sequence is joined in the middle. The draft is None if the
        request changes nothing. Raise `RefusedError` if it cannot be carried out.
        """
        drafting.check_points(points, self.model.rest, self.check)
        base, start = self._begin(stamp, now)
        return drafting.draft_sequence(start, points, base, now)

    def draft_levels(
            self, points: Sequence[tuple[float, int]], stamp: int | None,
            now: int) -> Draft:
        """
        Draft levels in T with start times in ns, counted from a timestamp or from now.

        Raise `RefusedError` if they cannot be carried out.
        """
        check_levels(points, self.model)
        soonest = self.soonest(now)
        begin = self.model.on_grid((soonest if stamp is None else stamp) + points[0][1])
        if begin < soonest:
            raise RefusedError(
                Code.IN_THE_PAST,
                f'the timestamp of the first level was {(now - begin) / NANOSECONDS:.3f} s ago: '
                'expected levels more than lead_time ahead')
        return draft_levels(self._plan_start(begin), points)

    def draft_path(
            self, points: Sequence[tuple[PathPoint, int]], stamp: int | None,
            now: int) -> Draft:
        """
        Draft a path of points (stretch, rate in 1/s, acceleration in 1/s^2 or NaN), times in ns.

        ``stamp`` and errors are those of `draft_request`. Where limits keep the actuator from the
        path, it follows as near as they allow, and the draft has a warning.
        """
        drafting.check_path(points, self.model.rest)
        base, start = self._begin(stamp, now)
        return drafting.draft_path(start, points, base, now)

    def draft_setpoint(self, stretch: float, now: int) -> Draft | None:
        """Draft a move to one stretch; None if it changes nothing."""
        check_target(stretch, self.model.rest)
        begin = self.soonest(now)
        if self.plan.ends_at(stretch, begin):
            return None
        return drafting.draft_moves(self._plan_start(begin), [Setpoint(stretch, math.inf)])

    def draft_stop(self, now: int) -> Draft:
        """Draft a stop."""
        return drafting.draft_stop(self._plan_start(self.soonest(now)))

    def draft_resumption(self, now: int, arrival: int | None = None) -> Draft | None:
        """Draft the rest of the plan again from the present motion, to arrive in time if given."""
        # None if nothing is left. Start at the earliest time that a command can reach or, if no
        # plan is possible from the motion then, a fraction of a period later.
        begin = self._resumption(now)
        start = self._plan_start(begin)
        try:
            return drafting.draft_resumption(start, arrival)
        except RefusedError:
            if arrival is not None:
                raise
            for later in self._later_starts(start):
                # Another phase of the motion may allow it.
                self.check()
                with suppress(RefusedError):
                    return drafting.draft_resumption(self._plan_start(later))
            raise

    def draft_later(self, place: int) -> Draft:
        """Draft the setpoints of the plan from an index on again; those before it stay."""
        return drafting.draft_later(self._plan_start(self.plan.segments[place].since), place)

    def draft_path_anew(
            self, begin: int, model: JointModel, believed: Believed | None) -> Draft:
        """Draft the rest of the running path again with a model, from an estimated state."""
        return drafting.draft_path_anew(self._plan_start(begin, model, believed))

    def draft_trim(self, now: int, flux_density: float) -> Draft:
        """Draft a corrected level in T that holds the current setpoint, from rest."""
        model, begin = self.model, self.soonest(now)
        state, place = self.state(begin), self.plan.under_way(begin)
        # The model does not account for the steady-state error: use its own equilibrium stretches.
        held, wanted = (float(equilibrium_stretch(model.load(x), model.material)) for x in (
            self.plan.level(begin).flux_density, flux_density))
        draft = drafting.draft_moves(
            PlanStart(self.plan, model, begin, replace(state, stretch=held, rate=0.0)),
            [Setpoint(wanted, math.inf)])
        segment = self.plan.segments[place]
        anew = replace(draft.segments[0], stretch=segment.stretch, since=segment.since)
        return replace(draft, segments=(anew,), resumed=place)

    def resumptions(self, now: int) -> tuple[int, ...]:
        """Return the times in ns from which the rest of the plan may be planned again."""
        begin = self._resumption(now)
        return begin, *self._later_starts(self._plan_start(begin))

    def _resumption(self, now: int) -> int:
        """Return the earliest of these times."""
        begin = self.soonest(now)
        return self.model.on_grid(max(begin, self.plan.segments[0].since)) if (
            self.plan.segments) else begin

    def _later_starts(self, start: PlanStart) -> Iterator[int]:
        """Yield the others, which follow from the motion at the first one."""
        return drafting.later_starts(self.model, start.state.stretch, start.begin)

    def start(self, stamp: int | None, now: int) -> int:
        """Return the earliest start in ns of a request for a timestamp; None for now."""
        soonest = self.soonest(now)
        return soonest if stamp is None else self.model.on_grid(max(stamp, soonest))

    def _begin(self, stamp: int | None, now: int) -> tuple[int, PlanStart]:
        """Return the start of a request in ns, and the earliest start for it."""
        begin = self.start(stamp, now)
        return begin if stamp is None else stamp, self._plan_start(begin)

    def _plan_start(
            self, begin: int, model: JointModel | None = None,
            believed: Believed | None = None) -> PlanStart:
        """Return the start of a draft; ``believed`` is given together with another model."""
        anew = model is None
        if model is None:
            model, believed = self.model, self.believed(begin + self.delay)
        state = model.taken_from(
            self._delayed(begin) if self.delay else self.state(begin), self.model)
        if believed is not None:
            state = replace(
                state, stretch=believed[0], rate=believed[1] * model.units.time,
                followed=believed[2] or state.followed)
        warmth = self.foreseen(begin) if anew else None
        if warmth is not None and (ahead := warmth.model(model)) is not model:
            state = ahead.held(
                ahead.taken_from(state, model), model, self.plan.level(begin).flux_density)
            model = ahead
        plan = self.caught_up()
        return PlanStart(plan, model, begin, state, self._history.stale, self.check, warmth)

    def as_held(self, time: int) -> Believed | None:
        """
        Return the predicted state at a time in ns, in the stretches of the present model.

        The last level, or with a temperature the one then, may be planned with other parameters.
        With those of the model it holds another stretch, and a move from the planned one would
        leave vibration. None if both have the same parameters.
        """
        last = self.plan.levels[-1] if self.warmth is None else self.plan.level(time)
        model = self.model
        if last.model is model or (
                last.model.actuator == model.actuator and last.model.others == model.others):
            return None
        state = model.held(self.state(time), last.model, last.flux_density)
        return state.stretch, state.rate / model.units.time, state.followed

    def as_sent(self, time: int) -> bool:
        """Return whether the level at a time in ns belongs to commanded levels or a path."""
        found = self.segment(time)
        return found is not None and found[1].code in (Code.LEVELS, Code.PATH) and (
            found[1].arrival is None or time < found[1].arrival)

    def soonest(self, now: int) -> int:
        """Return the earliest time that a command can still reach."""
        return self.model.on_grid(now + self.model.options.lead_time)
