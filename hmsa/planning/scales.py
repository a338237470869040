"""Derived quantities of an actuator: times, damping, flux densities and reach."""

from dataclasses import dataclass
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import (
    critical_zeta,
    elastic_force,
    equilibrium_stretch,
    stretch_limits,
)
from hmsa.model.law import boundary
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.status import Code
from hmsa.planning.two_step import CODES, Groups, plan_two_step, plan_two_step_batch

#: Stretches and beam deflections whose flux density is listed if the coil reaches them.
STRETCHES = (0.6, 0.8, 0.9, 1.05, 1.1, 1.2, 1.4, 2.0)
DEFLECTIONS = (0.05, 0.1, 0.2, 0.4, 0.6, 0.7, 0.78)
#: Size of the move from rest whose duration is reported if the coil allows it.
USUAL_MOVE = 0.1
# Points of the first search for the reach on either side.
_LOOK = 400
# Damping, relative to critical damping where the block is stiffest, above which no step overshoots
# and no two-step command exists; a search for one would take long.
_OVERDAMPED = 3.0


@dataclass(frozen=True)
class Scales:
    """Derived quantities of an actuator and the range of its coil."""

    time_unit: float  #: L sqrt(rho/G) in s
    frequency: float  #: undamped, at rest without field, in Hz
    c1: float  #: shape 2 H^2/L^2
    zeta: float
    critical_zeta: float  #: above it, small motion about rest does not oscillate
    damping: float  #: zeta as a coefficient in N s/m
    critical_damping: float
    flux_density_unit: float  #: level of the dimensionless load 1, mu0 G/Br in T
    #: Stretches within reach of the coil, and the levels that hold them.
    flux_densities: tuple[tuple[float, float], ...]
    stretch_limits: tuple[float, float]  #: between which the force increases
    held: tuple[float, float]  #: minimum and maximum stretch that the coil can hold
    #: Minimum and maximum stretch that a two-step command reaches from rest; rest if none.
    reached: tuple[float, float]
    target: float  #: of a usual move from rest; NaN for none
    duration: float  #: of the two-step command for it, in s


def scales(actuator: ActuatorParameters, least: float, most: float) -> Scales:
    """
    Compute the derived quantities of parameters and the range of a coil in T.

    Ramps and creep are neglected. Raise `BadInputError` if the range is empty or infinite.
    """
    if not -math.inf < least < most < math.inf:
        raise BadInputError(
            f'flux densities from {least:g} to {most:g} T: expected the minimum below the maximum')
    material = actuator.nondimensional.elastic
    home = material.rest
    units = actuator.units
    loads = units.of_level(least), units.of_level(most)
    lower, upper = stretch_limits(material)
    held = tuple(float(equilibrium_stretch(x, material)) for x in loads)

    def duration(target: float) -> float:
        plan = plan_two_step(home, target, material, load_limits=loads)
        within = loads[0] <= min(plan.beta_p, plan.beta_1) and max(
            plan.beta_p, plan.beta_1) <= loads[1]
        return plan.tau_p if plan.code is Code.TWO_STEP and within else math.nan

    def reach(end: float) -> float:
        # Quadratic spacing, so that stretches near rest are resolved.
        targets = home + (end - home) * np.linspace(0.0, 1.0, _LOOK + 1)[1:] ** 2
        if material.zeta > _OVERDAMPED * np.max(critical_zeta(targets, material)):
            return home
        plans = plan_two_step_batch(
            home, targets,
            Groups(zeta=material.zeta, j_lim=material.j_lim, c1=material.c1, elastic=material.law),
            load_limits=loads)
        both = np.stack([plans.beta_p, plans.beta_1])
        good = np.array([CODES[x] is Code.TWO_STEP for x in plans.status.tolist()]) & np.all(
            (both >= loads[0]) & (both <= loads[1]), axis=0)
        found = np.flatnonzero(good)
        if not len(found):
            return home
        last = int(found[-1])
        beyond = targets[last + 1] if last + 1 < len(targets) else end
        return boundary(
            lambda x: math.isfinite(duration(x)), float(targets[last]), float(beyond))

    reached = tuple(reach(x) if abs(x - home) > 1e-12 else home for x in held)
    # Otherwise half of the way, or all of it, on the side that reaches further.
    end = max(reached, key=lambda x: abs(math.log(x)) if home else abs(x))
    target = next((x for x in (home + USUAL_MOVE, 0.5 * (home + end), end)
                   if x != home and math.isfinite(duration(x))), math.nan)
    tau = duration(target) if math.isfinite(target) else math.nan
    critical = float(critical_zeta(home, material))
    return Scales(
        time_unit=actuator.time_unit,
        frequency=1.0 / actuator.period,
        c1=actuator.geometry.c1, zeta=material.zeta, critical_zeta=critical,
        damping=actuator.damping_coefficient,
        critical_damping=critical * actuator.damping_unit, flux_density_unit=units.load,
        flux_densities=tuple(
            (x, float(units.level(elastic_force(x, material))))
            for x in _shown(held[0], held[1], home)),
        stretch_limits=(lower, upper), held=(held[0], held[1]),
        reached=(reached[0], reached[1]), target=target,
        duration=tau * actuator.time_unit)


def _shown(least: float, largest: float, home: float) -> tuple[float, ...]:
    """Return the usual stretches that a coil holds, or else half and all of its reach."""
    usual = tuple(x for x in (STRETCHES if home else DEFLECTIONS) if least <= x <= largest)
    return usual or tuple(
        home + share * (end - home) for end, share in (
            (least, 1.0), (least, 0.5), (largest, 0.5), (largest, 1.0)) if end != home)
