"""Tuning: choices, refusals, and moves without vibration."""

from dataclasses import replace
import json
import math
from pathlib import Path

from core_oracle import follow
from identification_oracle import simulate, steps
import numpy as np
import pytest

import hmsa
from hmsa.errors import BadInputError
from hmsa.identification.files import read_belief
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import Known
from hmsa.model.parameters import paper_actuator
from hmsa.runs.bags import read_run
from hmsa.runs.parameters import read_parameter_file
from hmsa_lab.experiments.tuning import choose, chosen, compare_shapers, Expected, Tuning

RUN_SECONDS = 300.0
MOVES = ((1.1, 0.3), (1.0, 0.3), (1.2, 0.3))
WORDS = tuple(f'{x:g}:{y:g}' for x, y in MOVES)
FACTORS = {'shear_modulus': 0.88, 'remanence': 1.05, 'damping_coefficient': 0.8}
BENCH = """\
/**:
  ros__parameters:
    actuator.shear_modulus: 10000.0
/**/plant:
  ros__parameters:
    stretch_noise: 0.0002
""" + ''.join(f'    mismatch.{name}: {factor}\n' for name, factor in FACTORS.items())
WORSE = """\
    coil_time_constant: 0.0005
    viscoelastic.ratio: 0.04
    viscoelastic.time: 0.03
"""


def known(std: float) -> Known:
    """Return knowledge of the example block with a relative standard deviation."""
    block = paper_actuator()
    values = (block.shear_modulus, block.damping_coefficient)
    return Known(('shear_modulus', 'damping_coefficient'), values,
                 np.diag(np.square(std * np.array(values))))


def test_what_is_well_known_moves_quickly_and_what_is_not_moves_robustly():
    block = hmsa.Actuator()
    well, badly = (compare_shapers(block, MOVES, known(x)) for x in (1e-3, 3e-2))
    assert choose(well, 0.01).shaper == 'two_step'
    assert choose(badly, 0.01).shaper == 'robust'
    assert badly[0].vibration > 10.0 * well[0].vibration


def test_a_shaper_that_cannot_plan_the_moves_is_not_chosen():
    found = compare_shapers(hmsa.Actuator(), [(1.1, 0.007)], known(3e-2))
    assert {x.shaper for x in found if x.reason} >= {'robust', 'smooth'}
    assert choose(found, 1e-6).shaper == 'two_step'
    with pytest.raises(BadInputError, match='no shaper plans the setpoints: too short'):
        choose([Expected('two_step', math.nan, math.nan, 'too short')], 0.01)


def test_a_model_that_lacks_something_is_planned_with_smoothly():
    time, (switches, levels) = np.arange(0.0, 0.4, 1e-3), steps((1.3, 1.0, 1.2), 0.1)
    seen = simulate(time, switches, levels) + np.random.default_rng(0).normal(0.0, 1e-3, 400)
    found = identify(Measurement(time, seen, switches, levels))
    tuning = Tuning(Path(), tuple(((x,), y) for x, y in MOVES), Path(), [])
    belief = read_belief(None, [])
    chosen_for = [chosen(tuning, belief, x)[1]['shaper'] for x in (
        found, replace(found, verdict='model_rejected'))]
    assert (found.verdict, *chosen_for) == ('identified', 'two_step', 'smooth')


@pytest.mark.parametrize(('words', 'what'), [
    ('1.1,1.2:1', 'several joints'), ('1.1:1 --out .', 'cannot write'),
    ('1.1:1 --known mass=1', "--known has 'mass=1'"), ('1.1', 'expected STRETCH:DURATION')])
def test_what_cannot_be_tuned_is_refused_before_anything_moves(words, what, refusal, tmp_path):
    assert what in refusal(f'tune {words} --simulate --folder', tmp_path / 'runs')
    assert not (tmp_path / 'runs').exists()


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.parametrize('more', ['', WORSE], ids=['stiffness', 'lag and creep'])
def test_an_actuator_unlike_its_data_sheet_moves_without_vibration_afterwards(
        start, tmp_path, more):
    file, out, page = (tmp_path / x for x in ('guess.yaml', 'actuator.yaml', 'report.html'))
    file.write_text(BENCH + more)
    process = start.hmsa(
        'tune', *WORDS, '--simulate', '--params-file', str(file), '--duration', '2', '--out',
        str(out), '--report', str(page), '--folder', str(tmp_path / 'runs'), '--json')
    process.wait(RUN_SECONDS)
    assert process.stdout, process.output
    found = json.loads(process.stdout)
    # What a sensor with this noise cannot tell from vibration may be left undecided.
    assert found['verdict'] in ('tuned', 'undecided'), process.output
    assert 'arrived' not in {x['verdict'] for x in found['before']}
    assert all(abs(x['offset_percent']) < 0.1 for x in found['after'])
    assert 'before' in page.read_text()
    learnt = read_parameter_file(out)
    truth = {x: y * getattr(paper_actuator(), x) for x, y in FACTORS.items()}
    for name, value in truth.items():
        assert learnt[f'planner.actuator.{name}'] == pytest.approx(value, rel=2e-3)
    if more:
        assert learnt['planner.coil_time_constant'] == pytest.approx(5e-4, rel=0.02)
        return
    # Judged by an integration of the levels that shares nothing with the package.
    block = replace(paper_actuator(), **truth)
    numbers = block.nondimensional
    levels = list(read_run(tmp_path / 'runs' / 'after' / 'run').applied)
    state = [1.0, 0.0]
    for level, later in zip(levels, levels[1:], strict=False):
        span = (later.stamp - level.stamp) * 1e-9 / block.time_unit
        state = follow(
            state, [(span, level.flux_density / block.flux_density_unit)], numbers.zeta,
            numbers.j_lim, numbers.c1)
    assert abs(state[0] - 1.2) < 1e-3
    assert abs(state[1]) < 1e-3


@pytest.mark.slow
@pytest.mark.ros
def test_a_running_planner_gets_what_was_found(start, tmp_path):
    file = tmp_path / 'bench.yaml'
    file.write_text(BENCH + WORSE)
    start.hmsa('planner', '--ros-args', '-p', 'lead_time:=0.5')
    start.hmsa('plant', '--ros-args', '-p', 'publish_rate:=1000.0', '--params-file', str(file))
    process = start.hmsa(
        'tune', '1.1:0.5', '1:0.5', '--duration', '2', '--folder', str(tmp_path / 'runs'),
        '--json')
    process.wait(RUN_SECONDS)
    assert process.stdout, process.output
    assert json.loads(process.stdout)['file'], process.output
    for name, value in (('actuator.shear_modulus', 8800.0), ('viscoelastic.ratio', 0.04)):
        answer = start.hmsa('param', 'get', 'planner', name)
        assert answer.wait(RUN_SECONDS) == 0
        assert float(answer.stdout.split()[-1].strip('[]')) == pytest.approx(value, rel=5e-2)
