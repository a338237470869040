"""
What the rows of a sweep are planned with: columns, in one of two systems of units.

Nondimensional columns make a block at once. Those in SI units are parameters of the nodes, on top
of what a parameter file says.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
import math
import sys
from typing import Any

from hmsa_ros.interfaces.actuator import completed, model_from
from hmsa_ros.interfaces.parameters import LAW, LAW_NAME, ParameterSpec, PLANNED
from hmsa_ros.model.delivery import Delivery
from hmsa_ros.model.laws import LAWS
from hmsa_ros.model.mismatch import Errors, Uncertainty
from hmsa_ros.model.moves import Limits
from hmsa_ros.model.parameters import NondimensionalParameters
from hmsa_ros.model.units import NANOSECONDS, Units
from hmsa_ros.planning.scales import USUAL_MOVE
from hmsa_ros.planning.shapers.request import ERRORS

#: Least and largest value of a column.
Range = tuple[float, float]

#: The largest number.
FINITE = sys.float_info.max

_INF = math.inf
_POSITIVE = (math.ulp(0.0), FINITE)
_MODULUS = 'actuator.shear_modulus'
#: Begin of the columns of the actuator, in place of that of a block's parameters.
ACTUAL, BLOCK_OF = 'actual.', 'actuator.'


def _ranges(specs: tuple[ParameterSpec, ...]) -> dict[str, Range]:
    """Return the ranges of parameters that are numbers."""
    return {
        x.name: (
            -_INF if x.minimum is None else x.minimum, _INF if x.maximum is None else x.maximum)
        for x in specs if isinstance(x.default, float)}


@dataclass(frozen=True)
class Setting:
    """A block, and how commands reach it, as in `hmsa_ros.planning.timeline.Model`."""

    material: NondimensionalParameters
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = field(default_factory=Delivery)
    units: Units = field(default_factory=Units)
    errors: Uncertainty = ERRORS  #: for which minimax plans


@dataclass(frozen=True)
class Nondimensional:
    """The paper's units."""

    #: Columns that each row has, with the value of what is not given.
    columns = {'start': 1.0, 'target': 1.1, 'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
    #: Of all columns that a row may have.
    ranges = {
        'start': _POSITIVE, 'target': _POSITIVE, 'zeta': (0.0, FINITE),
        'j_lim': (_POSITIVE[0], _INF), 'c1': _POSITIVE, 'load_min': (-_INF, _INF),
        'load_max': (-_INF, _INF), 'period': (0.0, FINITE), 'slew': (_POSITIVE[0], _INF),
        'lag': (0.0, FINITE), **_ranges(LAW)}
    #: Ranges of the columns in which the actuator differs from what is planned with.
    actual = {
        'error.shear_modulus': (-1.0, FINITE), 'error.zeta': (-1.0, FINITE),
        'error.j_lim': (-1.0, FINITE), 'error.remanence': (-1.0, FINITE)}
    #: Columns with which hardware is not ideal, and whether it is without them.
    delivery = frozenset({'period', 'slew', 'lag'})
    ideal = True
    #: Whether results are beta and b, else tesla.
    roots = True

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return what a row is planned with; only the ratios of a law's constants count."""
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
        """Return the actuator of a row, its units in those of the model."""
        planned = self.setting(values)
        errors = Errors(**{x.removeprefix('error.'): values.get(x, 0.0) for x in self.actual})
        return Setting(
            errors.actual(planned.material), units=Units(1.0 / errors.faster, errors.stiffer),
            delivery=errors.delivery(planned.delivery))


@dataclass(frozen=True)
class InSI:
    """Seconds, tesla and the parameters of the nodes; otherwise as `Nondimensional`."""

    actual = {
        f'{ACTUAL}{x.removeprefix(BLOCK_OF)}': y for x, y in _ranges(PLANNED).items()
        if x not in ('flux_density_min', 'flux_density_max')}
    delivery = frozenset({'command_period', 'slew_limit', 'coil_time_constant'})
    roots = False

    known: Mapping[str, Any]  #: of PLANNED and of creep, and points of a law from a file
    errors: Uncertainty = ERRORS  #: for which minimax plans

    @classmethod
    def of(cls, values: Mapping[str, Any], errors: Uncertainty = ERRORS) -> 'InSI':
        """Return the system of parameters, with the points of the file that they name."""
        return cls({**values, **completed(values)}, errors)

    @cached_property
    def _rest(self) -> float:
        return model_from(self.known, None, 0).material.rest

    @property
    def columns(self) -> Mapping[str, float]:
        """Those that each row has: a move from rest, unless given."""
        return {'start': self._rest, 'target': self._rest + USUAL_MOVE}

    @property
    def ranges(self) -> Mapping[str, Range]:
        """Of all columns that a row may have; a beam bends to either side."""
        place = _POSITIVE if self._rest else (-FINITE, FINITE)
        return {'start': place, 'target': place, **_ranges(PLANNED), 'command_period': (0.0, 1e3)}

    @property
    def ideal(self) -> bool:
        """Whether commands apply at any time and at once, to a block that does not creep."""
        return not any(self.known.get(x) for x in (
            'slew_limit', 'coil_time_constant', 'viscoelastic.ratio'))

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return what a row is planned with; a modulus scales the constants of a law."""
        model = model_from(
            {**self.known, **values}, values.get(_MODULUS),
            round(values.get('command_period', 0.0) * NANOSECONDS))
        return Setting(
            model.material, model.limits, model.delivery, model.units, self.errors)

    def carried(self, values: Mapping[str, Any]) -> Setting:
        """Return the actuator of a row: what is not given of it is as in the plan."""
        names = {x.removeprefix(BLOCK_OF): x for x in _ranges(PLANNED)}
        given = {names[x.removeprefix(ACTUAL)]: y for x, y in values.items()
                 if x.startswith(ACTUAL)}
        planned = {x: y for x, y in values.items() if not x.startswith(ACTUAL)}
        return self.setting({**planned, **given})


System = Nondimensional | InSI
