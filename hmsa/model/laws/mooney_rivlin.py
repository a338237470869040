"""Mooney-Rivlin: linear in both invariants."""

from collections.abc import Mapping
from typing import Any

from hmsa.model.laws.record import Constant, Elastic, Law, polynomial, positive_modulus


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    c10, c01 = float(values['law.c10']), float(values['law.c01'])
    modulus = positive_modulus(LAW.name, 2.0 * (c10 + c01), '2 (c10 + c01)', (c10, c01))
    return modulus, polynomial(LAW, values, modulus, (c10,), c01)


LAW = Law(
    'mooney_rivlin', 'c10 (I1 - 3) + c01 (I2 - 3)',
    'M. Mooney, J. Appl. Phys. 11, 582 (1940), doi:10.1063/1.1712836',
    (Constant('law.c10', 'factor of I1 - 3', place=1),
     Constant('law.c01', 'factor of I2 - 3', place=0)), _scaled)
