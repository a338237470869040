"""Every law with every shaper, lag, creep, ramps and grid: each combination is planned."""

from dataclasses import replace
from itertools import product
import math

from beam_oracle import silicone
from creep_oracle import elastic, ended
import numpy as np
import pytest

from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.parameters import BLOCK
from hmsa.model.creep import Creep
from hmsa.model.delivery import Delivery
from hmsa.model.equations import elastic_force, natural_frequency
from hmsa.model.laws import LAWS
from hmsa.model.moves import Limits, Setpoint
from hmsa.model.parameters import NondimensionalParameters
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import SHAPERS
from hmsa.planning.shapers.request import MoveRequest

STRETCHES = np.linspace(0.7, 1.8, 23)
CONSTANTS = {
    'mooney_rivlin': {'law.c10': 3e3, 'law.c01': 2e3},
    'yeoh': {'law.c10': 5e3, 'law.c20': -200.0, 'law.c30': 40.0},
    'ogden': {'law.mu': [6e3, -1500.0, 10.0], 'law.alpha': [1.5, -3.0, 8.0]},
    'arruda_boyce': {'law.mu': [9e3], 'law.lambda_m': 2.0},
    'nonaffine': {'law.gc': 6e3, 'law.ge': 3e3, 'law.lambda_m': 2.0},
    'extended_tube': {'law.gc': 6e3, 'law.ge': 3e3, 'law.delta': 0.25, 'law.beta': 0.5},
    'table': {'law.stretch': STRETCHES.tolist(), 'law.flux_density': (
        0.12566 * elastic_force(STRETCHES, NondimensionalParameters())).tolist()}}
# Times in units of that of a paper's block.
CREEPS = (Creep(), Creep((0.1,), (2.0,)), Creep((0.1, 0.2, 0.05), (0.4, 3.0, 100.0)))
COILS = tuple(product((0.0, 0.1), (math.inf, 2.0), (0.0, 0.27)))
EXACT = ('two_step', 'robust', 'minimum_time', 'smooth')
# The paper's, which is planned for in the gate.
BLOCK_OF = {x: pytest.param(x, marks=() if x == 'gent' else pytest.mark.slow) for x in LAWS}


def material_of(law):
    """Return the block or beam of a law."""
    if law == 'beam':
        return silicone().nondimensional
    if law == 'gent':
        return NondimensionalParameters()
    return actuator_from({x.name: x.default for x in BLOCK} | {'law.name': law} | CONSTANTS.get(
        law, {})).nondimensional


@pytest.mark.parametrize('law', BLOCK_OF.values())
def test_no_combination_is_refused_and_exact_ones_end_at_rest(law):
    material = material_of(law)
    target = 1.3 if material.rest else 0.3
    # As fast and as large as it is for a block.
    unit = 2.0 * math.pi / float(natural_frequency(target, material)) / 3.6
    held = float(elastic_force(target, material))
    judged = 0
    for number, (name, creep, (lag, slew, period)) in enumerate(product(
            SHAPERS, CREEPS, COILS)):
        # The cases of minimax take long; the gate has some.
        if name == 'minimax' and law == 'gent' and number % 11:
            continue
        delivery = Delivery(
            period=period * unit, slew=slew * held / unit, lag=lag * unit)
        move = plan_sequence(
            [Setpoint(target, math.inf)], MoveRequest.of(
                replace(material, creep=replace(
                    creep, times=tuple(x * unit for x in creep.times))),
                delivery=delivery, limits=Limits(-20.0 * held, 20.0 * held)),
            name)[0].move
        assert move.levels
        if law == 'gent' and name in EXACT and number % 7 == 0:
            judged += 1
            branches = replace(creep, times=tuple(x * unit for x in creep.times))
            # What follows creep afterwards may begin before the arrival, with half a ramp.
            levels = move.levels[:len(move.levels) - len(move.tail)]
            end = ended([(x.time, x.load) for x in levels], branches, move.duration, delivery)
            needed = elastic(target)[0] + end[3:].sum()
            assert end[:2] == pytest.approx((target, 0.0), abs=1e-9), (name, creep, delivery)
            if lag:
                assert end[2] == pytest.approx(needed, abs=1e-9)
    assert judged > 10 or law != 'gent'
