"""A hyperelastic model that is added: one module and its line are enough for all that follows."""

import json
from pathlib import Path
import subprocess
import sys

import pytest

# H. Demiray, J. Biomech. 5, 309 (1972), and a term of A. N. Gent, A. G. Thomas, J. Polym. Sci. 28,
# 625 (1958): no other model has their functions.
MODULE = """
from hmsa.model.laws.formula import expm1, law_of, log1p
from hmsa.model.laws.record import Constant


def _energy(strain, mu, b, c2):
    return 0.5 * mu / b * expm1(b * strain.first) + c2 * log1p(strain.second / 3.0)


LAW = law_of(
    'exponential', 'mu/(2 b) (exp(b (I1 - 3)) - 1) + c2 ln(I2/3)', 'Demiray 1972',
    (Constant('law.mu_d', 'modulus', minimum=0.0),
     Constant('law.b', 'stiffening', '', minimum=0.0, above=0.0),
     Constant('law.c2', 'factor of the second invariant')), _energy)
"""

USED = """
import json

import exponential
from hmsa.model.laws import LAWS

LAWS[exponential.LAW.name] = exponential.LAW

import numpy as np
from scipy.integrate import solve_ivp

import hmsa
from hmsa.cli import main
from hmsa.interfaces.parameters import PLANNED
from hmsa.model.actuators import Setup
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint

CONSTANTS = {'mu_d': 8e3, 'b': 0.4, 'c2': 3e3}
block = hmsa.Actuator(law='exponential', constants=CONSTANTS)
plan = block.plan([(1.3, 0.2), (0.9, 0.2)])
block.to_yaml('block.yaml')
again = hmsa.Actuator.from_yaml('block.yaml')
assert again == block

# Its plan, in an equation of motion that is typed here.
group = block.block.nondimensional
unit, load = block.block.time_unit, block.block.flux_density_unit
mu, b, c2 = (CONSTANTS[x] / y for x, y in (('mu_d', 1e4), ('b', 1.0), ('c2', 1e4)))


def slope(_, y, beta):
    l, v = y
    force = mu / 2 * np.exp(b * (l * l + 2 / l - 3)) * (2 * l - 2 / l ** 2) + (
        c2 * (2 - 2 / l ** 3) / (2 * l + l ** -2))
    return v, 6 * (beta - force - group.zeta * group.c1 / 2 * v + v * v / (4 * l ** 4)) / (
        l ** -3 + group.c1)


def follow(state, levels, end):
    times = [x for x, _ in levels] + [end]
    for (begin, level), following in zip(levels, times[1:]):
        state = solve_ivp(
            slope, (begin / unit, following / unit), state, 'DOP853', args=(level / load,),
            rtol=1e-13, atol=1e-14).y[:, -1]
    return state


begin, switch, second, third = plan.levels[:, 0]
at_first = follow((1.0, 0.0), plan.levels[:2].tolist(), second)
at_end = follow(at_first, plan.levels[2:].tolist(), third + 10 * unit)

# The same in the simulated device of the nodes.
device = SimulatedDevice([SimulatedJoint(Setup(block.block))], period=1_000_000, time=10 ** 9)
for time, level in plan.levels.tolist():
    device.receive(0, 10 ** 9 + round(1e9 * time), level)
device.advance(10 ** 9 + round(0.19e9))

levels = [(0.0, 0.0), (0.02, 0.09), (0.12, -0.06), (0.22, 0.05), (0.32, 0.0)]
recorded = block.simulate(levels, until=0.42, noise=1e-4)
start = hmsa.Actuator(
    law='exponential', constants={**CONSTANTS, 'mu_d': 8.8e3, 'b': 0.3}).replace(density=1900.0)
found = hmsa.identify(
    (recorded.times, recorded.stretches), levels, actuator=start,
    free=['law.mu_d', 'law.b', 'damping_coefficient', 'stretch_bias'])
found.report('identified.html')
plan.simulate().report('run.html')
status = main(['plan', '1.2:0.2', '--params-file', 'block.yaml', '--json'])
print()
print(json.dumps({
    'off': [float(x) for x in (*(at_first - (1.3, 0.0)), *(at_end - (0.9, 0.0)))],
    'device': float(device.stretch[0]), 'verdict': found.verdict, 'status': status,
    'mu': found.actuator.parameters['law.mu_d'], 'b': found.actuator.parameters['law.b'],
    'declared': [x.name for x in PLANNED if x.name.startswith('law.')],
    'pages': [y in open(x).read() for x, y in (
        ('identified.html', 'law.b'), ('run.html', 'exponential'))]}))
"""


@pytest.fixture(scope='module')
def used(tmp_path_factory):
    folder = tmp_path_factory.mktemp('law')
    (folder / 'exponential.py').write_text(MODULE)
    (folder / 'used.py').write_text(USED)
    done = subprocess.run(
        [sys.executable, 'used.py'], cwd=folder, capture_output=True, text=True, check=False,
        env={'PYTHONPATH': str(Path(__file__).parent.parent), 'PATH': ''})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_its_plans_are_those_of_an_equation_of_motion_that_is_typed_again(used):
    # Times of levels in a file are whole nanoseconds, 2e-7 of a time scale.
    assert max(map(abs, used['off'])) < 1e-8
    assert used['status'] == 0


def test_nodes_and_files_have_its_constants(used):
    assert {'law.mu_d', 'law.b', 'law.c2'} <= set(used['declared'])
    assert used['device'] == pytest.approx(1.3, abs=1e-6)


def test_it_is_identified_and_reported(used):
    assert used['verdict'] == 'identified'
    assert used['mu'] == pytest.approx(8e3, rel=5e-3)
    assert used['b'] == pytest.approx(0.4, rel=0.05)
    assert used['pages'] == [True, True]
