"""Creep of the elastomer: up to three Maxwell branches beside the law, a Prony series."""

from dataclasses import dataclass
import math

from hmsa_ros.errors import BadInputError

#: Branches that an elastomer may have.
MOST = 3
# A branch that is faster than this share of the unit of time damps, and nothing else.
_FASTEST = 1e-3
_STIFFEST = 1e3


@dataclass(frozen=True)
class Creep:
    """
    Up to three Maxwell branches of an elastomer.

    The law is what the elastomer holds in the end; branch i adds h_i to its force, with
    h_i' = ratio_i (dW/dl)' - h_i/time_i (J. C. Simo, Comput. Methods Appl. Mech. Eng. 60, 153
    (1987), in the force of the block).
    """

    ratios: tuple[float, ...] = ()  #: stiffness in units of that of the law, 0 to 1000
    times: tuple[float, ...] = ()  #: of relaxation, in s

    def __post_init__(self) -> None:
        """Check the values."""
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

    def __bool__(self) -> bool:
        """Return whether there is a branch that holds anything."""
        return any(self.ratios)

    def check(self, time_unit: float) -> None:
        """Refuse with `BadInputError` what only damps, for a unit of time in s."""
        for time in self.times:
            if time < _FASTEST * time_unit:
                raise BadInputError(
                    f'viscoelastic.time has {time:g} s: expected at least '
                    f'{_FASTEST * time_unit:.3g} s, {_FASTEST:g} of L sqrt(rho/G); a faster '
                    'branch is damping, which actuator.damping_coefficient has')
