"""Plans for blocks that creep, warm and change their volume, by every law, against SciPy."""

from dataclasses import replace
from functools import cache
import math

from extras import needs
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
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


class Loaded:
    """The block by the stretch s at constant volume, with the overstress of its branches."""

    def __init__(self, name):
        self.stress, self.by_stress = stress_of(name)
        paper, stiffer = paper_actuator(), 1.0 + 3.5e-3 * (HOT - 25.0)
        unit = 0.01 * math.sqrt(1900.0 / (stiffer * 1e4))
        self.times = np.array(TIMES) / unit
        self.zeta = paper.damping_coefficient * (1.0 - 5e-3 * (HOT - 25.0)) / (
            8.0 * 0.01 ** 2 * math.sqrt(1900.0 * stiffer * 1e4))

    def shape(self, s):
        """Return length, force, their derivatives by s, and that of the side; of complex s too."""
        stress, by_s = self.stress(s), self.by_stress(s)
        volume = 0.5 + np.sqrt(0.25 + stress / (3.0 * BULK))
        grows = by_s / (3.0 * BULK * (2.0 * volume - 1.0))
        root = volume ** (1.0 / 3.0)
        change = root / volume * grows / 3.0
        length, by_length = s * root, root + s * change
        return (length, stress / length, by_length,
                by_s / length - stress * by_length / length ** 2,
                change / np.sqrt(s) - 0.5 * root * s ** -1.5)

    def inertia(self, s):
        _, _, by_length, _, side = self.shape(s)
        return (by_length ** 2 + 2.0 * side ** 2) / 3.0

    def of(self, stretch):
        """Return s of a stretch."""
        return brentq(lambda x: self.shape(x)[0] - stretch, 0.5, 2.0, xtol=1e-15, rtol=1e-15)

    def motion(self, _, y, load):
        s, v, held = y[0], y[1], y[2:]
        _, force, by_length, by_force, _ = self.shape(s)
        slope = self.inertia(s + 1e-30j).imag / 1e-30
        push = (load - force - held.sum() - self.zeta * by_length * v) * by_length
        return [v, (push - 0.5 * slope * v * v) / self.inertia(s),
                *(np.array(RATIOS) * by_force * v - held / self.times)]

    def end(self, state, levels, end):
        """Return stretch and rate after some levels from a state."""
        s = self.of(state.stretch)
        _, force, by_length, *_ = self.shape(s)
        followed = np.array(state.followed) if state.followed else np.full(2, force)
        y = np.array([s, state.rate / by_length, *(np.array(RATIOS) * (force - followed))])
        for x, until in zip(levels, [*(x.time for x in levels[1:]), end], strict=True):
            if until > x.time:
                y = solve_ivp(
                    self.motion, (x.time, until), y, method='DOP853', rtol=3e-14, atol=1e-15,
                    args=(x.load,)).y[:, -1]
        length, _, by_length, *_ = self.shape(y[0])
        return length, by_length * y[1]


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
    assert Loaded(name).end(state, levels, move.duration) == pytest.approx(
        (target, 0.0), abs=1e-10)
