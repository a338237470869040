"""What follows the joints by their samples: feedback, or nothing in open loop."""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any

from hmsa.errors import BadInputError
from hmsa.judge.records import SensorModel
from hmsa.judge.setpoint_samples import SetpointSamples
from hmsa.offload import Awaited, Doing, here
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import JointModel
from hmsa.plugins import FOLLOWER, registered
from hmsa_ros.runtime.planning_task import Drafts, PlanningTask
from hmsa_ros.runtime.records import Samples, Settings, Verdict

_OFF = 'feedback is off, so there is no estimate: expected observe, adapt or cautious'


class Follower:
    """
    Open loop: samples change nothing, and plans begin from the predicted state.

    Feedback is a subclass, registered as the entry point ``adapt`` of ``hmsa_ros.follower``.
    """

    open_loop = True

    def __init__(self, group: PlannerGroup, settings: Settings, doing: Doing = here) -> None:
        self._group, self._settings = group, settings
        #: Executes long-running work.
        self.doing = doing
        for planner in group.planners.values():
            planner.believed = planner.as_held

    @property
    def on(self) -> bool:
        """Whether samples are used."""
        return False

    @property
    def ready(self) -> bool:
        """Whether samples are used from the first one on: whatever does it has started."""
        return True

    @property
    def wake(self) -> int | None:
        """Time in ns of the next `update`; None for never, 0 for now."""
        return None

    # -- reports -------------------------------------------------------------------------------

    def observed(self, joint: str, samples: Samples) -> None:
        """Process samples of a joint."""

    def applied(self, joint: str, stamp: int, flux_density: float) -> None:
        """Record that a level in T has taken effect, before the plan does."""

    def audit(self, joint: str, hold: SetpointSamples) -> None:
        """Audit a setpoint of a joint, once all samples that have arrived are processed."""

    # -- plans ---------------------------------------------------------------------------------

    def update(self, now: int) -> bool:
        """Process the samples that have arrived by a time in ns; return whether it took long."""
        return False

    def give_way(self, now: int) -> None:
        """Update less often from a time in ns on, since commands have been kept waiting."""

    def cautious(self, drafts: Drafts) -> Drafts:
        """Return the drafts of a request with more time for moves to be corrected."""
        return drafts

    def due(self, now: int) -> Iterator[PlanningTask]:
        """Yield corrections that may help at a time in ns."""
        return iter(())

    def take(self, work: PlanningTask, drafts: Drafts, now: int) -> Verdict | None:
        """Adopt a correction made for a time in ns; None if nothing changes."""
        return None

    def follows(self, joint: str) -> bool:
        """Return whether plans for a joint do not begin from its newest sample."""
        return False

    def sensor(self, joint: str) -> SensorModel:
        """Return the sensor of a joint as estimated; as given where there is no estimate."""
        return SensorModel()

    def do(self, *work: Any) -> Awaited[Any]:
        """Execute work with `doing` if samples are used, else in this process."""
        return here(*work)

    # -- settings ------------------------------------------------------------------------------

    def restart(self) -> None:
        """Discard the estimates."""

    def change(self, settings: Settings, models: Mapping[str, JointModel]) -> Mapping[
            str, JointModel]:
        """Adopt new settings and given models; return the models to plan with."""
        self._settings = settings
        return models

    def reset(self) -> str:
        """Discard the estimates and return a confirmation; raise `BadInputError` if off."""
        raise BadInputError(_OFF)

    def save(self, *, by_joint: bool) -> str:
        """Write the estimates to a file and return a confirmation; `BadInputError` if off."""
        raise BadInputError(_OFF)


def import_feedback() -> Callable[..., Follower]:
    """
    Return what makes feedback from samples; importing it takes some tenths of a second.

    It takes the planners, settings, outputs, a clock, a function that is told why feedback of a
    joint has ended, and what executes long-running work.
    """
    import_module('multiprocessing.connection')  # for the processes that estimate
    make: Callable[..., Follower] = registered(FOLLOWER)['adapt'].load()
    return make
