"""The plant and the state in force, waited for before the first command."""

from collections.abc import Callable, Mapping
import math

from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.errors import BadInputError
from hmsa_ros.runtime.records import Settings
from hmsa_ros.runtime.slices import Clock


class Takeover:
    """
    Waits for samples of where the joints are before the first request, and goes on from there.

    `clock` returns the time of the stamps in ns, `steady` one that timeouts are measured by,
    `observable` whether somebody may give samples, and `unheard` why nobody carries out commands.
    """

    def __init__(
            self, group: PlannerGroup, clock: Clock, steady: Clock,
            observable: Callable[[], bool], unheard: Callable[[], str]) -> None:
        self._group, self._clock, self._steady = group, clock, steady
        self._observable, self._unheard = observable, unheard
        self._until: int | None = None
        # Whether it is known where the joints are, or they are taken to rest.
        self.engaged = False
        # Stamp in ns, stretch, rate in 1/s and flux density in T of the newest of each joint.
        self._samples: dict[str, tuple[int, float, float, float]] = {}

    @property
    def waiting(self) -> bool:
        """Whether samples are waited for."""
        return self._until is not None

    def begin(self, settings: Settings) -> None:
        """Wait for samples, if there is somebody to give them or nobody is found yet at all."""
        if self.engaged or self.waiting:
            return
        if settings.takeover_timeout and (self._observable() or self._unheard()):
            self._until = self._steady() + settings.takeover_timeout
        else:
            self.engaged = True

    def observe(
            self, joint: str, stamp: int, stretch: float, rate: float,
            flux_density: float) -> None:
        """Take in a sample; one of another joint, or with a gap, does not count."""
        if joint in self._group.planners and math.isfinite(stretch + rate + flux_density):
            self._samples[joint] = stamp, stretch, rate, flux_density

    def drop(self) -> None:
        """Wait for nothing, and forget the samples."""
        self._until = None
        self._samples.clear()

    def go_on(
            self, settings: Settings, newest: Mapping[str, tuple[int, float]]) -> list[str]:
        """
        Go on from the samples there are, once there is nothing more to wait for.

        The newest change of each joint has its stamp in ns and its level in T. Returned is in a
        sentence each why samples do not count.
        """
        if self._until is None:
            return []
        now = self._clock()
        samples = {
            name: x for name, x in self._samples.items()
            if abs(now - x[0]) <= settings.takeover_max_age}
        if self._steady() <= self._until and (
                len(samples) < len(self._group.planners) or self._unheard()):
            return []
        self._until, self.engaged = None, True
        observable = self._observable()
        notes = []
        for name, planner in self._group.planners.items():
            if name not in samples:
                if observable:
                    notes.append(
                        f'no sample of joint {name} on joint_states: it is assumed at rest where '
                        'it began (initial_stretch)')
                continue
            sample, level = samples[name], newest.get(name)
            try:
                planner.take_over(
                    *sample, level[1] if level is not None and level[0] <= sample[0] else None)
            except BadInputError as error:
                notes.append(f'sample of joint {name} ignored: {error}')
        return notes
