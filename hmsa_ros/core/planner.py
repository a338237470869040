"""
The planner over time: requests in, a timeline of stamped flux densities out.

Knows no ROS: times are integer nanoseconds of whatever clock the caller keeps. The node around
it converts messages and publishes what `Planner.due` hands out.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
import math

from hmsa_ros.core import kernels
from hmsa_ros.core.moves import Limits, State
from hmsa_ros.core.parameters import ActuatorParameters
from hmsa_ros.core.sequence import plan_sequence, Segment, Setpoint
from hmsa_ros.core.simulation import check_stretch, RTOL
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.units import NANOSECONDS, Units

# Stretch rates below this share of the natural frequency are rounding, not motion.
_AT_REST = 1e-6
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

    """

    stamp: int
    flux_density: float
    stretch: float
    rate: float


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

    """

    number: int
    levels: tuple[PlannedLevel, ...]
    segments: tuple[PlannedSegment, ...]


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

    """

    shaper: str = 'two_step'
    short_spell: str = 'refuse'
    flux_density_min: float = -math.inf
    flux_density_max: float = math.inf
    lead_time: int = 50_000_000


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
        self._limits = Limits(
            options.flux_density_min / unit, options.flux_density_max / unit)
        self.options = options

    def _rest(self, stretch: float, number: int) -> None:
        load = kernels.elastic_force(stretch, 1.0 / self._material.j_lim)
        level = PlannedLevel(
            _ALWAYS, load * self._actuator.flux_density_unit, stretch, 0.0)
        self.plan = Plan(number, (level,), ())
        self._unsent = 1

    def restart(self, now: int) -> None:
        """
        Drop all plans and hold the level in force, after the clock has jumped back.

        The actuator is taken to be at rest where that level holds it.

        Parameters
        ----------
        now : int
            Time in ns before the jump.

        """
        self._rest(self.state(now).stretch, self.plan.number)

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
        soonest = now + self.options.lead_time
        base = soonest if stamp is None else stamp
        begin = max(base, soonest)
        ahead = [(x, base + t) for x, t in points if base + t > begin]
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
            setpoints.append(Setpoint(
                stretch, (end - left) / NANOSECONDS / self._actuator.time_unit))
            left = end
        return self._splice(begin, self._plan(begin, setpoints))

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
        begin = now + self.options.lead_time
        if self._is_target(stretch, begin):
            return self.plan
        return self._splice(begin, self._plan(begin, [Setpoint(stretch, math.inf)]))

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
        begin = now + self.options.lead_time
        stretch, flux_density = self._nearest_rest(begin)
        levels = [PlannedLevel(begin, flux_density, *self._state_si(begin))]
        arrival = begin
        target = self._equilibrium_load(stretch)
        if flux_density != target:
            material = self._material
            state = self.state(begin)
            _, time, _, _, _ = kernels.turning_point(
                self._work, state.stretch, state.rate, math.copysign(1.0, state.rate),
                flux_density / self._units.load, 1.0, material.zeta, material.c1,
                1.0 / material.j_lim, RTOL)
            arrival = begin + round(time * self._units.time * NANOSECONDS)
            levels.append(PlannedLevel(arrival, target, stretch, 0.0))
        return self._splice(
            begin, (tuple(levels),
                    (PlannedSegment(stretch, begin, arrival, Code.HOLD, 'stopped'),)))

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
        if level.stamp == _ALWAYS:
            return State(level.stretch)
        material = self._material
        _, stretch, rate, _, _, _ = kernels.advance(
            self._work, level.stretch, level.rate * self._units.time, 0.0, 0.0,
            level.flux_density / self._units.load, 0.0, 0.0, 0.0,
            (time - level.stamp) / NANOSECONDS / self._units.time, material.zeta, material.c1,
            1.0 / material.j_lim, RTOL, 0.0)
        return State(stretch, rate)

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

    def _state_si(self, time: int) -> tuple[float, float]:
        state = self.state(time)
        return state.stretch, state.rate / self._units.time

    def _equilibrium_load(self, stretch: float) -> float:
        return float(kernels.elastic_force(
            stretch, 1.0 / self._material.j_lim)) * self._units.load

    def _check_stretch(self, stretch: float) -> None:
        if not math.isfinite(stretch):
            raise RefusedError(
                Code.BAD_INPUT, f'stretch is {stretch}: expected a finite number')

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
            self, begin: int, setpoints: Sequence[Setpoint]
    ) -> tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]:
        """Plan setpoints from a time on and place the result on the timeline."""
        segments = plan_sequence(
            setpoints, self._material, start=self.state(begin), shaper=self.options.shaper,
            limits=self._limits, units=self._units, short_spell=self.options.short_spell,
            resolution=1.0 / NANOSECONDS / self._units.time)
        return self._levels(begin, segments), tuple(
            PlannedSegment(
                x.setpoint.stretch, begin + self._ns(x.begin),
                None if math.isinf(x.move.duration)
                else begin + self._ns(x.begin) + self._ns(x.move.duration),
                x.move.code, x.move.reason)
            for x in segments)

    def _levels(self, begin: int, segments: Sequence[Segment]) -> tuple[PlannedLevel, ...]:
        material = self._material
        levels = []
        for segment in segments:
            stretch, rate = segment.start.stretch, segment.start.rate
            time = 0.0
            load = 0.0
            for level in segment.move.levels:
                _, stretch, rate, _, _, _ = kernels.advance(
                    self._work, stretch, rate, 0.0, 0.0, load, 0.0, 0.0, 0.0,
                    level.time - time, material.zeta, material.c1, 1.0 / material.j_lim, RTOL,
                    0.0)
                time, load = level.time, level.load
                levels.append(PlannedLevel(
                    begin + self._ns(segment.begin) + self._ns(level.time),
                    level.load * self._units.load, stretch, rate / self._units.time))
        return tuple(levels)

    def _ns(self, time: float) -> int:
        return round(time * self._units.time * NANOSECONDS)

    def _splice(
            self, begin: int,
            future: tuple[tuple[PlannedLevel, ...], tuple[PlannedSegment, ...]]) -> Plan:
        """Replace everything from a time on."""
        old = self.plan
        kept = bisect_left([x.stamp for x in old.levels], begin)
        # What is over and handed out is forgotten, but for the level in force.
        first = max(min(self._unsent, kept) - 1, 0)
        segments = tuple(x for x in old.segments if x.begin < begin)
        self._unsent = min(self._unsent, kept) - first
        self.plan = Plan(
            old.number + 1, old.levels[first:kept] + future[0], segments[-1:] + future[1])
        return self.plan

    def _nearest_rest(self, begin: int) -> tuple[float, float]:
        """Return the stretch to stop at and the flux density to apply until there."""
        state = self.state(begin)
        material = self._material
        i_j = 1.0 / material.j_lim
        frequency = math.sqrt(
            kernels.elastic_stiffness(state.stretch, i_j)
            / ((state.stretch ** -3 + material.c1) / 6.0))
        if abs(state.rate) <= _AT_REST * frequency:
            return state.stretch, self._equilibrium_load(state.stretch)
        up = state.rate > 0.0
        load = self._limits.minimum if up else self._limits.maximum
        if not math.isfinite(load):
            # Unlimited: brake with the stiffest load that the elastic force is compared to.
            load = kernels.elastic_force(state.stretch, i_j) - math.copysign(
                10.0 * abs(state.rate) * frequency + 10.0, state.rate)
        status, _, stretch, _, _ = kernels.turning_point(
            self._work, state.stretch, state.rate, 1.0 if up else -1.0, load, 1.0,
            material.zeta, material.c1, i_j, RTOL)
        if status != kernels.DONE:
            return state.stretch, self._equilibrium_load(state.stretch)
        return stretch, load * self._units.load
