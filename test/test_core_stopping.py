"""A braking move ends at rest at a whole nanosecond, even for the smallest motion."""

import numpy as np
import pytest

from hmsa.model.moves import State
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import simulate
from hmsa.planning.drafting import brake
from hmsa.planning.timeline import JointModel, Options


@pytest.mark.parametrize('excursion', [1e-4, 1e-3, 1e-2, 0.3])
def test_a_brake_leaves_nothing_of_the_motion(excursion):
    model = JointModel(paper_actuator(), Options(flux_density_min=-0.5, flux_density_max=0.5))
    random = np.random.default_rng(4)
    for _ in range(20):
        angle = random.uniform(0.2, 2.9) * random.choice([-1.0, 1.0])
        state = State(
            1.2 + excursion * np.cos(angle),
            excursion * np.sin(angle) * model.frequency(1.2))
        found = brake(model, state)
        assert model.limits.minimum <= found.load <= model.limits.maximum
        ns = model.ns(found.duration)
        assert found.duration == pytest.approx(model.time(ns), rel=1e-13)
        stretch, _ = simulate(
            [0.0, model.time(ns)], [found.load, model.holding(found.stretch)],
            model.time(ns) + np.linspace(0.0, 10.0, 101), model.material,
            stretch=state.stretch, rate=state.rate)
        assert np.ptp(stretch) < 1e-9 * excursion
