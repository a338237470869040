"""Extended tube: cross-linked chains of finite length in tubes of their neighbours."""

from hmsa.model.laws.formula import expm1, law_of, log, log1p, Strain, Term
from hmsa.model.laws.record import Constant


def _energy(strain: Strain, gc: Term, ge: Term, delta: Term, beta: Term) -> Term:
    d = delta ** 2
    chains = (1.0 - d) * strain.first / (1.0 - d * strain.first) + log1p(-d * strain.first)
    tubes = strain.over_stretches(lambda x: expm1(-beta * log(x)))
    return 0.5 * gc * chains + 2.0 * ge / beta ** 2 * tubes


LAW = law_of(
    'extended_tube',
    'gc/2 ((1 - delta^2) (I1 - 3)/(1 - delta^2 (I1 - 3)) + ln(1 - delta^2 (I1 - 3))) '
    '+ 2 ge/beta^2 sum (l_i^-beta - 1)',
    'M. Kaliske, G. Heinrich, Rubber Chem. Technol. 72, 602 (1999), doi:10.5254/1.3538822',
    (Constant('law.gc', 'modulus of the cross-links', minimum=0.0),
     Constant('law.ge', 'modulus of the entanglements', minimum=0.0),
     Constant('law.delta', 'inextensibility of the chains', '', minimum=0.0, maximum=1.0),
     Constant('law.beta', 'release of the tubes, from 0 to 1', '', minimum=0.0, maximum=1.0,
              above=0.0)), _energy)
