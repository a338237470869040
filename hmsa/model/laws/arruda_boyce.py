"""Arruda-Boyce: eight chains, with five terms of the inverse Langevin function."""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError
from hmsa.model.laws.record import (
    above,
    ARRUDA_BOYCE,
    Constant,
    Elastic,
    given,
    Law,
    positive_modulus,
)

#: Factors of (I1^i - 3^i)/lambda_m^(2 i - 2) for i from 1 on.
TERMS = (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    mu, lambda_m = values['law.mu'], float(values['law.lambda_m'])
    if len(mu) != 1:
        raise BadInputError(
            f'parameter law.mu has {len(mu)} values: expected one for law {LAW.name}')
    above(LAW.name, 'law.lambda_m', lambda_m, 1.0)
    modulus = positive_modulus(
        LAW.name, 2.0 * mu[0] * sum(
            i * term * (3.0 / lambda_m ** 2) ** (i - 1) for i, term in enumerate(TERMS, 1)),
        'mu (1 + 3/(5 lambda_m^2) + ...)', (mu[0], lambda_m))
    return modulus, Elastic(
        LAW.name, ARRUDA_BOYCE, (mu[0] / modulus, lambda_m), given(LAW, values, modulus))


LAW = Law(
    'arruda_boyce', 'mu sum C_i lambda_m^(2 - 2 i) (I1^i - 3^i), i = 1 to 5',
    'E. M. Arruda, M. C. Boyce, J. Mech. Phys. Solids 41, 389 (1993), '
    'doi:10.1016/0022-5096(93)90013-6',
    (Constant('law.mu', 'modulus of the chains', kind=list, place=0),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3,
              place=1, inverse=True)), _scaled)
