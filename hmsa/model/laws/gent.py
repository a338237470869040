"""Gent, and neo-Hookean, its limit for infinite J_lim."""

from hmsa.model.laws.record import Law

GENT = Law(
    'gent', '-(G J/2) ln(1 - (I1 - 3)/J)',
    'A. N. Gent, Rubber Chem. Technol. 69, 59 (1996), doi:10.5254/1.3538357')

NEO_HOOKEAN = Law(
    'neo_hookean', '(G/2) (I1 - 3)',
    'R. S. Rivlin, Philos. Trans. R. Soc. A 240, 459 (1948), doi:10.1098/rsta.1948.0002',
    endless=True)
