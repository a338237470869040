"""Derived quantities of an actuator, as text."""

import math

from hmsa.model.laws.record import ENDLESS
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import flux_text
from hmsa.planning.scales import Scales


def facts(found: Scales, block: ActuatorParameters) -> list[tuple[str, str]]:
    """Return names and values, with units, of the derived quantities."""
    beam, words = block.rest == 0.0, block.coordinate.plural
    return [
        ('time unit' if beam or block.geometry.inertia != 1.0 else 'time unit L sqrt(rho/G)',
         _time_text(found.time_unit)),
        ('natural frequency at rest', f'{found.frequency:.5g} Hz'),
        ('damping', f'{found.damping:.4g} N s/m, zeta {found.zeta:.4g}'),
        ('critical damping at rest',
         f'{found.critical_damping:.4g} N s/m, zeta {found.critical_zeta:.4g}'),
        *([] if found.stretch_limits in (ENDLESS, (0.0, math.inf))
          else [(f'limiting {words}', '{:.4f} and {:.4f}'.format(*found.stretch_limits))]),
        *([] if beam else [('shape c1', f'{found.c1:.4g}')]),
        *((f'flux density for {stretch:.6g}', flux_text(level, '.4g'))
          for stretch, level in found.flux_densities),
        (f'coil holds {words}', '{:.6g} to {:.6g}'.format(*found.held)),
        ('two-step range from rest', 'none' if found.reached == (block.rest,) * 2
         else '{:.6g} to {:.6g}'.format(*found.reached)),
        ('move time from rest', 'no two-step command' if math.isnan(found.duration)
         else f'{_time_text(found.duration)} to {found.target:.6g}')]


def _time_text(seconds: float) -> str:
    """Return a time in s, ms or us."""
    for size, unit in ((1.0, 's'), (1e-3, 'ms')):
        if seconds >= size:
            return f'{seconds / size:.4g} {unit}'
    return f'{seconds * 1e6:.4g} us'
