"""Knowledge of an actuator before the first sample."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

import numpy as np

from hmsa.errors import BadInputError, check_number
from hmsa.identification.quantities import (
    check_free,
    complete,
    coordinates,
    derivative,
    EXPANSION,
    Known,
    QUANTITIES,
    TEMPERATURE,
    THERMAL,
    values_of,
    WARMED,
    WARMING,
)
from hmsa.model.equations import Array
from hmsa.model.laws.record import Coordinate, coordinate_of
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.thermal import BLOCK_COEFFICIENTS
from hmsa_ros.runtime.records import TRACKED

#: Default standard deviations: of the logarithm for parameters that are estimated by it, else of
#: the value, with the force as a load, and latency and lag in time scales. Those of damping and
#: J_lim are relative.
DEVIATIONS = {
    'shear_modulus': 0.15, 'density': 0.1, 'remanence': 0.1, 'time_unit': 0.1,
    'chain_limit': 0.1, 'damping_coefficient': 0.25, 'stretch_bias': 3e-3,
    'stretch_gain': 0.02, 'sensor_latency': 0.05, 'coil_time_constant': 0.05,
    'constant_force': 0.007, 'viscoelastic_ratio': 0.03, 'viscoelastic_time': 1.0}
# Minimum 1/J_lim and zeta of relative deviations, so that values of 0 have one.
_LEAST_LIMIT, _LEAST_ZETA = 0.02, 0.1
# Quantities that are no parameters of the planner.
_SENSED = ('stretch_bias', 'stretch_gain', 'sensor_latency', 'constant_force')
_NOT_TRACKED = (
    'initial_stretch', 'initial_rate', *(x for x in QUANTITIES if x.startswith('viscoelastic_')))
#: Possible other errors, tracked so that they are not mistaken for errors of these. The gain of
#: the sensor, here about rest without field, is never estimated: it resembles another remanence
#: and chain limit.
SUSPECTS = (
    'remanence', 'chain_limit', 'coil_time_constant', 'sensor_latency', 'viscoelastic_ratio',
    'viscoelastic_time', 'constant_force', 'stretch_gain')
# Tracked parameters that may well have their given values.
_AS_GIVEN = ('shear_modulus', 'damping_coefficient')
# Deviations of bias and gain of a sensor that may have changed, and parameters that samples of it
# do not determine, since they change the stretch at rest and hardly the vibration.
_CHANGED = {'stretch_bias': 0.1, 'stretch_gain': 0.3}
# Deviations of these about rest if the sensor is as before, that of the bias at least.
_ALIKE = {'stretch_bias': 2e-4, 'stretch_gain': 1e-3}
# Deviation of a bias that alone has changed, and part of it up to which one is known before.
_JUMPED, _KNOWN = 0.05, 0.3
_HIDDEN = ('remanence', 'chain_limit', 'constant_force')
# Deviations of the change of the temperature over the measured one, as coefficients are inexact,
# and of the thermal expansion in 1/K: that of a silicone (benchmarks/warming.py).
_INEXACT = {WARMING: 0.2, EXPANSION: 3e-4}
# Deviation in K of the temperature that is given, and the largest for its range, which leaves this
# fraction of each parameter.
_GIVEN, _WIDEST, _LEAST_FACTOR = 0.1, 20.0, 0.2
# Relaxation time of a suspected branch in time scales.
_RELAXATION = 2.0


class SensorBefore(NamedTuple):
    """
    What would be known of bias and gain of a sensor that has changed less than the prior allows.

    The first row is that of one that has not changed, and the second of one with another bias.
    """

    places: tuple[int, ...]  # their indices among the coordinates
    mean: Array  # coordinates, shape (2,)
    more: Array  # information beyond that of the prior, shape (2, 2, 2)
    log_density: Array  # of the mean, beyond that of the prior, shape (2,)


@dataclass(frozen=True, eq=False)
class Prior:
    """Values and their uncertainty."""

    # Of all quantities, the hyperelastic model, and the viscoelastic branches.
    values: dict[str, Any]
    free: tuple[str, ...]  # tracked quantities
    covariance: Array  # of the coordinates of these, shape (p, p)
    # Deviations of the coordinates of a block that was never identified, shape (p,); they limit
    # the range and the drift of estimates, since a block changes after its identification.
    spread: Array
    suspects: tuple[int, ...] = ()  # indices of suspects
    named: int = 0  # number of named quantities, which come first
    before: SensorBefore | None = None  # of a sensor that may have changed

    @classmethod
    def nominal(
            cls, actuator: ActuatorParameters, free: Sequence[str] = TRACKED, *,
            suspects: bool = False, others: Mapping[str, float] | None = None,
            deviations: Mapping[str, float] | None = None,
            without: Sequence[str] = ()) -> 'Prior':
        """
        Return the prior of a block that was never identified.

        With suspects, those of `SUSPECTS` are tracked too, ``without`` some. ``others`` are values
        of coil and sensor that differ from the defaults, and ``deviations`` replace some of
        `DEVIATIONS`, in SI units. Raise `BadInputError` with the name that is unknown or cannot be
        tracked.
        """
        free = check_free(free, actuator.law)
        wrong = [x for x in free if x in _NOT_TRACKED or x not in DEVIATIONS]
        if wrong:
            raise BadInputError(
                f'{", ".join(wrong)} cannot be tracked: expected some of '
                + ', '.join(x for x in DEVIATIONS if x not in _NOT_TRACKED))
        elastic = actuator.energy is not None
        if elastic and 'chain_limit' in free:
            raise BadInputError(
                'chain_limit cannot be tracked with a finite bulk_ratio: expected the others')
        named = len(free)
        if suspects:
            free = (*free, *(
                x for x in SUSPECTS if x not in free and x not in without
                and not (x == 'chain_limit' and elastic)
                and not (x.startswith('viscoelastic') and any(actuator.creep.ratios))))
        values: dict[str, Any] = complete(values_of(actuator, others), free)
        values['viscoelastic_time'] = _RELAXATION * actuator.time_unit
        if actuator.creep:
            values['creep'] = actuator.creep.held
        if 'chain_limit' in free:
            values['chain_limit'] = min(values['chain_limit'], 1e9)
        size, given = [], deviations or {}
        thermal = actuator.thermal
        steepest = max(abs(getattr(thermal, x)) for x in BLOCK_COEFFICIENTS)
        values |= {'thermal': thermal, TEMPERATURE: thermal.ambient, WARMED: 0.0} | {
            x: THERMAL[x].default for x in _INEXACT}
        for name in free:
            deviation = given.get(name, DEVIATIONS[name])
            if name == 'constant_force' and name not in given:
                deviation /= actuator.load_per_newton
            elif name in ('sensor_latency', 'coil_time_constant') and name not in given:
                deviation *= actuator.time_unit
            elif name == 'damping_coefficient':
                deviation *= max(values[name], _LEAST_ZETA * actuator.damping_unit)
            elif name == 'chain_limit':
                deviation *= max(1.0 / values[name], _LEAST_LIMIT)
            check_number(f'the deviation of {name}', deviation, above=0.0)
            size.append(deviation)
        spread = size.copy()
        if steepest:
            free = (*free, TEMPERATURE, *_INEXACT)
            size += [_GIVEN, *_INEXACT.values()]
            spread += [min(_WIDEST, 0.25 * (1.0 - _LEAST_FACTOR) / steepest), *_INEXACT.values()]
        return cls(
            values, free, np.diag(np.square(size)), np.array(spread), tuple(
                i for i, x in enumerate(free) if x not in THERMAL and (
                    i >= named or x in _AS_GIVEN)) if suspects else (), named)

    @classmethod
    def of_changed_sensor(
            cls, actuator: ActuatorParameters, free: Sequence[str], known: Known, *,
            others: Mapping[str, float], bias: tuple[float, float]) -> 'Prior':
        """
        Return the prior where bias and gain of the sensor may be anything; see `nominal`.

        ``bias`` is that before, and its standard deviation.
        """
        found = cls.nominal(
            actuator, tuple(dict.fromkeys(x for x in (*free, *_CHANGED) if x not in _HIDDEN)),
            suspects=True, others=others, deviations=_CHANGED, without=_HIDDEN)
        kept = [i for i, x in enumerate(known.names) if x not in _SENSED]
        found = found.informed(Known(
            tuple(known.names[i] for i in kept), (), known.covariance[np.ix_(kept, kept)]))
        found.values['stretch_bias'] = bias[0]
        places = tuple(found.free.index(x) for x in _CHANGED)
        # The bias before is that at rest, and the estimated one that at zero.
        about = np.array([[1.0, found.values['stretch_gain'] * found.coordinate.rest], [0.0, 1.0]])
        sizes = np.array([[x, _ALIKE['stretch_gain']] for x in (
            min(math.hypot(bias[1], _ALIKE['stretch_bias']), _KNOWN * _JUMPED), _JUMPED)])
        before = np.array([about.T @ np.diag(x ** -2) @ about for x in sizes])
        wide = np.linalg.inv(found.covariance[np.ix_(places, places)])
        return replace(found, before=SensorBefore(
            places, coordinates(found.values, tuple(_CHANGED)), before - wide,
            0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(wide)[1])))

    @property
    def coordinate(self) -> Coordinate:
        """Kind of position that samples measure."""
        return coordinate_of(self.values['law'])

    def departures(self, z: Array) -> Array:
        """Return how far coordinates are from the values, relative to the spread, shape (p,)."""
        return np.asarray((z - coordinates(self.values, self.free)) / self.spread)

    def at_temperature(self, temperature: float) -> 'Prior':
        """Return the prior of the same block at a temperature in degrees Celsius."""
        return replace(self, values={**self.values, TEMPERATURE: temperature})

    @property
    def with_any_bias(self) -> 'Prior':
        """The prior of the same block whose sensor has jumped."""
        if 'stretch_bias' not in self.free:
            return self
        place, covariance, spread = (
            self.free.index('stretch_bias'), self.covariance.copy(), self.spread.copy())
        covariance[place, place], spread[place] = _JUMPED ** 2, _JUMPED
        return replace(self, covariance=covariance, spread=spread)

    def informed(self, known: Known) -> 'Prior':
        """
        Return the prior of a block that was identified; other quantities keep theirs.

        Parameters of block and coil keep the values of this prior.
        """
        values = dict(self.values)
        for name in _SENSED:
            value = known.value(name)
            values[name] = values[name] if value is None else value
        both = [x for x in self.free if x in known.names and (
            x not in _SENSED or known.value(x) is not None)]
        places = [known.names.index(x) for x in both]
        into = [self.free.index(x) for x in both]
        scale = np.array([derivative(x, values[x]) for x in both])
        covariance = self.covariance.copy()
        covariance[np.ix_(into, into)] = (
            known.covariance[np.ix_(places, places)] / np.outer(scale, scale))
        if 'stretch_gain' in both[self.named:] and 'stretch_bias' in both:
            # The identified gain is about 0, the suspected one about rest.
            about = np.eye(len(self.free))
            about[self.free.index('stretch_bias'), self.free.index('stretch_gain')] = (
                values['stretch_gain'] * self.coordinate.rest)
            covariance = about @ covariance @ about.T
        return replace(
            self, values=values, covariance=covariance,
            spread=np.maximum(self.spread, np.sqrt(np.diag(covariance))))
