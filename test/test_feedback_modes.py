"""Feedback of an actuator with secondary modes, given or not, in virtual time."""

from dataclasses import replace
from functools import partial

import pytest

from benchmarks import bench_harm, laboratory
from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.model.modes import Modes
from hmsa.model.simulation import ActuatorSimulation

pytestmark = pytest.mark.thorough

# H/L, damping ratio, noise, samples in a time scale, factor of the mass, and frequency ratio,
# share and damping ratio of the second mode; targets; half length in m; whether the planner's
# model has the mass; how feedback is; seed of the noise.
LABORATORIES = {
    # Once 12 % of the step more than in open loop: the mode looked like creep.
    'creep': ((0.5282, 0.05841, 1.9667e-4, 21.6234, 1.4242, (1.44226, 0.0795, 0.06)),
              (1.083, 1.199), 0.006482, True, 'adapt', 151),
    # 10 %: half a natural period, which is longer than that of a cube, was taken for a whole one.
    'slow': ((2.01028, 0.03599, 8.6495e-4, 18.5116, 1.075, (1.47042, 0.14029, 0.06525)),
             (1.188,), 0.0290915, True, 'cautious', 112),
    # 3 %: a restart forgot the rest before the first move, which shows the bias.
    'bias': ((0.69487, 0.06158, 1.06230e-3, 6.58282, 1.4913, (1.94681, 0.02919, 0.07897)),
             (0.927,), 0.0442436, False, 'adapt', 110)}


class Plant(laboratory.Plant):
    """A plant with secondary modes."""

    def __init__(self, truth, bench, time):
        self.time, self.applied, self._levels = time, [], []
        self._motion = ActuatorSimulation(truth, time=time)

    def _begin_with(self, level):
        self._motion.command(self.time, level)

    def _go_on(self, time):
        self._motion.advance(max(time, self._motion.time))
        self.time = time
        return self._motion.stretch


@pytest.mark.parametrize('name', LABORATORIES)
def test_feedback_leaves_no_more_than_open_loop_where_the_model_lacks_a_mode(name):
    (shape, zeta, noise, dense, mass, mode), targets, length, known, way, seed = (
        LABORATORIES[name])
    block = Actuator(half_length=length, half_thickness=length * shape, damping_ratio=zeta,
                     chain_limit=5.0).block
    true = replace(block, mass_factor=mass, modes=Modes(*((x,) for x in mode)))
    unit = block.time_unit
    bench = replace(
        laboratory.drawn(0), seed=seed, given=replace(
            block, mass_factor=mass if known else 1.0), block=block, noise=noise,
        period=unit / dense, delay=0.05 * unit, bias=0.0, dropouts=0.0, targets=targets)
    plain, corrected = (
        bench_harm.run(bench, x, partial(Plant, true)) for x in ('open loop', way))
    excess = [y.size - x.size for x, y in zip(plain, corrected, strict=True)]
    assert max(excess) < 0.005


@pytest.mark.parametrize('weak', [(), (2.9, 0.03, 0.1)])
@pytest.mark.parametrize('way', ['adapt', 'cautious'])
def test_feedback_corrects_a_block_with_given_modes(way, weak):
    # Once the modes were left out, and nothing was corrected; then a weak mode that the parameters
    # lack looked like a sensor that had changed.
    with unquestioned():
        block = Actuator(
            half_length=0.01, half_thickness=0.003, damping_ratio=0.05, chain_limit=5.0,
            mount='free').block
    modes = Modes.of_numbers([*block.modes.numbers[:2], *([(*weak, 0.0, 0.0)] if weak else [])])
    given = replace(block, shear_modulus=1.15 * block.shear_modulus, modes=Modes.of_numbers(
        modes.numbers[:2]))
    bench = replace(
        laboratory.drawn(0), seed=3, given=given, block=block, noise=5e-4,
        period=block.time_unit / 12.0, delay=0.05 * block.time_unit, bias=1e-3, dropouts=0.0,
        targets=(1.15, 1.06, 1.2))
    plain, corrected = (
        bench_harm.run(bench, x, partial(Plant, replace(block, modes=modes)), 'modal')
        for x in ('open loop', way))
    assert min(x.size for x in plain) > 0.1
    assert corrected[0].size < 0.5 * plain[0].size
    assert max(x.size for x in corrected[1:]) < 0.03
