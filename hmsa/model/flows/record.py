"""Record of a flow rule: its number in the compiled motion, and its constants."""

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
