"""
Compile or load what plans and simulates, before the first request.

The first use after an installation compiles for about a minute, and the first use in a process
loads for some tenths of a second.
"""

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np

from hmsa_ros.core import law
from hmsa_ros.core.compiling import announced
from hmsa_ros.core.creep import Creep
from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.planner import Options, Planner
from hmsa_ros.core.simulation import ActuatorSimulation
from hmsa_ros.core.two_step import plan_two_step_batch
from hmsa_ros.ending import ENDING

_MILLISECOND = 1_000_000
# What reaches every kernel with every type of argument.
_DELIVERIES = (
    Options(flux_density_min=-0.5, flux_density_max=0.5),
    Options(shaper='minimum_time'),
    Options(shaper='robust', slew_limit=100.0),
    Options(shaper='zvd', period=_MILLISECOND),
    Options(coil_time_constant=5e-4),
)
# Measured on two cores: 40 s, and 100 s beside nodes.
_COMPILING = (
    'compiling the numerical kernels: once after an installation, for about a minute, and longer '
    'on a busy machine')
_CREEP = Creep((0.1,), (0.1,))


def warm_up(
        say: Callable[[str], object] = lambda _: None, *, batch: bool = False,
        creep: bool = False, planning: bool = True) -> float:
    """
    Run every kernel once; return the seconds that it took.

    ``say`` gets a sentence before the first kernel is compiled, if one must be. ``batch`` adds the
    parallel kernel, which no node uses; ``creep`` those for an elastomer that creeps; ``planning``
    those that plan, which no plant uses. A noted signal that asks for the end is a
    `KeyboardInterrupt`.
    """
    begin = perf_counter()
    with announced(lambda _: say(_COMPILING)):
        if planning:
            _run(batch=batch)
        else:
            _simulate(Creep())
        if creep:
            _simulate(_CREEP)
        if creep and planning:
            planner = Planner(replace(paper_actuator(), creep=_CREEP), Options(lead_time=0))
            planner.setpoint(1.2, 0)
            planner.setpoint(1.1, _MILLISECOND)
    return perf_counter() - begin


def _run(*, batch: bool) -> None:
    for options in _DELIVERIES:
        # Compiling takes seconds: a process that is to end does so in between.
        ENDING.check()
        planner = Planner(paper_actuator(), replace(options, lead_time=0))
        plant = ActuatorSimulation(paper_actuator())
        for now, stretch in ((0, 1.2), (_MILLISECOND, 1.1)):
            planner.setpoint(stretch, now)
            for level in planner.due(now):
                plant.command(level.stamp, level.flux_density)
            plant.advance(now + _MILLISECOND)
        last = planner.stop(2 * _MILLISECOND).levels[-1]
        # As in a preview of several joints.
        last.sample((last.stamp, last.stamp + _MILLISECOND))
    # Asked for only of an actuator at rest on its target.
    law.elastic_stiffness(1.0, paper_actuator().nondimensional.packed)
    if batch:
        plan_two_step_batch(1.0, np.array([1.1, 1.2]))


def _simulate(creep: Creep) -> None:
    plant = ActuatorSimulation(paper_actuator(), creep=creep)
    plant.command(0, 0.01)
    plant.advance(_MILLISECOND)
