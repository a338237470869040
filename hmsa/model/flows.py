"""
Flow rules of viscoelastic branches: their numbers in the compiled motion, and their constants.

The rules themselves are in `hmsa/motion/hmsa/flow.hpp`.
"""

from collections.abc import Callable
from dataclasses import dataclass

#: Maximum number of constants of a flow rule, as in `hmsa/motion/hmsa/flow.hpp`.
FLOW_CONSTANTS = 2


@dataclass(frozen=True)
class FlowConstant:
    """One constant of a flow rule, with one value per branch."""

    name: str  #: of the parameter, after ``viscoelastic.``
    words: str  #: description
    minimum: float  #: closed range
    maximum: float


@dataclass(frozen=True)
class Flow:
    """Flow rule: the rate at which a branch follows the elastic force, from stress over ratio."""

    name: str
    kind: int
    rate: str  #: formula in that stress x, in units of G, and the relaxation time tau
    source: str  #: publication
    constants: tuple[FlowConstant, ...] = ()
    #: Maps the constants to the relaxation rate at a stress of the shear modulus, relative to
    #: that given by the relaxation time.
    hastens: Callable[..., float] = lambda: 1.0


MAXWELL = Flow(
    'maxwell', 0, 'x/tau',
    'J. C. Simo, Comput. Methods Appl. Mech. Eng. 60, 153 (1987), '
    'doi:10.1016/0045-7825(87)90107-1')

# The flow rate increases with the stress and decreases with relaxation.
POWER_LAW = Flow(
    'power_law', 1, '(x/tau) |x/s|^(m - 1)',
    'J. S. Bergstroem, M. C. Boyce, J. Mech. Phys. Solids 46, 931 (1998), '
    'doi:10.1016/S0022-5096(97)00075-6, without its dependence on strain',
    (FlowConstant(
        'exponent',
        'exponent m of the power law with which a branch flows, 1 for a Maxwell branch',
        1.0, 20.0),
     FlowConstant(
         'stress', 'stress s, in units of the shear modulus, at which a branch that flows by a '
         'power law relaxes with its relaxation time', 1e-3, 10.0)),
    lambda exponent, stress: stress ** (1.0 - exponent))

#: Flow rules by name; the first is the default.
FLOWS: dict[str, Flow] = {x.name: x for x in (MAXWELL, POWER_LAW)}
#: Names of all constants, each once.
CONSTANTS = {x.name: x for flow in FLOWS.values() for x in flow.constants}
