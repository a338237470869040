"""
Dielectric: an elastomer between compliant electrodes, driven by a voltage, with the Gent model.

The coordinate is the capacitance over that at rest, ``q = l^-2`` for the stretch l along the
thickness: the energy of the charge is ``q (eps/2) (V/h)^2`` per volume, so that
``(eps/2) (V/h)^2/G`` is the load, as for a block. Sizes, density, G and J_lim are those of the
block's parameters; the remanence has no effect.
"""

from collections.abc import Mapping
import math
from typing import Any

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.laws.record import Constant, DIELECTRIC, Elastic, given, Law
from hmsa_ros.model.units import EPSILON_0

_NEEDED = ('actuator.shear_modulus', 'actuator.chain_limit')


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    if any(x not in values for x in _NEEDED):
        raise BadInputError(
            f'law {LAW.name} has no nondimensional constants: expected the parameter file of a '
            'dielectric actuator, as hmsa init --dielectric writes it (--params-file)')
    permittivity, layer = (float(values[x.name]) for x in LAW.constants)
    for constant, value in zip(LAW.constants, (permittivity, layer), strict=True):
        if not value > 0.0:
            raise BadInputError(f'parameter {constant.name} is {value:g}: expected more than 0')
    modulus, limit = (float(values[x]) for x in _NEEDED)
    limit *= values.get('mismatch.chain_limit', 1.0)
    if not limit > 0.0:
        raise BadInputError(
            f'parameter actuator.chain_limit is {limit:g}: expected more than 0, or inf')
    from hmsa_ros.model.law import gent_limits  # imports NumPy, which not all users of laws need

    least, largest = (float(x) for x in gent_limits(1.0 / limit))
    return modulus, Elastic(
        LAW.name, DIELECTRIC, (1.0 / limit,), given(LAW, values, modulus),
        (largest ** -2 or 1e-6, least ** -2 if least else 1e6),
        volts=layer * math.sqrt(2.0 / permittivity / EPSILON_0))


LAW = Law(
    'dielectric', '-(G J/2) ln(1 - (I1 - 3)/J), and the voltage does work',
    'X. Zhao, Z. Suo, Appl. Phys. Lett. 91, 061921 (2007), doi:10.1063/1.2768641 (the voltage)',
    (Constant('law.permittivity', 'permittivity of the elastomer over that of vacuum', '', float,
              0.0, 1e4),
     Constant('law.layer_thickness', 'thickness at rest of a layer between two electrodes', 'm',
              float, 0.0, 1e3)),
    _scaled, own_modulus=False)
