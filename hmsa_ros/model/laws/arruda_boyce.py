"""Arruda-Boyce: eight chains, by the first five terms of the inverse Langevin function."""

from collections.abc import Mapping
import math
from typing import Any

from hmsa_ros.errors import BadInputError
from hmsa_ros.model.laws.record import (
    Constant,
    Elastic,
    Law,
    polynomial,
    positive_modulus,
    POWERS,
)

#: Factors of (I1^i - 3^i)/lambda_m^(2 i - 2) for i from 1 on.
TERMS = (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    mu, lambda_m = values['law.mu'], float(values['law.lambda_m'])
    if len(mu) != 1:
        raise BadInputError(
            f'parameter law.mu has {len(mu)} values: expected one for law {LAW.name}')
    if not lambda_m > 1.0:
        raise BadInputError(
            f'parameter law.lambda_m is {lambda_m:g}: expected more than 1 for law {LAW.name}')
    # I1^i - 3^i by powers of I1 - 3.
    powers = [
        mu[0] * sum(
            term / lambda_m ** (2 * i - 2) * math.comb(i, k) * 3.0 ** (i - k)
            for i, term in enumerate(TERMS, 1) if i >= k)
        for k in range(1, POWERS + 1)]
    modulus = positive_modulus(
        LAW.name, 2.0 * powers[0], 'mu (1 + 3/(5 lambda_m^2) + ...)', (mu[0], lambda_m))
    return modulus, polynomial(LAW, values, modulus, powers)


LAW = Law(
    'arruda_boyce', 'mu sum C_i lambda_m^(2 - 2 i) (I1^i - 3^i), i = 1 to 5',
    'E. M. Arruda, M. C. Boyce, J. Mech. Phys. Solids 41, 389 (1993), '
    'doi:10.1016/0022-5096(93)90013-6',
    (Constant('law.mu', 'modulus of the chains', kind=list),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3)),
    _scaled)
