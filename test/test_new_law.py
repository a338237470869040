"""A hyperelastic model that is added: one module and its line are enough for all that follows."""

import json
from pathlib import Path
import subprocess
import sys

import pytest

# V. L. Biderman, Calculation of rubber parts, Mashgiz, Moscow (1958).
MODULE = """
from hmsa.model.laws.record import Constant, Law, polynomial, positive_modulus


def _scaled(values):
    one, second, two, three = factors = tuple(float(values[x.name]) for x in LAW.constants)
    modulus = positive_modulus(LAW.name, 2.0 * (one + second), '2 (b10 + b01)', factors)
    return modulus, polynomial(LAW, values, modulus, (one, two, three), second)


LAW = Law(
    'biderman', 'b10 (I1 - 3) + b01 (I2 - 3) + b20 (I1 - 3)^2 + b30 (I1 - 3)^3', 'Biderman 1958',
    (Constant('law.b10', 'factor of I1 - 3', place=1),
     Constant('law.b01', 'factor of I2 - 3', place=0),
     Constant('law.b20', 'factor of (I1 - 3)^2', place=2),
     Constant('law.b30', 'factor of (I1 - 3)^3', place=3)), _scaled)
"""

USED = """
import json

import biderman
from hmsa.model.laws import LAWS

LAWS[biderman.LAW.name] = biderman.LAW

import numpy as np
from scipy.integrate import solve_ivp

import hmsa
from hmsa.cli import main
from hmsa.interfaces.parameters import PLANNED
from hmsa.model.actuators import Setup
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint

CONSTANTS = {'b10': 4e3, 'b01': 1e3, 'b20': 200.0, 'b30': 30.0}
block = hmsa.Actuator(law='biderman', constants=CONSTANTS)
plan = block.plan([(1.3, 0.2), (0.9, 0.2)])
block.to_yaml('block.yaml')
again = hmsa.Actuator.from_yaml('block.yaml')
assert again == block

# Its plan, in an equation of motion that is typed here.
group = block.block.nondimensional
unit, load = block.block.time_unit, block.block.flux_density_unit
c10, c01, c20, c30 = (x / 1e4 for x in CONSTANTS.values())


def slope(_, y, beta):
    l, v = y
    i1, by1, by2 = l * l + 2 / l - 3, 2 * l - 2 / l ** 2, 2 - 2 / l ** 3
    force = (c10 + 2 * c20 * i1 + 3 * c30 * i1 ** 2) * by1 + c01 * by2
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
    law='biderman', constants={**CONSTANTS, 'b10': 4.4e3, 'b20': 0.0}).replace(density=1900.0)
found = hmsa.identify(
    (recorded.times, recorded.stretches), levels, actuator=start,
    free=['law.b10', 'law.b20', 'damping_coefficient', 'stretch_bias'])
found.report('identified.html')
plan.simulate().report('run.html')
status = main(['plan', '1.2:0.2', '--params-file', 'block.yaml', '--json'])
print()
print(json.dumps({
    'off': [float(x) for x in (*(at_first - (1.3, 0.0)), *(at_end - (0.9, 0.0)))],
    'device': float(device.stretch[0]), 'verdict': found.verdict, 'status': status,
    'b10': found.actuator.parameters['law.b10'], 'b20': found.actuator.parameters['law.b20'],
    'declared': [x.name for x in PLANNED if x.name.startswith('law.b')],
    'pages': [y in open(x).read() for x, y in (
        ('identified.html', 'b20'), ('run.html', 'biderman'))]}))
"""


@pytest.fixture(scope='module')
def used(tmp_path_factory):
    folder = tmp_path_factory.mktemp('law')
    (folder / 'biderman.py').write_text(MODULE)
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
    assert {'law.b10', 'law.b01', 'law.b20', 'law.b30'} <= set(used['declared'])
    assert used['device'] == pytest.approx(1.3, abs=1e-6)


def test_it_is_identified_and_reported(used):
    assert used['verdict'] == 'identified'
    assert used['b10'] == pytest.approx(4e3, rel=5e-3)
    assert used['b20'] == pytest.approx(200.0, abs=20.0)
    assert used['pages'] == [True, True]
