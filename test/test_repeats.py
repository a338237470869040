"""Repeated runs, compared by mean and standard deviation."""

import csv
from dataclasses import replace
import json

import numpy as np
import pytest
from test_report import ACTUATOR, parameters, simulated, write

import hmsa
from hmsa.cli import main
from hmsa.report.comparison import repeats_in

MODULI = {'before': (1.02, 1.04, 1.06), 'after': (0.999, 1.0, 1.001)}


@pytest.fixture(scope='module')
def folders(tmp_path_factory):
    """Return two folders as from hmsa run --repeat, of plants with different stiffness."""
    folder = tmp_path_factory.mktemp('repeats')
    for name, factors in MODULI.items():
        for i, factor in enumerate(factors, 1):
            (folder / name / str(i)).mkdir(parents=True)
            write(folder / name / str(i) / 'run', simulated(
                plant=replace(ACTUATOR, shear_modulus=factor * ACTUATOR.shear_modulus)),
                **parameters(planner=ACTUATOR, plant=ACTUATOR))
    return folder


def test_repeats_are_compared_by_mean_and_spread_and_drawn_as_bands(folders, capsys):
    words, picture = [str(folders / x) for x in MODULI], folders / 'bands.svg'
    assert main(['compare', *words, '--picture', str(picture), '--data', '--json']) == 0
    found = {(x['run'], x['setpoint']): x
             for x in json.loads(capsys.readouterr().out)['setpoints']}
    alone = [hmsa.read(folders / 'before' / str(i) / 'run').report()['offset'][1]
             for i in range(1, 4)]
    second = found['before', 2]
    assert second['repeats'] == 3
    assert second['offset_percent']['mean'] == pytest.approx(np.mean(alone))
    assert second['offset_percent']['std'] == pytest.approx(np.std(alone, ddof=1))
    assert abs(found['after', 2]['offset_percent']['mean']) < 0.2 * abs(np.mean(alone))
    rows = list(csv.DictReader((folders / 'bands.csv').read_text().splitlines()))
    curves = {x['curve'] for x in rows if x['panel'] == 'b'}
    assert curves >= {f'{x}{y}' for x in MODULI for y in (' (3)', ', mean - std', ', mean + std')}
    last = {x['curve']: float(x['y']) for x in rows if x['panel'] == 'b'}
    low, mean, high = (last[f'before{x}'] for x in (', mean - std', ' (3)', ', mean + std'))
    assert low < mean < high
    assert 0.5 * (low + high) == pytest.approx(mean)


def test_a_folder_of_repeats_and_a_run_can_be_compared_and_what_is_neither_is_refused(
        folders, capsys, refusal, tmp_path):
    single = folders / 'after' / '1' / 'run'
    assert repeats_in(single) == repeats_in(tmp_path) == repeats_in(tmp_path / 'none') == []
    assert main(['compare', str(folders / 'before'), str(single)]) == 0
    shown = capsys.readouterr().out
    assert ' of 3' in shown
    assert ' of 1' in shown
    assert str(tmp_path) in refusal('compare', folders / 'before', tmp_path)
    assert 'leave out --panels' in refusal(
        'compare --panels phase', folders / 'before', single, '--picture', tmp_path / 'x.svg')
