"""Uncertainty of a block from an identification, as columns of a sweep."""

from pathlib import Path

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification.files import Belief as Known
from hmsa_studies.axes import NormalColumns

# Identified names that differ from those of the block's parameters.
_OTHERS = {'coil_time_constant': 'coil_time_constant', 'time_unit': 'actuator.density'}


def belief_of(found: Known, path: Path) -> NormalColumns:
    """Return the uncertainty of the block in a file; raise `BadInputError` if there is none."""
    numbers, known = found.actuator.numbers, found.known
    means, names, places = [], [], []
    slopes = np.eye(len(known.names))
    for place, name in enumerate(known.names):
        if name in numbers:
            column, mean = f'actuator.{name}', numbers[name]
        elif name in _OTHERS:
            column, mean = _OTHERS[name], found.others.get(name, 0.0)
        else:
            continue
        if name == 'time_unit':
            # rho = G (T/L)^2, to first order.
            mean = numbers['density']
            slopes[place, place] = 2.0 * mean / found.actuator.time_unit
            if 'shear_modulus' in known.names:
                slopes[place, known.names.index('shear_modulus')] = (
                    mean / numbers['shear_modulus'])
        names.append(column)
        means.append(mean)
        places.append(place)
    if not names:
        raise BadInputError(
            f'{path} has no covariance of the block: expected a file that hmsa identify --out '
            'wrote')
    covariance = slopes @ known.covariance @ slopes.T
    return NormalColumns(
        tuple(names), np.array(means, dtype=np.float64), covariance[np.ix_(places, places)])
