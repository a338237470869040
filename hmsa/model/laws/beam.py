"""
Beam: clamped at one end, magnetised along its length, in a field across it.

The coordinate is the deflection of the tip over the length: the work of a uniform field is that of
a constant force at the tip, so that the load is that of a block. The bent beam has the shape of
its first mode at any amplitude, or that of the elastica, which is exact at rest. Length and
thickness are those of the block's parameters. In the units here the beam of one mode at rest has
stiffness 3 and inertia 1, as a block with c1 = 5; those of the elastica are 3 % less.
"""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError, check_number, excerpt
from hmsa.model.laws.record import (
    BEAM,
    Constant,
    Elastic,
    ELASTICA,
    given,
    Law,
    positive_modulus,
)

#: c1 of the block that has the inertia of a beam at rest.
SHAPE = 5.0
#: Shapes of a bent beam; the first is the default.
MODE, ELASTIC_CURVE = SHAPES = ('mode', 'elastica')
_SHAPE = 'law.shape'
# Maximum thickness over length of a slender beam.
_THICKEST = 0.25


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    from hmsa.model.laws import bending  # imports NumPy, which not all users of laws need

    if 'actuator.half_length' not in values:
        raise BadInputError(
            f'law {LAW.name} has no nondimensional constants: expected the parameter file of a '
            'beam, as hmsa init --beam writes it (--params-file)')
    youngs, width = (float(values[x.name]) for x in LAW.constants[:2])
    shape = values[_SHAPE] or MODE
    if shape not in SHAPES:
        raise BadInputError(
            f'parameter {_SHAPE} is {excerpt(shape)}: expected {" or ".join(SHAPES)}')
    length, thickness = (
        2.0 * float(values[f'actuator.{x}']) * values.get(f'mismatch.{x}', 1.0)
        for x in ('half_length', 'half_thickness'))
    if not thickness <= _THICKEST * length:
        raise BadInputError(
            f'the beam is {length:g} m long and {thickness:g} m thick: expected a thickness of at '
            f'most {_THICKEST:g} of the length (actuator.half_thickness, actuator.half_length)')
    check_number('parameter law.width', width, 'm', above=0.0)
    modulus = positive_modulus(
        LAW.name, youngs * (bending.ROOT ** 2 * thickness / (12.0 * length)) ** 2,
        'E (0.293 h/l)^2', (f'{youngs:g} Pa', f'{width:g} m'))
    most = float(bending.deflection(bending.LARGEST_ANGLE))
    made = given(LAW, values, modulus)
    if shape == MODE:  # not said, as before there was another
        family, constants, made = BEAM, bending.packed(), made[:-1]
    else:
        from hmsa.model.laws import elastica  # as above

        family, constants = ELASTICA, elastica.packed()
    return modulus, Elastic(
        LAW.name, family, constants, made, (-most, most), SHAPE, width * thickness / length ** 2)


def _completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the initial position of a beam at rest, unless it is given."""
    return {} if 'initial_stretch' in values else {'initial_stretch': 0.0}


LAW = Law(
    'beam', 'E I/2 times the integral of the squared curvature, over the volume',
    'S. S. Rao, Vibration of Continuous Systems, Wiley 2007, ch. 11 (the mode)',
    (Constant('law.youngs_modulus', "Young's modulus E, 3 G of an elastomer", 'Pa', float, 0.0),
     Constant('law.width', 'width of the section, across field and length', 'm', float, 0.0,
              1e3),
     Constant(_SHAPE, 'shape of the bent beam: mode, that of the first mode (default), or '
              'elastica, exact at rest', '', str)),
    _scaled, completed=_completed)
