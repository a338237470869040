"""What a flow is: the number that the compiled motion gives it, and its constants."""

from collections.abc import Callable
from dataclasses import dataclass

#: Constants of a flow at the most, as in `hmsa_ros/motion/hmsa/flow.hpp`.
FLOW_CONSTANTS = 2


@dataclass(frozen=True)
class Constant:
    """One constant of a flow, of which each branch has one."""

    name: str  #: of the parameter, after ``viscoelastic.``
    words: str  #: what it is
    minimum: float  #: closed range
    maximum: float


@dataclass(frozen=True)
class Flow:
    """How fast a branch follows the elastic force, by the stress that it holds over its ratio."""

    name: str
    kind: int
    rate: str  #: as a formula of that stress x, in units of G, and the relaxation time tau
    source: str  #: where it was published
    constants: tuple[Constant, ...] = ()
    #: From the constants to how many times as fast as the relaxation time says a branch relaxes
    #: that holds as much as the shear modulus.
    hastens: Callable[..., float] = lambda: 1.0


MAXWELL = Flow(
    'maxwell', 0, 'x/tau',
    'J. C. Simo, Comput. Methods Appl. Mech. Eng. 60, 153 (1987), '
    'doi:10.1016/0045-7825(87)90107-1')
