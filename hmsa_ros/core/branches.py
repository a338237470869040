"""Several actuators of which some creep, integrated together."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core import kernels, response_kernel
from hmsa_ros.core.creep import Creep, MOST
from hmsa_ros.core.model import Array


class Branches:
    """The branches of several actuators, and the integration of all of them."""

    def __init__(self, creeps: Sequence[Creep], time_units: Array) -> None:
        """Begin with forces of 0; units of time are in s."""
        self._creeping = np.array([bool(x) for x in creeps])
        self._work = response_kernel.work_space(MOST)
        self._branches = np.zeros((len(creeps), MOST, 3))
        for branches, creep, unit in zip(
                self._branches, creeps, time_units.tolist(), strict=True):
            held = [x for x in zip(creep.ratios, creep.times, strict=True) if x[0] > 0.0]
            for branch, (ratio, time) in zip(branches, held, strict=False):
                branch[response_kernel.RATIO] = ratio
                branch[response_kernel.SPEED] = unit / time

    def relax(self, i: int, force: float) -> None:
        """Have the branches of one hold nothing, as after a long time under an elastic force."""
        self._branches[i, :, response_kernel.FOLLOWER] = force

    def follow(
            self, work: Array, first: int, last: int, wanted: NDArray[np.bool_], state: Array,
            drive: Array, material: Array, durations: Array, rtol: float,
            status: NDArray[np.int64]) -> int:
        """Integrate as `hmsa_ros.core.kernels.follow`; return how many do not get through."""
        failed: int = kernels.follow(
            work, first, last, wanted & ~self._creeping, state, drive, material, durations, rtol,
            status)
        failed += response_kernel.follow_creeping(
            self._work, first, last, wanted & self._creeping, state, drive, material,
            self._branches, durations, rtol, status)
        return failed
