"""Yeoh: a cubic in the first invariant."""

from collections.abc import Mapping
from typing import Any

from hmsa.model.laws.record import Constant, Elastic, Law, polynomial, positive_modulus


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    factors = tuple(float(values[x.name]) for x in LAW.constants)
    modulus = positive_modulus(LAW.name, 2.0 * factors[0], '2 c10', factors)
    return modulus, polynomial(LAW, values, modulus, factors)


LAW = Law(
    'yeoh', 'c10 (I1 - 3) + c20 (I1 - 3)^2 + c30 (I1 - 3)^3',
    'O. H. Yeoh, Rubber Chem. Technol. 66, 754 (1993), doi:10.5254/1.3538343',
    (Constant('law.c10', 'factor of I1 - 3', place=1),
     Constant('law.c20', 'factor of (I1 - 3)^2', place=2),
     Constant('law.c30', 'factor of (I1 - 3)^3', place=3)), _scaled)
