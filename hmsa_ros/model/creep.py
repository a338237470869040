"""Creep of the elastomer: up to three branches beside the law, which flow in proportion or not."""

from dataclasses import dataclass, replace
import math
from typing import Any

from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model.flows import FLOWS
from hmsa_ros.model.flows.record import Flow, FLOW_CONSTANTS, MAXWELL

#: Branches that an elastomer may have.
MOST = 3
# A branch that is faster than this share of the unit of time damps, and nothing else.
_FASTEST = 1e-3
_STIFFEST = 1e3


@dataclass(frozen=True)
class Creep:
    """
    Up to three branches of an elastomer.

    The law is what the elastomer holds in the end; branch i adds h_i = ratio_i x_i to its force,
    with x_i' = (dW/dl)' - flow(x_i), in units of G. With the flow of Maxwell, x_i/time_i, they
    are a Prony series.
    """

    ratios: tuple[float, ...] = ()  #: stiffness in units of that of the law, 0 to 1000
    times: tuple[float, ...] = ()  #: of relaxation, in s
    flow: str = MAXWELL.name  #: one of `hmsa_ros.model.flows.FLOWS`
    constants: tuple[tuple[float, ...], ...] = ()  #: of the flow, each for every branch

    def __post_init__(self) -> None:
        """Check the values."""
        self._check_flow()
        count = max(len(self.ratios), len(self.times))
        if len(self.ratios) != len(self.times):
            raise BadInputError(
                f'viscoelastic.ratio has {len(self.ratios)} values and viscoelastic.time '
                f'{len(self.times)}: expected one of each for every branch')
        if count > MOST:
            raise BadInputError(
                f'viscoelastic.ratio and viscoelastic.time have {count} values: expected at most '
                f'{MOST} branches')
        for ratio in self.ratios:
            if not 0.0 <= ratio <= _STIFFEST:
                raise BadInputError(
                    f'viscoelastic.ratio has {ratio:g}: expected 0 to {_STIFFEST:g}')
        for time in self.times:
            if not 0.0 < time < math.inf:
                raise BadInputError(
                    f'viscoelastic.time has {time:g} s: expected finite numbers above 0')

    def _check_flow(self) -> None:
        if self.flow not in FLOWS:
            raise BadInputError(
                f'viscoelastic.flow is {excerpt(self.flow)}: expected one of {", ".join(FLOWS)}')
        constants = self.law.constants
        if len(self.constants) not in (0, len(constants)):
            raise BadInputError(
                f'creep has {len(self.constants)} constants: expected {len(constants)} of '
                f'viscoelastic.flow {self.flow}')
        for constant, values in zip(
                constants, self.constants or ((),) * len(constants), strict=True):
            if len(values) != len(self.ratios):
                raise BadInputError(
                    f'viscoelastic.{constant.name} has {len(values)} values and '
                    f'viscoelastic.ratio {len(self.ratios)}: expected one of each for every '
                    f'branch with viscoelastic.flow {self.flow}')
            for value in values:
                if not constant.minimum <= value <= constant.maximum:
                    raise BadInputError(
                        f'viscoelastic.{constant.name} has {value:g}: expected '
                        f'{constant.minimum:g} to {constant.maximum:g}')

    @property
    def law(self) -> Flow:
        """How the branches flow."""
        return FLOWS[self.flow]

    @property
    def held(self) -> 'Creep':
        """The branches that hold anything."""
        kept = [i for i, x in enumerate(self.ratios) if x > 0.0]

        def of(values: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(values[i] for i in kept)

        return replace(
            self, ratios=of(self.ratios), times=of(self.times),
            constants=tuple(map(of, self.constants)) if kept else ())

    @property
    def parameters(self) -> dict[str, Any]:
        """The parameters that describe the branches, none where there are none."""
        if not self:
            return {}
        named = {'ratio': self.ratios, 'time': self.times, **{
            x.name: y for x, y in zip(self.law.constants, self.constants, strict=True)}}
        flow = {'viscoelastic.flow': self.flow} if self.law is not MAXWELL else {}
        return {f'viscoelastic.{x}': list(y) for x, y in named.items()} | flow

    def rows(self, unit: float = 1.0) -> list[list[float]]:
        """Return the branches that hold anything as `hmsa_ros.motion` takes them; a unit in s."""
        held = self.held
        return [
            [ratio, unit / time, float(self.law.kind), *constants,
             *[0.0] * (FLOW_CONSTANTS - len(constants)), 0.0]
            for ratio, time, *constants in zip(
                held.ratios, held.times, *held.constants, strict=True)]

    def __bool__(self) -> bool:
        """Return whether there is a branch that holds anything."""
        return any(self.ratios)

    def check(self, time_unit: float) -> None:
        """Refuse with `BadInputError` what only damps, for a unit of time in s."""
        for time, *constants in zip(self.times, *self.constants, strict=True):
            least = _FASTEST * time_unit * self.law.hastens(*constants)
            if time < least:
                raise BadInputError(
                    f'viscoelastic.time has {time:g} s: expected at least '
                    f'{least:.3g} s, {_FASTEST:g} of L sqrt(rho/G); a faster '
                    'branch is damping, which actuator.damping_coefficient has')
