"""Extended tube: cross-linked chains of finite length in tubes of their neighbours."""

from collections.abc import Mapping
from typing import Any

from hmsa.model.laws.record import (
    above,
    Constant,
    Elastic,
    EXTENDED_TUBE,
    Law,
    network,
    positive_modulus,
)


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    gc, ge, delta, beta = (float(values[x.name]) for x in LAW.constants)
    above(LAW.name, 'law.beta', beta, 0.0)
    modulus = positive_modulus(
        LAW.name, gc * (1.0 - 2.0 * delta**2) + ge, 'gc (1 - 2 delta^2) + ge',
        (gc, ge, delta, beta))
    return modulus, network(
        LAW, EXTENDED_TUBE, values, modulus, (delta, beta), 1.0 / max(delta, 1e-6)**2)


LAW = Law(
    'extended_tube',
    'gc/2 ((1 - delta^2) (I1 - 3)/(1 - delta^2 (I1 - 3)) + ln(1 - delta^2 (I1 - 3))) '
    '+ 2 ge/beta^2 sum (l_i^-beta - 1)',
    'M. Kaliske, G. Heinrich, Rubber Chem. Technol. 72, 602 (1999), doi:10.5254/1.3538822',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0, place=0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0, place=1),
     Constant('law.delta', 'inextensibility of the chains', '', minimum=0.0, maximum=1.0, place=2),
     Constant('law.beta', 'release of the tubes, from 0 to 1', '', minimum=0.0, maximum=1.0,
              place=3)), _scaled)
