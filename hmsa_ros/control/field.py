"""Whether the field of a coil is as commanded, by what is reported of it."""

import math

from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.timeline import Plan

# A field is another one than commanded from this share on, or this share of the unit of load, and
# so many units of time and time constants of the coil after a change.
_OFF, _LEAST, _FOLLOWED = 0.05, 0.01, 3.0
# Share by which a level that took effect may be rounded.
_ROUNDED = 0.01


class Field:
    """Follows reports of the levels and of the field of one joint; times in ns, fields in T."""

    def __init__(self) -> None:
        self.largest = math.inf  # level that took effect where a larger one was commanded
        self._known = False  # whether the field is measured

    def applied(self, plan: Plan, stamp: int, level: float) -> None:
        """Take in that a level took effect, before the plan does."""
        wanted = plan.level(stamp).flux_density
        if abs(level) > self.largest:
            self.largest = math.inf
        if wanted and 0.0 < level / wanted < 1.0 - _ROUNDED:
            self.largest = abs(level)

    def measured(self, plan: Plan, stamp: int, field: float) -> str:
        """Return why the field at a time is not known to be the commanded one; else empty."""
        if math.isnan(field):
            return (
                'the field is not reported any more, and may not be the one commanded'
                if self._known else '')
        self._known = True
        level = plan.level(stamp)
        wanted, options, units = level.flux_density, level.model.options, level.model.units
        follows = _FOLLOWED * (units.time + options.coil_time_constant) + (
            abs(wanted - level.in_force) / options.slew_limit)
        if not plan.segments or stamp < level.stamp + follows * NANOSECONDS or (
                abs(field - wanted) <= max(
                    _OFF * max(abs(field), abs(wanted)), _LEAST * units.load)):
            return ''
        return (f'the coil has {units.drive.text(field)} where {units.drive.text(wanted)} were '
                'commanded')
