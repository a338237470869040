"""Plans for blocks that creep, warm and change their volume, by every law, against SciPy."""

from dataclasses import replace
from functools import cache
import math

from extras import needs
import numpy as np
import pytest
from test_compressible import Lagrangian
from test_core_laws import block, CASES

from hmsa.model.creep import Creep
from hmsa.model.laws import LAWS
from hmsa.model.moves import State
from hmsa.model.parameters import paper_actuator
from hmsa.model.thermal import Thermal
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

BULK, HOT, RATIOS, TIMES = 10.0, 40.0, (0.1, 0.2), (2e-3, 2e-2)
THERMAL = Thermal(shear_modulus=3.5e-3, remanence=-1.1e-3, damping_coefficient=-5e-3)
ENERGIES = {'gent': '-5/2 * log(1 - (I1 - 3)/5)'} | {x: y for x, (_, y) in CASES.items()}


@cache
def stress_of(name):
    """Return s psi' and its derivative for a law in units of its modulus, by SymPy."""
    sympy = needs('sympy')
    s = sympy.Symbol('l', positive=True)
    energy = sympy.sympify(ENERGIES[name], {
        'l': s, 'I1': s ** 2 + 2 / s, 'I2': 2 * s + s ** -2})
    modulus = sympy.diff(energy, s, 2).subs(s, 1) / 3
    stress = s * sympy.diff(energy / modulus, s)
    return [sympy.lambdify(s, x, 'numpy') for x in (stress, sympy.diff(stress, s))]


def loaded(name):
    """Return the hot block by its Lagrangian."""
    stiffer = 1.0 + 3.5e-3 * (HOT - 25.0)
    zeta = paper_actuator().damping_coefficient * (1.0 - 5e-3 * (HOT - 25.0)) / (
        8.0 * 0.01 ** 2 * math.sqrt(1900.0 * stiffer * 1e4))
    times = np.array(TIMES) / (0.01 * math.sqrt(1900.0 / (stiffer * 1e4)))
    stress = stress_of(name)
    return Lagrangian(
        BULK, zeta, stress=lambda s: [x(s) for x in stress], ratios=RATIOS, times=times)


def hot(name):
    """Return the dimensionless group of a block at its temperature, of modulus 10 kPa at 25."""
    made = paper_actuator() if name == 'gent' else replace(
        block(name), shear_modulus=1e4)
    return replace(
        made, damping_coefficient=paper_actuator().damping_coefficient, thermal=THERMAL,
        creep=Creep(RATIOS, TIMES), bulk_ratio=BULK).at_temperature(HOT).nondimensional


def test_each_law_of_a_block_is_tested():
    # A table and a beam have no bulk modulus; both have tests of their own.
    assert ENERGIES.keys() | {'table', 'beam'} == LAWS.keys()


@pytest.mark.parametrize(('state', 'target'), [
    (State(1.0), 1.2), (State(1.25), 0.9), (State(1.1, 0.1, followed=(0.1, 0.4)), 1.3)])
@pytest.mark.parametrize('name', ENERGIES)
def test_move_of_a_block_with_everything_ends_at_rest(name, state, target):
    move = get_shaper('two_step')(MoveRequest(state, target, hot(name)))
    levels = [x for x in move.levels if x.time < move.duration]
    assert loaded(name).follow(
        levels, move.duration, state.stretch, state.rate,
        state.followed or None) == pytest.approx((target, 0.0), abs=1e-10)
