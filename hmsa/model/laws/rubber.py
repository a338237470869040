"""
Hyperelastic models of rubber: constants, source and energy of each.

An energy is a function in Python (`hmsa.model.laws.formula`) or compiled in
`hmsa/motion/hmsa/law.hpp`, where it is faster.
"""

from collections.abc import Mapping
from typing import Any

from hmsa.errors import BadInputError, excerpt
from hmsa.model.laws import record
from hmsa.model.laws.formula import expm1, law_of, log, log1p, Strain, Term
from hmsa.model.laws.record import (
    above,
    Constant,
    Elastic,
    given,
    Law,
    polynomial,
    positive_modulus,
)

GENT = Law(
    'gent', '-(G J/2) ln(1 - (I1 - 3)/J)',
    'A. N. Gent, Rubber Chem. Technol. 69, 59 (1996), doi:10.5254/1.3538357')

NEO_HOOKEAN = Law(
    'neo_hookean', '(G/2) (I1 - 3)',
    'R. S. Rivlin, Philos. Trans. R. Soc. A 240, 459 (1948), doi:10.1098/rsta.1948.0002',
    endless=True)


def _mooney_rivlin(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    c10, c01 = float(values['law.c10']), float(values['law.c01'])
    modulus = positive_modulus(MOONEY_RIVLIN.name, 2.0 * (c10 + c01), '2 (c10 + c01)', (c10, c01))
    return modulus, polynomial(MOONEY_RIVLIN, values, modulus, (c10,), c01)


MOONEY_RIVLIN = Law(
    'mooney_rivlin', 'c10 (I1 - 3) + c01 (I2 - 3)',
    'M. Mooney, J. Appl. Phys. 11, 582 (1940), doi:10.1063/1.1712836',
    (Constant('law.c10', 'factor of I1 - 3', place=1),
     Constant('law.c01', 'factor of I2 - 3', place=0)), _mooney_rivlin)


def _yeoh(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    factors = tuple(float(values[x.name]) for x in YEOH.constants)
    modulus = positive_modulus(YEOH.name, 2.0 * factors[0], '2 c10', factors)
    return modulus, polynomial(YEOH, values, modulus, factors)


YEOH = Law(
    'yeoh', 'c10 (I1 - 3) + c20 (I1 - 3)^2 + c30 (I1 - 3)^3',
    'O. H. Yeoh, Rubber Chem. Technol. 66, 754 (1993), doi:10.5254/1.3538343',
    (Constant('law.c10', 'factor of I1 - 3', place=1),
     Constant('law.c20', 'factor of (I1 - 3)^2', place=2),
     Constant('law.c30', 'factor of (I1 - 3)^3', place=3)), _yeoh)


# Most terms of Ogden.
_MOST_TERMS = 3


def _ogden(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    mu, alpha = (tuple(values[x.name]) for x in OGDEN.constants)
    if len(mu) != len(alpha) or not 1 <= len(mu) <= _MOST_TERMS:
        raise BadInputError(
            f'parameter law.mu has {len(mu)} values and law.alpha {len(alpha)}: expected 1 to '
            f'{_MOST_TERMS} of both for law {OGDEN.name}')
    if 0.0 in alpha:
        raise BadInputError(
            f'parameter law.alpha is {excerpt(list(alpha))}: expected no 0, since such a term '
            'stores no energy')
    pairs = tuple(zip(mu, alpha, strict=True))
    modulus = positive_modulus(
        OGDEN.name, 0.5 * sum(m * a for m, a in pairs), 'sum mu alpha/2', (list(mu), list(alpha)))
    return modulus, Elastic(
        OGDEN.name, record.OGDEN,
        (float(len(mu)), *(x for m, a in pairs for x in (m / modulus, a))),
        given(OGDEN, values, modulus))


OGDEN = Law(
    'ogden', 'sum mu_i/alpha_i (l^alpha_i + 2 l^(-alpha_i/2) - 3)',
    'R. W. Ogden, Proc. R. Soc. A 326, 565 (1972), doi:10.1098/rspa.1972.0026',
    (Constant('law.mu', 'moduli of the terms', kind=list, place=1),
     Constant('law.alpha', 'exponents of the terms', '', list, -50.0, 50.0, place=2)), _ogden)


# Factors of (I1^i - 3^i)/lambda_m^(2 i - 2) for i from 1 on.
_CHAINS = (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)


def _arruda_boyce(values: Mapping[str, Any]) -> tuple[float, Elastic]:
    mu, lambda_m = values['law.mu'], float(values['law.lambda_m'])
    if len(mu) != 1:
        raise BadInputError(
            f'parameter law.mu has {len(mu)} values: expected one for law {ARRUDA_BOYCE.name}')
    above(ARRUDA_BOYCE.name, 'law.lambda_m', lambda_m, 1.0)
    modulus = positive_modulus(
        ARRUDA_BOYCE.name, 2.0 * mu[0] * sum(
            i * term * (3.0 / lambda_m ** 2) ** (i - 1) for i, term in enumerate(_CHAINS, 1)),
        'mu (1 + 3/(5 lambda_m^2) + ...)', (mu[0], lambda_m))
    return modulus, Elastic(
        ARRUDA_BOYCE.name, record.ARRUDA_BOYCE, (mu[0] / modulus, lambda_m),
        given(ARRUDA_BOYCE, values, modulus))


ARRUDA_BOYCE = Law(
    'arruda_boyce', 'mu sum C_i lambda_m^(2 - 2 i) (I1^i - 3^i), i = 1 to 5',
    'E. M. Arruda, M. C. Boyce, J. Mech. Phys. Solids 41, 389 (1993), '
    'doi:10.1016/0022-5096(93)90013-6',
    (Constant('law.mu', 'modulus of the chains', kind=list, place=0),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3,
              place=1, inverse=True)), _arruda_boyce)


def _nonaffine(strain: Strain, gc: Term, ge: Term, lambda_m: Term) -> Term:
    n = lambda_m ** 2
    return gc * (strain.first / 6.0 - n * log1p(-strain.first / (3.0 * (n - 1.0)))) + (
        ge * strain.over_stretches(lambda x: (x - 1.0) ** 2 / x))


NONAFFINE = law_of(
    'nonaffine',
    'gc (I1/6 - lambda_m^2 ln(3 lambda_m^2 - I1)) + ge sum (l_i + 1/l_i)',
    'J. D. Davidson, N. C. Goulbourne, J. Mech. Phys. Solids 61, 1784 (2013), '
    'doi:10.1016/j.jmps.2013.03.009',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3,
              above=1.0, inverse=True)), _nonaffine)


def _extended_tube(strain: Strain, gc: Term, ge: Term, delta: Term, beta: Term) -> Term:
    d = delta ** 2
    chains = (1.0 - d) * strain.first / (1.0 - d * strain.first) + log1p(-d * strain.first)
    tubes = strain.over_stretches(lambda x: expm1(-beta * log(x)))
    return 0.5 * gc * chains + 2.0 * ge / beta ** 2 * tubes


EXTENDED_TUBE = law_of(
    'extended_tube',
    'gc/2 ((1 - delta^2) (I1 - 3)/(1 - delta^2 (I1 - 3)) + ln(1 - delta^2 (I1 - 3))) '
    '+ 2 ge/beta^2 sum (l_i^-beta - 1)',
    'M. Kaliske, G. Heinrich, Rubber Chem. Technol. 72, 602 (1999), doi:10.5254/1.3538822',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0),
     Constant('law.delta', 'inextensibility of the chains', '', minimum=0.0, maximum=1.0),
     Constant('law.beta', 'release of the tubes, from 0 to 1', '', minimum=0.0, maximum=1.0,
              above=0.0)), _extended_tube)
