"""Nonaffine network: cross-linked chains of finite length, and entanglements."""

from collections.abc import Mapping
from typing import Any

from hmsa.model.laws.record import (
    above,
    Constant,
    Elastic,
    Law,
    network,
    NONAFFINE,
    positive_modulus,
)


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    gc, ge, lambda_m = (float(values[x.name]) for x in LAW.constants)
    beyond = above(LAW.name, 'law.lambda_m', lambda_m, 1.0)**2 - 1.0
    modulus = positive_modulus(
        LAW.name, gc * (1.0 + 2.0 / (3.0 * beyond)) + ge,
        'gc (1 + 2/(3 (lambda_m^2 - 1))) + ge', (gc, ge, lambda_m))
    return modulus, network(LAW, NONAFFINE, values, modulus, (lambda_m,), 3.0 * beyond)


LAW = Law(
    'nonaffine',
    'gc (I1/6 - lambda_m^2 ln(3 lambda_m^2 - I1)) + ge sum (l_i + 1/l_i)',
    'J. D. Davidson, N. C. Goulbourne, J. Mech. Phys. Solids 61, 1784 (2013), '
    'doi:10.1016/j.jmps.2013.03.009',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0, place=0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0, place=1),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3,
              place=2, inverse=True)), _scaled)
