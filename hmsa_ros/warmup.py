"""Compile and cache all kernels, as set-ups do: ``python -m hmsa_ros.warmup``."""

from functools import partial
import sys
from time import perf_counter

from hmsa_ros.core.warmup import warm_up
from hmsa_ros.estimation import estimator


def main() -> int:
    """Compile what the package uses, say so, and return 0."""
    begin = perf_counter()
    warm_up(partial(print, flush=True), batch=True, creep=True)
    estimator.warm_up()
    print(f'loaded the numerical kernels in {perf_counter() - begin:.1f} s')
    return 0


if __name__ == '__main__':
    sys.exit(main())
