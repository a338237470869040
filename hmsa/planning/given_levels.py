"""
Levels that are commanded unchanged, such as those that `hmsa excite` designs.

No shaper applies. All other rules are those of other requests: the limits of the coil, the ramps
of its amplifier, the limits of the block, and rest at the end.
"""

from collections.abc import Sequence
from dataclasses import replace
import math

from hmsa.model.equations import equilibrium_stretch, stretch_limits
from hmsa.model.moves import Setpoint
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.drafting import check_times, draft_moves, PlanStart
from hmsa.planning.timeline import Draft, JointModel, PlannedLevel, PlannedSegment

# Fraction of the range from rest to the limits of the model that a motion may use.
_MARGIN = 0.98
# Periods after a change of level that contain the largest motion, and samples of each.
_PERIODS, _SAMPLES = 2.0, 40
# Amplitude of stretch about the last equilibrium that counts as rest.
_REST = 5e-4


def check_levels(points: Sequence[tuple[float, int]], model: JointModel) -> None:
    """
    Check flux densities in T and their start times in ns.

    Raise `RefusedError` if there are none, times do not increase or a level exceeds the limits.
    """
    least, most = model.options.flux_density_min, model.options.flux_density_max
    unit = model.units.load_name
    for number, (level, _) in enumerate(points):
        if not math.isfinite(level):
            raise RefusedError(
                Code.BAD_INPUT, f'level {number} is {level:g}{unit}: expected a finite number')
        if not least <= level <= most:
            raise RefusedError(
                Code.FLUX_LIMIT,
                f'level {number} is {level:g}{unit}: expected {least:g} to {most:g}{unit}, the '
                'limits of the coil (flux_density_min, flux_density_max)')
    check_times(points, 'level')


def draft_levels(start: PlanStart, points: Sequence[tuple[float, int]]) -> Draft:
    """
    Draft checked levels (T, ns); their one setpoint is the equilibrium stretch of the last one.

    If the motion has not ended with the last level, a shaped move to that stretch replaces it.
    Raise `RefusedError` if the motion exceeds the limits of the block or has no way to rest.
    """
    model, state = start.model, start.state
    levels: list[PlannedLevel] = []
    for number, (flux_density, time) in enumerate(points):
        stamp = model.on_grid(start.begin + time - points[0][1])
        if levels:
            before = levels[-1]
            if stamp <= before.stamp:
                raise RefusedError(
                    Code.NOT_INCREASING,
                    f'levels {number - 1} and {number} apply within one command period of '
                    f'{model.options.period / NANOSECONDS:g} s: expected levels farther apart')
            _check_motion(number - 1, before, stamp)
            state = model.follow(
                state, before.load, model.time(stamp - before.stamp))
        levels.append(PlannedLevel(stamp, flux_density, state, model))
        start.check()
    last = levels[-1]
    _check_motion(len(points) - 1, last, None)
    rest = float(equilibrium_stretch(last.load, model.material))
    settled = model.ns(last.ramped)
    period = _period(model, rest)
    times = [last.stamp + settled + round(i * period / _SAMPLES)
             for i in range(round(_PERIODS * _SAMPLES))]
    moves = max(abs(x - rest) for x, _ in last.sample(times))
    arrival: int | None = last.stamp + settled
    if moves > _REST:
        try:
            end = draft_moves(
                replace(start, begin=last.stamp, state=state), [Setpoint(rest, math.inf)],
                'two_step')
        except RefusedError as error:
            raise RefusedError(
                error.code, f'the last level leaves a motion of {moves:.2g} about {rest:.6g}, and '
                f'no move ends it: {error}; expected levels that end at rest, as hmsa excite '
                'writes them') from error
        levels[-1:] = end.levels
        arrival = end.segments[0].arrival
    return Draft(start.begin, tuple(levels), (PlannedSegment(
        rest, start.begin, arrival, Code.LEVELS, '', start.begin),))


def _period(model: JointModel, stretch: float) -> float:
    """Return the shorter period, in ns, of vibration about a stretch and about rest."""
    return min(
        2.0 * math.pi / model.frequency(x) * model.units.time * NANOSECONDS
        for x in (model.material.rest, stretch))


def _check_motion(number: int, level: PlannedLevel, end: int | None) -> None:
    """Raise `RefusedError` if the block would come too near to the limits of its model."""
    model = level.model
    lower, upper = stretch_limits(model.material)
    home = model.material.rest
    least, most = (home + _MARGIN * (x - home) for x in (lower, upper))
    rest = float(equilibrium_stretch(level.load, model.material))
    if least < rest < most:
        step = _period(model, rest) / _SAMPLES
        last = level.stamp + model.ns(level.ramped) + round(_PERIODS * _SAMPLES * step)
        last = last if end is None else min(end, last)
        times = [level.stamp + round(i * step) for i in range(
            int((last - level.stamp) / step) + 1)]
        stretches = [x for x, _ in level.sample(times)]
    else:
        stretches = [rest]
    for stretch in (min(stretches), max(stretches)):
        if not least < stretch < most:
            raise RefusedError(
                Code.OUT_OF_RANGE,
                f'level {number} of {level.flux_density:g}{model.units.load_name} takes the '
                f'{model.units.coordinate} to {stretch:.4g}: expected {least:.4g} to {most:.4g}, '
                'as the law of the actuator allows; lower the levels, or correct its parameters')
