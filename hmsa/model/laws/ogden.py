"""Ogden: one to three powers of the principal stretches."""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError, excerpt
from hmsa.model.laws.record import Constant, Elastic, given, Law, OGDEN, positive_modulus

#: Most terms.
TERMS = 3


def _scaled(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    mu, alpha = (tuple(values[x.name]) for x in LAW.constants)
    if len(mu) != len(alpha) or not 1 <= len(mu) <= TERMS:
        raise BadInputError(
            f'parameter law.mu has {len(mu)} values and law.alpha {len(alpha)}: expected 1 to '
            f'{TERMS} of both for law {LAW.name}')
    if 0.0 in alpha:
        raise BadInputError(
            f'parameter law.alpha is {excerpt(list(alpha))}: expected no 0, since such a term '
            'stores no energy')
    pairs = tuple(zip(mu, alpha, strict=True))
    modulus = positive_modulus(
        LAW.name, 0.5 * sum(m * a for m, a in pairs), 'sum mu alpha/2', (list(mu), list(alpha)))
    return modulus, Elastic(
        LAW.name, OGDEN, (float(len(mu)), *(x for m, a in pairs for x in (m / modulus, a))),
        given(LAW, values, modulus))


LAW = Law(
    'ogden', 'sum mu_i/alpha_i (l^alpha_i + 2 l^(-alpha_i/2) - 3)',
    'R. W. Ogden, Proc. R. Soc. A 326, 565 (1972), doi:10.1098/rspa.1972.0026',
    (Constant('law.mu', 'moduli of the terms', kind=list, place=1),
     Constant('law.alpha', 'exponents of the terms', '', list, -50.0, 50.0, place=2)), _scaled)
