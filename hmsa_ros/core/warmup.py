"""
Compile and cache the kernels: ``python -m hmsa_ros.core.warmup``.

The first use after an installation compiles for some seconds; set-up commands run this, so
that no running planner has to.
"""

import sys
from time import perf_counter

import numpy as np


def main() -> int:
    """
    Compile what the package uses and say so.

    Returns
    -------
    int
        Exit status 0.

    """
    print('compiling the numerical kernels (once, some seconds) ...', flush=True)
    begin = perf_counter()
    from hmsa_ros.core.parameters import NondimensionalParameters, paper_actuator
    from hmsa_ros.core.planner import Options, Planner
    from hmsa_ros.core.simulation import simulate
    from hmsa_ros.core.two_step import plan_two_step_batch

    planner = Planner(paper_actuator(), Options())
    planner.request([(1.1, 100_000_000)], None, 0)
    planner.stop(50_000_000)
    plan_two_step_batch(1.0, np.array([1.1, 1.2]))
    simulate([0.0], [0.1], [0.0, 1.0], NondimensionalParameters())
    print(f'done in {perf_counter() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
