"""
Settings of the rows of a sweep: columns, in one of two systems of units.

Dimensionless columns define a block directly. Those in SI units are parameters of the nodes, which
override those of a parameter file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
import math
import sys
from typing import Any

from hmsa.interfaces.actuator import completed, model_from
from hmsa.interfaces.parameters import LAW, LAW_NAME, ParameterSpec, PLANNED
from hmsa.model.delivery import Delivery
from hmsa.model.laws import LAWS
from hmsa.model.mismatch import Errors, Uncertainty
from hmsa.model.moves import Limits
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.units import NANOSECONDS, Units
from hmsa.planning.scales import USUAL_MOVE
from hmsa.planning.shapers.request import ERRORS

#: Minimum and maximum value of a column.
Range = tuple[float, float]

#: The largest finite number.
FINITE = sys.float_info.max

_INF = math.inf
_POSITIVE = (math.ulp(0.0), FINITE)
_MODULUS = 'actuator.shear_modulus'
#: Prefix of the columns of the actuator, instead of that of a block's parameters.
ACTUAL, BLOCK_OF = 'actual.', 'actuator.'


def _ranges(specs: tuple[ParameterSpec, ...]) -> dict[str, Range]:
    """Return the ranges of numeric parameters."""
    return {
        x.name: (
            -_INF if x.minimum is None else x.minimum, _INF if x.maximum is None else x.maximum)
        for x in specs if isinstance(x.default, float)}


@dataclass(frozen=True)
class Setting:
    """A block and its delivery, as in `hmsa.planning.timeline.JointModel`."""

    material: NondimensionalParameters
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = field(default_factory=Delivery)
    units: Units = field(default_factory=Units)
    errors: Uncertainty = ERRORS  #: that minimax must tolerate


@dataclass(frozen=True)
class Nondimensional:
    """Columns in the paper's units."""

    #: Columns of each row, with their defaults.
    columns = {'start': 1.0, 'target': 1.1, 'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
    #: Ranges of all possible columns.
    ranges = {
        'start': _POSITIVE, 'target': _POSITIVE, 'zeta': (0.0, FINITE),
        'j_lim': (_POSITIVE[0], _INF), 'c1': _POSITIVE, 'load_min': (-_INF, _INF),
        'load_max': (-_INF, _INF), 'period': (0.0, FINITE), 'slew': (_POSITIVE[0], _INF),
        'lag': (0.0, FINITE), **_ranges(LAW)}
    #: Ranges of the columns for differences of the actuator from the model.
    actual = {
        'error.shear_modulus': (-1.0, FINITE), 'error.zeta': (-1.0, FINITE),
        'error.j_lim': (-1.0, FINITE), 'error.remanence': (-1.0, FINITE)}
    #: Columns with which hardware is not ideal, and whether it is without them.
    delivery = frozenset({'period', 'slew', 'lag'})
    ideal = True
    #: Whether results are beta and b, else tesla.
    roots = True

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return the setting of a row; only the ratios of a model's constants matter."""
        law, elastic = LAWS[values.get(LAW_NAME.name, 'gent')], None
        if law.scaled is not None:
            _, elastic = law.scaled(
                {'actuator.remanence': 1.0, **{x.name: x.default for x in LAW}, **values})
        return Setting(
            NondimensionalParameters(
                values['zeta'], _INF if law.endless else values['j_lim'], values['c1'], elastic),
            Limits(values.get('load_min', -_INF), values.get('load_max', _INF)),
            Delivery(values.get('period', 0.0), values.get('slew', _INF),
                     lag=values.get('lag', 0.0)))

    def carried(self, values: Mapping[str, Any]) -> Setting:
        """Return the actuator of a row, with its units relative to those of the model."""
        planned = self.setting(values)
        errors = Errors(**{x.removeprefix('error.'): values.get(x, 0.0) for x in self.actual})
        return Setting(
            errors.actual(planned.material), units=Units(1.0 / errors.faster, errors.stiffer),
            delivery=errors.delivery(planned.delivery))


@dataclass(frozen=True)
class InSI:
    """Columns in seconds, tesla and parameters of the nodes; otherwise as `Nondimensional`."""

    actual = {
        f'{ACTUAL}{x.removeprefix(BLOCK_OF)}': y for x, y in _ranges(PLANNED).items()
        if x not in ('flux_density_min', 'flux_density_max')}
    delivery = frozenset({'command_period', 'slew_limit', 'coil_time_constant'})
    roots = False

    known: Mapping[str, Any]  #: of PLANNED and of creep, and points of a model from a file
    errors: Uncertainty = ERRORS  #: that minimax must tolerate

    @classmethod
    def of(cls, values: Mapping[str, Any], errors: Uncertainty = ERRORS) -> 'InSI':
        """Return the system for parameters, with the points of a file that they name."""
        return cls({**values, **completed(values)}, errors)

    @cached_property
    def _rest(self) -> float:
        return model_from(self.known, None, 0).material.rest

    @property
    def columns(self) -> Mapping[str, float]:
        """Columns of each row: by default a move from rest."""
        return {'start': self._rest, 'target': self._rest + USUAL_MOVE}

    @property
    def ranges(self) -> Mapping[str, Range]:
        """Ranges of all possible columns; a beam bends to either side."""
        place = _POSITIVE if self._rest else (-FINITE, FINITE)
        return {'start': place, 'target': place, **_ranges(PLANNED), 'command_period': (0.0, 1e3)}

    @property
    def ideal(self) -> bool:
        """Whether commands apply at any time and at once, to a block without creep."""
        return not any(self.known.get(x) for x in (
            'slew_limit', 'coil_time_constant', 'viscoelastic.ratio'))

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return the setting of a row; a modulus scales the constants of a model."""
        model = model_from(
            {**self.known, **values}, values.get(_MODULUS),
            round(values.get('command_period', 0.0) * NANOSECONDS))
        return Setting(
            model.material, model.limits, model.delivery, model.units, self.errors)

    def carried(self, values: Mapping[str, Any]) -> Setting:
        """Return the actuator of a row; values that are not given are those of the plan."""
        names = {x.removeprefix(BLOCK_OF): x for x in _ranges(PLANNED)}
        given = {names[x.removeprefix(ACTUAL)]: y for x, y in values.items()
                 if x.startswith(ACTUAL)}
        planned = {x: y for x, y in values.items() if not x.startswith(ACTUAL)}
        return self.setting({**planned, **given})


System = Nondimensional | InSI
