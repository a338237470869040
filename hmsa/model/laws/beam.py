"""
Beam: clamped at one end, magnetised along its length, in a field across it.

Only the first mode is modelled, at any amplitude. The coordinate is the deflection of the tip over
the length: the work of a uniform field is that of a constant force at the tip, so that the load
is that of a block. Length and thickness are those of the block's parameters. In the units here
the beam at rest has stiffness 3 and inertia 1, as a block with c1 = 5.
"""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError
from hmsa.model.laws.record import BEAM, Constant, Elastic, given, Law, positive_modulus

#: c1 of the block that has the inertia of a beam at rest.
SHAPE = 5.0
# Maximum thickness over length of a slender beam.
_THICKEST = 0.25


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    from hmsa.model.laws import bending  # imports NumPy, which not all users of laws need

    if 'actuator.half_length' not in values:
        raise BadInputError(
            f'law {LAW.name} has no nondimensional constants: expected the parameter file of a '
            'beam, as hmsa init --beam writes it (--params-file)')
    youngs, width = (float(values[x.name]) for x in LAW.constants)
    length, thickness = (
        2.0 * float(values[f'actuator.{x}']) * values.get(f'mismatch.{x}', 1.0)
        for x in ('half_length', 'half_thickness'))
    if not thickness <= _THICKEST * length:
        raise BadInputError(
            f'the beam is {length:g} m long and {thickness:g} m thick: expected a thickness of at '
            f'most {_THICKEST:g} of the length (actuator.half_thickness, actuator.half_length)')
    if not width > 0.0:
        raise BadInputError(f'parameter law.width is {width:g} m: expected more than 0')
    modulus = positive_modulus(
        LAW.name, youngs * (bending.ROOT ** 2 * thickness / (12.0 * length)) ** 2,
        'E (0.293 h/l)^2', (f'{youngs:g} Pa', f'{width:g} m'))
    most = float(bending.deflection(bending.LARGEST_ANGLE))
    return modulus, Elastic(
        LAW.name, BEAM, bending.packed(), given(LAW, values, modulus), (-most, most), SHAPE,
        width * thickness / length ** 2)


def _completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the initial position of a beam at rest, unless it is given."""
    return {} if 'initial_stretch' in values else {'initial_stretch': 0.0}


LAW = Law(
    'beam', 'E I/2 times the integral of the squared curvature, over the volume, in one mode',
    'S. S. Rao, Vibration of Continuous Systems, Wiley 2007, ch. 11 (the mode)',
    (Constant('law.youngs_modulus', "Young's modulus E, 3 G of an elastomer", 'Pa', float, 0.0),
     Constant('law.width', 'width of the section, across field and length', 'm', float, 0.0,
              1e3)),
    _scaled, completed=_completed)
