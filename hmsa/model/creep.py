"""
Viscoelasticity: up to three branches in parallel with the hyperelastic model, and how they flow.

The flow rules themselves are in `hmsa/motion/hmsa/flow.hpp`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from hmsa.errors import BadInputError, check_choice, check_number

#: Maximum number of constants of a flow rule, as in `hmsa/motion/hmsa/flow.hpp`.
FLOW_CONSTANTS = 2
#: Maximum number of branches.
MOST = 3
# Minimum relaxation time, in time scales: a faster branch is equivalent to damping.
_FASTEST = 1e-3
_STIFFEST = 1e3


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


@dataclass(frozen=True)
class Creep:
    """
    Up to three viscoelastic branches of an elastomer.

    The hyperelastic model gives the force for long times; branch i adds h_i = ratio_i x_i, with
    x_i' = (dW/dl)' - flow(x_i), in units of G. With the Maxwell flow, x_i/time_i, the branches are
    a Prony series.
    """

    ratios: tuple[float, ...] = ()  #: stiffness relative to the hyperelastic model, 0 to 1000
    times: tuple[float, ...] = ()  #: relaxation times in s
    flow: str = MAXWELL.name  #: one of `hmsa.model.creep.FLOWS`
    constants: tuple[tuple[float, ...], ...] = ()  #: of the flow, each with one value per branch

    def __post_init__(self) -> None:
        """Check the values."""
        check_choice('viscoelastic.flow', self.flow, FLOWS)
        named, constants = self._named, self.law.constants
        for one, other in (('ratio', 'time'), *((x.name, 'ratio') for x in constants)):
            if len(named[one]) != len(named[other]):
                raise BadInputError(
                    f'viscoelastic.{one} has {len(named[one])} values and viscoelastic.{other} '
                    f'{len(named[other])}: expected one of each for every branch with '
                    f'viscoelastic.flow {self.flow}')
        if len(self.ratios) > MOST:
            raise BadInputError(
                f'viscoelastic.ratio and viscoelastic.time have {len(self.ratios)} values: '
                f'expected at most {MOST} branches')
        for name, least, most in (
                ('ratio', 0.0, _STIFFEST), *((x.name, x.minimum, x.maximum) for x in constants)):
            for value in named[name]:
                check_number(f'viscoelastic.{name}', value, least=least, most=most)
        for time in self.times:
            check_number('viscoelastic.time', time, 's', above=0.0)

    @property
    def _named(self) -> dict[str, tuple[float, ...]]:
        names = [x.name for x in self.law.constants]
        return {'ratio': self.ratios, 'time': self.times, **dict(
            zip(names, self.constants or ((),) * len(names), strict=True))}

    @property
    def law(self) -> Flow:
        """Flow rule of the branches."""
        return FLOWS[self.flow]

    @property
    def held(self) -> 'Creep':
        """The branches with a stiffness above 0."""
        kept = [i for i, x in enumerate(self.ratios) if x > 0.0]

        def of(values: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(values[i] for i in kept)

        return replace(
            self, ratios=of(self.ratios), times=of(self.times),
            constants=tuple(map(of, self.constants)) if kept else ())

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters that describe the branches; none without branches."""
        if not self:
            return {}
        flow = {'viscoelastic.flow': self.flow} if self.law is not MAXWELL else {}
        return {f'viscoelastic.{x}': list(y) for x, y in self._named.items()} | flow

    def rows(self) -> list[list[float]]:
        """Return the branches with a stiffness above 0 as arguments of `hmsa.motion`."""
        held, rest = self.held, [0.0] * (FLOW_CONSTANTS - len(self.law.constants) + 1)
        return [
            [ratio, 1.0 / time, float(self.law.kind), *constants, *rest]
            for ratio, time, *constants in zip(
                held.ratios, held.times, *held.constants, strict=True)]

    def __bool__(self) -> bool:
        """Return whether any branch has a stiffness above 0."""
        return any(self.ratios)

    def check(self, time_unit: float) -> None:
        """Raise `BadInputError` for branches that only damp, with a time scale in s."""
        for time, *constants in zip(self.times, *self.constants, strict=True):
            least = _FASTEST * time_unit * self.law.hastens(*constants)
            if time < least:
                raise BadInputError(
                    f'viscoelastic.time has {time:g} s: expected at least '
                    f'{least:.3g} s, {_FASTEST:g} of L sqrt(rho/G); a faster '
                    'branch is damping, which actuator.damping_coefficient has')
