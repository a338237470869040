"""The plant and the state in force, waited for before the first command."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
import math

from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.errors import BadInputError
from hmsa_ros.runtime.records import Settings
from hmsa_ros.runtime.slices import Clock


@dataclass(frozen=True)
class Sample:
    """Stretch, rate in 1/s and flux density in force in T at a stamp in ns."""

    stamp: int
    stretch: float
    rate: float
    flux_density: float

    @property
    def complete(self) -> bool:
        """Whether everything was measured."""
        return math.isfinite(self.stretch + self.rate + self.flux_density)


class Observations:
    """
    The newest sample of each joint.

    Parameters
    ----------
    joints : collection of str
        Those that count.

    """

    def __init__(self, joints: Collection[str]) -> None:
        """Begin with none."""
        self._joints = frozenset(joints)
        self._newest: dict[str, Sample] = {}

    def add(self, joint: str, sample: Sample) -> None:
        """Take in a sample; one of another joint, or with a gap, does not count."""
        if joint in self._joints and sample.complete:
            self._newest[joint] = sample

    def clear(self) -> None:
        """Forget them, as after a jump of the clock."""
        self._newest.clear()

    def fresh(self, now: int, max_age: int) -> dict[str, Sample]:
        """Return by joint the samples that are not older than an age; times in ns."""
        return {
            joint: x for joint, x in self._newest.items() if abs(now - x.stamp) <= max_age}


class Takeover:
    """
    Waits for samples of where the joints are before the first request, and goes on from there.

    Parameters
    ----------
    group : PlannerGroup
        The joints.
    clock, steady : callable
        Return the present time in ns: that of the stamps, and one that patience is measured by.
    observable : callable
        Returns whether somebody may give samples.
    unheard : callable
        Returns why nobody carries out commands; empty where somebody does.

    Attributes
    ----------
    engaged : bool
        Whether it is known where the joints are, or they are taken to rest.

    """

    def __init__(
            self, group: PlannerGroup, clock: Clock, steady: Clock,
            observable: Callable[[], bool], unheard: Callable[[], str]) -> None:
        """Begin with nothing known."""
        self._group, self._clock, self._steady = group, clock, steady
        self._observable, self._unheard = observable, unheard
        self._until: int | None = None
        self.engaged = False
        self.samples = Observations(group.planners)

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

    def drop(self) -> None:
        """Wait for nothing, and forget the samples."""
        self._until = None
        self.samples.clear()

    def go_on(
            self, settings: Settings, newest: Mapping[str, tuple[int, float]]) -> list[str]:
        """
        Go on from the samples there are, once there is nothing more to wait for.

        Parameters
        ----------
        settings : Settings
            How old they may be.
        newest : mapping of str to (int, float)
            Stamp in ns and level in T of the newest change of each joint.

        Returns
        -------
        list of str
            Why samples do not count, in a sentence each.

        """
        if self._until is None:
            return []
        samples = self.samples.fresh(self._clock(), settings.takeover_max_age)
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
            x = samples[name]
            level = newest.get(name)
            try:
                planner.take_over(
                    x.stamp, x.stretch, x.rate, x.flux_density,
                    level[1] if level is not None and level[0] <= x.stamp else None)
            except BadInputError as error:
                notes.append(f'sample of joint {name} ignored: {error}')
        return notes
