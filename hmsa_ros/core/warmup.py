"""
Compile and cache the kernels: ``python -m hmsa_ros.core.warmup``.

The first use after an installation compiles for some seconds, and the first use in a process
loads for some tenths of one. Set-up commands run this module, and a planner calls `warm_up`
before it takes requests.
"""

import sys
from time import perf_counter

import numpy as np

from hmsa_ros.core.delivery import Delivery
from hmsa_ros.core.moves import Limits, State
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.shapers.minimum_time import minimum_time
from hmsa_ros.core.shapers.request import Request
from hmsa_ros.core.shapers.two_step import two_step
from hmsa_ros.core.simulation import simulate
from hmsa_ros.core.two_step import plan_two_step_batch


def warm_up(*, batch: bool = False) -> float:
    """
    Run every kernel once.

    Parameters
    ----------
    batch : bool
        Also the parallel one, which no node uses.

    Returns
    -------
    float
        Seconds that it took.

    """
    begin = perf_counter()
    material = NondimensionalParameters()
    limits = Limits(-2.0, 2.0)
    two_step(Request(State(1.0), 1.1, material, limits, Delivery(slew=10.0)))
    two_step(Request(State(1.05, 0.5), 1.1, material, limits))
    minimum_time(Request(State(1.0), 1.1, material, limits))
    simulate([0.0], [0.1], [0.0, 1.0], material)
    if batch:
        plan_two_step_batch(1.0, np.array([1.1, 1.2]))
    return perf_counter() - begin


def main() -> int:
    """
    Compile what the package uses and say so.

    Returns
    -------
    int
        Exit status 0.

    """
    print('compiling the numerical kernels (once, some seconds) ...', flush=True)
    print(f'done in {warm_up(batch=True):.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
