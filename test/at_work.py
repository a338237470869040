"""A planner at work without ROS, in the time of a test."""

import math

from hmsa.model.parameters import paper_actuator
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.records import Environment, Note, Samples, Send, Settings, StatusChanged
from hmsa_ros.runtime.runtime import Runtime

MS = 1_000_000
START = 1000 * MS


def planner(block=None, **options):
    """Return a planner of a block, by default the paper's, with a coil of 0.5 T."""
    return Planner(block or paper_actuator(), Options(
        **{'flux_density_min': -0.5, 'flux_density_max': 0.5, **options}))


def sample(stamp, stretch, rate=math.nan, flux_density=math.nan, *, came=None):
    """Return the only sample of a joint that has arrived; by default, as soon as it was taken."""
    return Samples(
        [stamp], [stretch], [rate], [flux_density], [stamp if came is None else came])


class AtWork:
    """A runtime whose clocks are the attribute ``now``, and what it has put out."""

    def __init__(self, planners, settings=None, now=START, **environment):
        self.now, self.outputs = now, []
        self.group = PlannerGroup(planners)
        self.runtime = Runtime(
            self.group, settings or Settings(takeover_timeout=0), Environment(**{
                'clock': lambda: self.now, 'steady': lambda: self.now, **environment}))
        self.runtime.active = True

    @property
    def planner(self):
        return next(iter(self.group.planners.values()))

    def tick(self):
        """Have it do the work that is due; return the commands."""
        new = self.runtime.tick(self.now)
        self.outputs += new
        return [x for x in new if isinstance(x, Send)]

    def show(self, stamp, stretch, joint='a', **more):
        """Have it read a sample that has arrived, if it wants samples."""
        if self.runtime.looks_at(stamp):
            self.runtime.observed(joint, sample(stamp, stretch, came=self.now, **more))

    def outputs_of(self, kind):
        """Return the outputs of a kind."""
        return [x for x in self.outputs if isinstance(x, kind)]

    @property
    def status(self):
        return self.outputs_of(StatusChanged)[-1]

    def codes(self):
        return [x.verdict.code for x in self.outputs_of(StatusChanged)]

    def notes(self):
        return [x.message for x in self.outputs_of(Note)]
