"""Excitations: within the limits, at rest at the end, better than unshaped steps."""

import json

from identification_oracle import BLOCK, simulate
import numpy as np
import pytest

from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.excitation import Bounds, excite

PERIOD = 2.56 * BLOCK.time_unit


@pytest.fixture(scope='module')
def designed():
    """Return the design for the example block over 1 s."""
    return excite(BLOCK, Bounds(-0.1, 0.2), duration=1.0)


@pytest.mark.slow
def test_design_tells_three_times_as_much_as_plain_steps_of_the_duration(designed):
    assert designed.improvement >= 3.0
    assert designed.plain.std['shear_modulus'] < designed.paper.std['shear_modulus']


def test_design_keeps_the_limits_and_ends_at_rest(designed):
    best = designed.best
    assert -0.1 <= np.min(best.levels) <= np.max(best.levels) <= 0.2
    assert best.levels[-1] == pytest.approx(0.0, abs=1e-12)
    assert np.all(np.diff(best.level_times) > 0.0)
    times = np.linspace(0.0, 1.0, 4000)
    stretch = simulate(times, best.level_times, best.levels)
    assert np.min(stretch) >= 0.6 - 1e-3
    assert np.max(stretch) <= 2.0 + 1e-3
    assert stretch[times > 1.0 - PERIOD] == pytest.approx(1.0, abs=2e-3)


@pytest.mark.slow
def test_ramps_of_the_amplifier_are_reckoned_with():
    found = excite(BLOCK, Bounds(slew_limit=20.0), duration=0.3)
    assert found.best.ends_at_rest
    assert found.best.reach[0] >= 0.6
    assert found.best.reach[1] <= 2.0


@pytest.mark.slow
def test_command_prints_and_writes_the_levels(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['excite', '--duration', '0.3', '--out', 'levels.csv', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['duration'] == 0.3
    assert found['ends_at_rest']
    rows = np.loadtxt('levels.csv', delimiter=',', skiprows=1)
    assert rows == pytest.approx(np.array(found['levels']), abs=1e-8)


@pytest.mark.parametrize(('arguments', 'message'), [
    ('--duration 0.001', 'duration is 0.001 s: expected at least'),
    ('--duration nan', 'duration is nan s'),
    ('--stretch-max 0.9', 'expected a range with 1 inside'), ('--rate 0', 'rate is 0 Hz'),
    ('--duration 0.6 --rate 10', '0.6 s at 10 Hz are 6 samples: expected 12 or more'),
    ('--duration 5000', 'more than a million samples')])
def test_bad_arguments_end_with_2_and_a_sentence(refusal, arguments, message):
    assert message in refusal(f'excite {arguments}')


def test_bounds_without_rest_are_refused():
    with pytest.raises(BadInputError, match='expected a range with 0 T in it'):
        Bounds(0.1, 0.2)
