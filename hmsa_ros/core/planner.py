"""
The planner over time: requests in, a timeline of stamped flux densities out.

Knows no ROS: times are integer nanoseconds of whatever clock the caller keeps. The node around
it converts messages and publishes what `Planner.due` hands out.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from hmsa_ros.core import kernels
from hmsa_ros.core.delivery import Delivery, pieces
from hmsa_ros.core.model import elastic_force, equilibrium_stretch
from hmsa_ros.core.moves import Level, Limits, Move, State
from hmsa_ros.core.parameters import ActuatorParameters
from hmsa_ros.core.sequence import plan_sequence, Segment, Setpoint
from hmsa_ros.core.shapers import get_shaper
from hmsa_ros.core.simulation import check_stretch, longest_motion, RTOL, simulate
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.units import NANOSECONDS, Units

# Stretch rates below this share of the natural frequency are rounding, not motion.
_AT_REST = 1e-6
# How hard to brake where the hardest does not lead to a plan, from the nearest stop on.
_BRAKE_SHARES = (0.5, 0.1, 0.02, 0.0)
# How far inside the flux density limits a stop keeps where it has to, as a share.
_INSIDE = 1e-3
# Stamp of the level that is in force before the first request.
_ALWAYS = -2**62


@dataclass(frozen=True)
class PlannedLevel:
    """
    A change of level.

    Attributes
    ----------
    stamp : int
        Time in ns from which it applies.
    flux_density : float
        In T.
    stretch, rate : float
        Predicted at the stamp; the rate in 1/s.
    in_force : float
        Flux density in T predicted at the stamp, from which a slew limit ramps to the level.

    """

    stamp: int
    flux_density: float
    stretch: float
    rate: float
    in_force: float


@dataclass(frozen=True)
class PlannedSegment:
    """
    One setpoint on the timeline.

    Attributes
    ----------
    stretch : float
        Target.
    begin : int
        Time in ns at which the move begins.
    arrival : int or None
        Time in ns of rest at the target; None where it is only approached.
    code : Code
        Which command it is.
    reason : str
        Why it is not the one asked for; empty if it is.

    """

    stretch: float
    begin: int
    arrival: int | None
    code: Code
    reason: str


@dataclass(frozen=True)
class Plan:
    """
    What is going to happen, from the level in force on.

    Attributes
    ----------
    number : int
        Counts accepted requests from 1; 0 before the first.
    levels : tuple of PlannedLevel
        By stamp; the first may lie in the past.
    segments : tuple of PlannedSegment
        By time.
    kept : int
        How many of them, the first ones, belong to earlier requests.

    """

    number: int
    levels: tuple[PlannedLevel, ...]
    segments: tuple[PlannedSegment, ...]
    kept: int = 0


@dataclass(frozen=True)
class Options:
    """
    How requests are planned.

    Attributes
    ----------
    shaper : str
        Name of a shaper.
    short_spell : {'refuse', 'continue'}
        For a span that ends before the move.
    flux_density_min, flux_density_max : float
        In T.
    lead_time : int
        In ns: how far ahead of its stamp a command is sent.
    period : int
        In ns: commands are stamped with multiples of it; 0 for any time.
    slew_limit : float
        Largest change of the flux density in T/s; infinite for steps.
    order : int
        Of the robust shaper.

    """

    shaper: str = 'two_step'
    short_spell: str = 'refuse'
    flux_density_min: float = -math.inf
    flux_density_max: float = math.inf
    lead_time: int = 50_000_000
    period: int = 0
    slew_limit: float = math.inf
    order: int = 2


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

    Raises
    ------
    BadInputError
        If the stretch or the options are out of range.

    """

    def __init__(
            self, actuator: ActuatorParameters, options: Options, *,
            stretch: float = 1.0) -> None:
        """Start at rest."""
        self._actuator = actuator
        self._material = actuator.nondimensional
        check_stretch(stretch, self._material.j_lim, 'initial stretch')
        self._work = kernels.work_space()
        self._units = Units(actuator.time_unit, actuator.flux_density_unit, ' s', ' T')
        self.set_options(options)
        self._initial = stretch
        self._rest(stretch, 0)

    def set_options(self, options: Options) -> None:
        """
        Plan the next requests with other options.

        Parameters
        ----------
        options : Options
            Taken from the next request on; the running plan stays.

        Raises
        ------
        BadInputError
            If the limits are not in order; the old options stay.

        """
        unit = self._actuator.flux_density_unit
        limits = Limits(options.flux_density_min / unit, options.flux_density_max / unit)
        delivery = Delivery(
            options.period / NANOSECONDS / self._units.time,
            options.slew_limit / unit * self._units.time,
            1.0 / NANOSECONDS / self._units.time)
        get_shaper(options.shaper)
        self._limits, self._delivery, self.options = limits, delivery, options

    def _rest(self, stretch: float, number: int) -> None:
        load = kernels.elastic_force(stretch, 1.0 / self._material.j_lim)
        flux_density = load * self._actuator.flux_density_unit
        level = PlannedLevel(_ALWAYS, flux_density, stretch, 0.0, flux_density)
        self.plan = Plan(number, (level,), ())
        self._unsent = 1

    def restart(self) -> None:
        """
        Drop all plans, after the clock has jumped back.

        Time begins again for a simulation that begins again: the actuator is taken to be at
        rest where it was before the first request.
        """
        self._rest(self._initial, self.plan.number)

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
            return self.plan
        setpoints = []
        left = begin
        for stretch, end in ahead:
            if end == left:
                raise RefusedError(
                    Code.SPELL_TOO_SHORT,
                    f'stretch {stretch:g} begins and ends within one command period of '
                    f'{self.options.period / NANOSECONDS:g} s: expected a longer span')
            setpoints.append(Setpoint(
                stretch, (end - left) / NANOSECONDS / self._actuator.time_unit))
            left = end
        return self._splice(now, begin, self._plan(begin, setpoints))

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
        self._check_stretch(stretch)
        begin = self._soonest(now)
        if self._is_target(stretch, begin):
            return self.plan
        return self._splice(now, begin, self._plan(begin, [Setpoint(stretch, math.inf)]))

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
        begin = self._soonest(now)
        state = self.state(begin)
        brake, time, stretch = self._brake(state, 1.0)
        if (self._holdable(stretch) != stretch
                or not self._delivery.ideal and time > 0.0):
            return self._splice(now, begin, self._gentle_stop(begin, state))
        move = Move(Code.HOLD, tuple(
            [Level(0.0, brake)] * (time > 0.0)
            + [Level(time, float(kernels.elastic_force(stretch, 1.0 / self._material.j_lim)))]),
            time, 'stopped')
        end = State(stretch, 0.0, move.levels[-1].load)
        return self._splice(now, begin, self._place(
            begin, [Segment(Setpoint(stretch, math.inf), 0.0, state, end, move)]))

    # -- what comes of them --------------------------------------------------------------------

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
        while end < len(levels) and levels[end].stamp <= now + self.options.lead_time:
            end += 1
        handed = levels[self._unsent:end]
        self._unsent = end
        return handed

    @property
    def pending(self) -> bool:
        """Whether commands remain to be handed out."""
        return self._unsent < len(self.plan.levels)

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
            Under the plan as it stands.

        """
        level = self._level(time)
        load = level.in_force / self._units.load
        if level.stamp == _ALWAYS:
            return State(level.stretch, 0.0, load)
        end = level.flux_density / self._units.load
        duration = (time - level.stamp) / NANOSECONDS / self._units.time
        longest = self._delivery.ramp(end - load) + longest_motion(end, self._material)
        return self._follow(
            State(level.stretch, level.rate * self._units.time, load), end,
            min(duration, longest))

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
        index = bisect_right([x.begin for x in self.plan.segments], now) - 1
        return None if index < 0 else (index, self.plan.segments[index])

    # -- parts -------------------------------------------------------------------------------

    def _level(self, time: int) -> PlannedLevel:
        levels = self.plan.levels
        return levels[max(bisect_right([x.stamp for x in levels], time) - 1, 0)]

    def _follow(self, state: State, load: float, duration: float) -> State:
        """Predict the state after one level has been commanded for a time."""
        switches, loads, slopes, last = pieces(
            (Level(0.0, load),), state.load, duration, self._delivery.slew)
        stretch, rate = simulate(
            switches, loads, duration, self._material, stretch=state.stretch,
            rate=state.rate, slopes=slopes)
        return State(float(stretch[0]), float(rate[0]), last)

    def _soonest(self, now: int) -> int:
        """Return the first time that a command can still reach in time."""
        return self._on_grid(now + self.options.lead_time)

    def _on_grid(self, time: int) -> int:
        """Return the next multiple of the command period."""
        period = self.options.period
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
            and segments[-1].begin <= begin

    def _plan(
            self, begin: int, setpoints: Sequence[Setpoint], shaper: str = ''
    ) -> tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]:
        """Plan setpoints from a time on and place the result on the timeline."""
        options = self.options
        return self._place(begin, plan_sequence(
            setpoints, self._material, start=self.state(begin),
            shaper=shaper or options.shaper, limits=self._limits, delivery=self._delivery,
            order=options.order, units=self._units, short_spell=options.short_spell))

    def _place(
            self, begin: int, segments: Sequence[Segment]
    ) -> tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]:
        """Place planned moves on the timeline, in SI units."""
        levels = []
        placed = []
        for segment in segments:
            start = begin + self._ns(segment.begin)
            state = segment.start
            if math.isnan(state.load):
                raise ValueError('a segment on the timeline knows the load it starts from')
            time = 0.0
            for number, level in enumerate(segment.move.levels):
                if number:
                    state = self._follow(
                        state, segment.move.levels[number - 1].load, level.time - time)
                time = level.time
                levels.append(PlannedLevel(
                    start + self._ns(time), level.load * self._units.load, state.stretch,
                    state.rate / self._units.time, state.load * self._units.load))
            duration = segment.move.duration
            placed.append(PlannedSegment(
                segment.setpoint.stretch, start,
                None if math.isinf(duration) else start + self._ns(duration),
                segment.move.code, segment.move.reason))
        return tuple(levels), tuple(placed)

    def _ns(self, time: float) -> int:
        return round(time * self._units.time * NANOSECONDS)

    def _splice(
            self, now: int, begin: int,
            future: tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]) -> Plan:
        """Replace everything from a time on."""
        old = self.plan
        stamps = [x.stamp for x in old.levels]
        kept = bisect_left(stamps, begin)
        # What is over and handed out is forgotten, but for the level in force.
        first = max(min(self._unsent, kept, bisect_right(stamps, now)) - 1, 0)
        running = [x for x in old.segments if x.begin < begin]
        over = max(bisect_right([x.begin for x in running], now) - 1, 0)
        segments = tuple(
            replace(x, arrival=None) if x.arrival is not None and x.arrival > begin else x
            for x in running[over:])
        self._unsent = min(self._unsent, kept) - first
        self.plan = Plan(
            old.number + 1, old.levels[first:kept] + future[0], segments + future[1],
            len(segments))
        return self.plan

    def _holdable(self, stretch: float) -> float:
        """Return the nearest stretch that a flux density inside the limits holds."""
        load = float(elastic_force(stretch, self._material.j_lim))
        least, most = self._limits.minimum, self._limits.maximum
        if least <= load <= most:
            return stretch
        nearest = least if load < least else most
        margin = _INSIDE * min(most - least, 1.0 + abs(nearest))
        return float(equilibrium_stretch(
            nearest + math.copysign(margin, nearest - load), self._material.j_lim))

    def _gentle_stop(
            self, begin: int, state: State
    ) -> tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]:
        """Plan a stop that a single brake does not make: on a grid, through ramps, at a limit."""
        for share in _BRAKE_SHARES:
            stretch = self._holdable(self._brake(state, share)[2])
            try:
                return self._plan(begin, [Setpoint(stretch, math.inf)], 'two_step')
            except RefusedError:
                continue
        # Nothing stops it at once: let it settle.
        return self._plan(begin, [Setpoint(self._holdable(state.stretch), math.inf)], 'step')

    def _brake(self, state: State, share: float) -> tuple[float, float, float]:
        """Return a load that brakes with a share of the limit, for how long, and until where."""
        material = self._material
        i_j = 1.0 / material.j_lim
        holding = float(kernels.elastic_force(state.stretch, i_j))
        frequency = math.sqrt(
            kernels.elastic_stiffness(state.stretch, i_j)
            / ((state.stretch ** -3 + material.c1) / 6.0))
        if abs(state.rate) <= _AT_REST * frequency:
            return holding, 0.0, state.stretch
        up = state.rate > 0.0
        load = self._limits.minimum if up else self._limits.maximum
        if not math.isfinite(load):
            # Unlimited: a load that stops within a fraction of a period.
            load = holding - math.copysign(
                10.0 * abs(state.rate) * frequency + 10.0, state.rate)
        if share < 1.0:
            load = holding + share * (load - holding)
        status, time, stretch, _, _ = kernels.turning_point(
            self._work, state.stretch, state.rate, 1.0 if up else -1.0, load, 1.0,
            material.zeta, material.c1, i_j, RTOL)
        if status != kernels.DONE:
            return holding, 0.0, state.stretch
        time = self._ns(time) / NANOSECONDS / self._units.time
        return float(load), time, stretch
