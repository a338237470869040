"""What a running planner must never do: compile."""

import json
import subprocess
import sys

PROGRAM = """
from dataclasses import replace
import json
from hmsa_ros.core import kernels, law, response_kernel
from hmsa_ros.core import shooting_kernel, tail_kernel, two_step_kernel
from hmsa_ros.core.creep import Creep
from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.planner import Options, Planner
from hmsa_ros.core.simulation import ActuatorSimulation
from hmsa_ros.core.warmup import warm_up

def signatures():
    return {
        name: len(kernel.signatures)
        for module in (law, kernels, response_kernel, tail_kernel,
                       shooting_kernel, two_step_kernel)
        for name, kernel in vars(module).items()
        if hasattr(kernel, 'signatures')}

warm_up(creep=True)
before = signatures()
millisecond = 1_000_000
for options in (
        {}, {'period': millisecond}, {'slew_limit': 30.0}, {'shaper': 'robust'},
        {'shaper': 'minimax'}, {'shaper': 'minimum_time'}, {'shaper': 'ei'}, {'shaper': 'step'},
        {'period': millisecond, 'slew_limit': 100.0}, {'short_spell': 'continue'},
        {'coil_time_constant': 3e-4}, {'coil_time_constant': 3e-4, 'period': millisecond},
        {'creep': Creep((0.1, 0.2), (0.01, 0.1))},
        {'creep': Creep((0.1,), (0.01,)), 'period': millisecond},
        {'creep': Creep((0.1,), (0.01,)), 'coil_time_constant': 3e-4, 'slew_limit': 100.0}):
    block = replace(paper_actuator(), creep=options.pop('creep', Creep()))
    planner = Planner(block, Options(
        flux_density_min=-0.5, flux_density_max=0.5, lead_time=0, **options))
    plant = ActuatorSimulation(
        paper_actuator(), slew_limit=options.get('slew_limit', float('inf')),
        creep=Creep((0.1,), (0.1,)) if 'shaper' in options else None)
    planner.request([(1.1, 44 * millisecond), (0.9, 88 * millisecond)], None, 0)
    for now in range(0, 120 * millisecond, millisecond):
        if now == 3 * millisecond:
            planner.setpoint(1.3, now)
        if now == 5 * millisecond:
            planner.stop(now)
        for level in planner.due(now):
            plant.command(level.stamp, level.flux_density)
        plant.advance(now)
print(json.dumps([before, signatures()]))
"""


def test_after_the_warm_up_no_kernel_is_compiled_for_another_type_of_argument():
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM], capture_output=True, text=True, check=True)
    before, after = json.loads(done.stdout)
    assert before['two_step'] == before['follow_one'] == before['trajectory'] == 1
    assert after == before
