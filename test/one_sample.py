"""A sample for the planner at work, as a node passes it on."""

import math

from hmsa_ros.runtime.records import Samples


def sample(stamp, stretch, rate=math.nan, flux_density=math.nan, *, came=None):
    """Return the only sample of a joint that has arrived; by default, as soon as it was taken."""
    return Samples(
        [stamp], [stretch], [rate], [flux_density], [stamp if came is None else came])
