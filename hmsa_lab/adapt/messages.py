"""Description of an estimate in a sentence."""

from collections.abc import Mapping
import math
from typing import Any

import numpy as np

from hmsa.identification.quantities import modulus_of, THERMAL
from hmsa_lab.adapt.estimator import StateEstimate
from hmsa_lab.adapt.motion import held

# Standard deviations and relative change above which a parameter differs from the nominal one.
_SURE, _MATTERS = 3.0, 0.01
# Minimum steady-state error and vibration to report, as fractions of the step.
_OFFSET, _RINGING = 0.01, 0.01
# Correlation above which a bias and a force hide each other, unless the standard deviation of the
# bias, in stretch, is below the last value.
_PAIR, _HIDDEN, _UNKNOWN = ('stretch_bias', 'constant_force'), 0.9, 1e-3
# Quantities with the same effect on samples, unless the block is fast.
_LATER = ('sensor_latency', 'coil_time_constant')
# Required accuracy of a bias, as a fraction of the step.
_BIASED = 0.01
# Smaller steps have no percentage.
_STEP = 0.01
_NAMES = {
    'shear_modulus': 'G', 'youngs_modulus': 'E', 'damping_coefficient': 'damping',
    'remanence': 'Br',
    'chain_limit': 'J_lim', 'density': 'density', 'stretch_gain': 'gain of the sensor',
    'time_unit': 'time unit'}
_ABSOLUTE = {
    'coil_time_constant': ('coil lag', 'ms', 1e3), 'constant_force': ('constant force', 'N', 1.0),
    'sensor_latency': ('latency of the sensor', 'ms', 1e3),
    'viscoelastic_ratio': ('creep', '%', 1e2),
    'stretch_bias': ('bias of the sensor', '', 1.0)}


def confounded(estimate: StateEstimate, least: float = _UNKNOWN) -> bool:
    """
    Return whether a tracked sensor bias and a constant force are still indistinguishable.

    This matters if the standard deviation of the bias exceeds ``least``, in stretch.
    """
    if not set(_PAIR) <= set(estimate.free):
        return False
    i, j = (estimate.free.index(x) for x in _PAIR)
    covariance = estimate.covariance
    scale = math.sqrt(covariance[i, i] * covariance[j, j])
    # A variance may be 0, for example if both are given.
    if scale == 0.0:
        return False
    together = covariance[i, j] / scale
    return abs(together) > _HIDDEN and math.sqrt(covariance[i, i]) > least


def differences(estimate: StateEstimate, nominal: Mapping[str, Any]) -> list[str]:
    """Return the parameters that differ from nominal values, such as ``G about +20 %``."""
    found = []
    hidden = _PAIR if confounded(estimate) else ()
    for name in estimate.free:
        if name in hidden or name in ('viscoelastic_time', *THERMAL):
            continue
        value, before = estimate.values[name], nominal[name]
        change = value - before
        if abs(change) <= _SURE * estimate.deviations[name]:
            continue
        if name in _ABSOLUTE:
            label, unit, factor = _ABSOLUTE[name]
            if name != 'stretch_bias' or abs(change) > _MATTERS:
                found.append(f'{label} about {factor * value:.2g} {unit}'.rstrip())
        elif before and abs(change / before) > _MATTERS:
            label = modulus_of(nominal['law'])[0] if name == 'shear_modulus' else name
            found.append(f'{_NAMES[label]} about {100.0 * change / before:+.0f} %')
    return found + _later(estimate, nominal)


def _later(estimate: StateEstimate, nominal: Mapping[str, Any]) -> list[str]:
    """Return the sum of latency and lag if they are known only together."""
    apart = {x: estimate.values[x] - nominal[x] for x in _LATER if x in estimate.free}
    if any(abs(y) > _SURE * estimate.deviations[x] for x, y in apart.items()):
        return []
    places = [estimate.free.index(x) for x in apart]
    both = sum(apart.values())
    if abs(both) <= _SURE * math.sqrt(estimate.covariance[np.ix_(places, places)].sum()):
        return []
    label, unit, factor = _ABSOLUTE[_LATER[1]]
    return [f'{_ABSOLUTE[_LATER[0]][0]} or {label} about {factor * both:.2g} {unit}']


def sentence(
        estimate: StateEstimate, nominal: Mapping[str, Any], holding: float, target: float,
        start: float, amplitude: float, use: str) -> str:
    """
    Return the errors and their treatment, as a sentence without a full stop.

    The level in T holds the target as planned; the amplitude is that of the vibration about rest.
    ``use`` describes how plans use other parameters; empty if they do not.
    """
    wrong = []
    at = held(estimate.values, estimate.stretch, holding)
    step = target - start
    if at is not None and abs(step) > _STEP:
        offset = (at[0] - target) / step
        if abs(offset) > _OFFSET:
            wrong.append(f'rests {100.0 * abs(offset):.0f} % {"short" if offset < 0.0 else "far"}')
        if 2.0 * amplitude > _RINGING * abs(step):
            wrong.append(f'rings at {at[1] / (2.0 * math.pi):.0f} Hz')
    found = ', '.join(differences(estimate, nominal))
    apart = ('a bias of the sensor and a constant force cannot be distinguished until two targets '
             'were held' if confounded(estimate, max(_UNKNOWN, _BIASED * abs(step))) else '')
    if not wrong and not found:
        return apart or 'as known'
    words = ' and '.join(wrong)
    words += f'{": " if words and found else ""}{found}'
    if not use:
        words += '; `hmsa identify` or feedback: adapt corrects it'
    elif found:
        words += f'; {use}'
    return f'{words}; {apart}' if apart else words
