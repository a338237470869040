"""Nonaffine network: cross-linked chains of finite length, and entanglements."""

from hmsa.model.laws.formula import law_of, log1p, Strain, Term
from hmsa.model.laws.record import Constant


def _energy(strain: Strain, gc: Term, ge: Term, lambda_m: Term) -> Term:
    n = lambda_m ** 2
    return gc * (strain.first / 6.0 - n * log1p(-strain.first / (3.0 * (n - 1.0)))) + (
        ge * strain.over_stretches(lambda x: (x - 1.0) ** 2 / x))


LAW = law_of(
    'nonaffine',
    'gc (I1/6 - lambda_m^2 ln(3 lambda_m^2 - I1)) + ge sum (l_i + 1/l_i)',
    'J. D. Davidson, N. C. Goulbourne, J. Mech. Phys. Solids 61, 1784 (2013), '
    'doi:10.1016/j.jmps.2013.03.009',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0),
     Constant('law.lambda_m', 'stretch at which the chains lock', '', minimum=0.0, maximum=1e3,
              above=1.0, inverse=True)), _energy)
