"""Classes of hardware that pass ``hmsa check-driver``, and messages about the others."""

import json
from pathlib import Path

import numpy as np
import pytest

from hmsa.cli import main
from hmsa.model.sensor import Sample
from hmsa_lab.bench import bench, conformance
from hmsa_lab.bench.bench import Bench, PhaseResults

# One class for all: a block at a level, whose state survives its process, in a file.
BENCH = '''
from pathlib import Path
from time import sleep, time_ns


class Coil:
    """A block that follows its coil at once, and a sensor with noise."""

    def __init__(self, joint, file='level.txt'):
        self.file = Path(file)
        self.count = 0

    def write(self, level, now):
        self.file.write_text(repr(level))

    def read(self, now):
        self.count += 1
        level = float(self.file.read_text()) if self.file.exists() else 0.0
        noise = 1e-5 * (self.count * 7919 % 101 / 50 - 1)
        return [(1.0 + 5 * level + noise, 0.0, time_ns())]
'''
BROKEN = {
    'levels': ('def write(self, level, now): super().write(0.9 * level, now); '
               'return now, 0.9 * level', 'level_reached'),
    'slow': ('def write(self, level, now): super().write(level, now); sleep(0.05)',
             'write_time'),
    'late': ('def write(self, level, now): super().write(level, now); return now + 8_000_000',
             'lateness'),
    'blocking': ('def read(self, now): sleep(0.1); return super().read(now)', 'read_time'),
    'stamps': ('def read(self, now): self.first = getattr(self, "first", now); '
               'return [(*super().read(now)[0][:2], self.first)]', 'stamps_rise'),
    'future': ('def read(self, now): return [(*super().read(now)[0][:2], time_ns() + 10**9)]',
               'stamps_past'),
    'frames': ('def read(self, now): self.n = getattr(self, "n", -1) + 1; '
               'self.n % 10 or setattr(self, "x", super().read(now)[0]); '
               'return [(*self.x[:2], time_ns())]', 'samples_new'),
    'polarity': ('def write(self, level, now): super().write(-level, now)', 'polarity'),
    'millimetres': ('def read(self, now): return [(20.0 * x, 0.0, t) for x, _, t in '
                    'super().read(now)]', 'rest'),
    'zero': ('def write(self, level, now): super().write(level or 1e-3, now)', 'off_at_close'),
    'clock': ('def clock(self): sleep(0.01); return time_ns()', 'clock'),
    'forgetful': ('def write(self, level, now): self.n = getattr(self, "n", 0) + 1; '
                  'self.n % 7 and super().write(level, now); '
                  'return now, float(self.file.read_text())', 'level_reached'),
    'opened': ('def close(self): self.file.write_text("0.001")', 'off_at_close'),
}


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Write a module with a hardware class, and test it; return the results."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))

    def check(capsys, name, body='', *arguments):
        (tmp_path / f'{name}_lab.py').write_text(
            f'{BENCH}\n\nclass Mine(Coil):\n    """Mine."""\n\n    {body}\n')
        status = main(['check-driver', f'{name}_lab:Mine', *arguments, '--json'])
        found = json.loads(capsys.readouterr().out)
        assert status == int(not found['passed'])
        return found
    return check


def failed(found):
    return [x['name'] for x in found['checks'] if not x['passed']]


def test_a_class_as_it_should_be_passes_and_the_page_shows_it(
        lab, capsys, tmp_path, monkeypatch):
    # Its times are this machine's, which may be busy.
    for name, value in {
            '_CALL': 1.0, '_LATE': 1.0, '_APART': 0.3, '_TIMED': 4, '_END': 30.0}.items():
        monkeypatch.setattr(conformance, name, value)
    found = lab(capsys, 'good', '', '--set', f'file={tmp_path}/mine.txt', '--report', 'page.html')
    assert (failed(found), found['untried']) == ([], [])
    assert {'level_reached', 'polarity', 'off_after_silence', 'off_at_close', 'off_at_exception',
            'off_at_sigterm'} <= {x['name'] for x in found['checks']}
    assert (tmp_path / 'mine.txt').read_text() == '0.0'
    text = (tmp_path / 'page.html').read_text()
    assert 'good_lab:Mine' in text
    assert 'lateness of levels' in text


@pytest.mark.slow
@pytest.mark.parametrize('name', BROKEN)
def test_a_broken_class_fails_the_check_that_is_for_it(lab, capsys, name):
    body, check = BROKEN[name]
    found = lab(capsys, name, body)
    assert check in failed(found), found
    (sentence,) = [x['sentence'] for x in found['checks'] if x['name'] == check]
    assert ': ' in sentence  # what to do


@pytest.mark.slow
def test_without_a_sensor_it_says_what_it_could_not_try(lab, capsys):
    found = lab(capsys, 'blind', 'def read(self, now): return []')
    assert failed(found) == []
    assert [x.partition(':')[0] for x in found['untried']] == [
        'samples', 'polarity, and whether the coil is off', 'off_at_close', 'off_at_exception',
        'off_at_sigterm']


def test_a_coil_that_was_cut_off_while_the_host_stood_still_is_set_again(lab, monkeypatch):
    monkeypatch.setattr(bench, 'SILENCE', 0.2)
    Path('coil_lab.py').write_text(BENCH)
    with Bench('coil_lab:Coil', {}, 1e-3, 200.0) as coil:
        coil.hold(0.1, [1e-3])
        coil.beats = False
        while not coil.coil.is_cut_off:
            coil.run(0.1)
        coil.beats = True
        coil.hold(0.1, [1e-3])
        assert coil.coil.asked == 1e-3


@pytest.mark.parametrize(('slow', 'of', 'slept', 'passed'), [
    (1, 30, 0, True), (3, 30, 0, True), (12, 30, 0, False), (30, 30, 0, False),
    (12, 30, 40, True), (30, 30, 40, False), (90, 1000, 0, False), (90, 1000, 10, True)])
def test_calls_that_a_busy_host_slows_down_are_not_blamed_on_the_class(slow, of, slept, passed):
    trial = conformance.ConformanceTrial('', '', {}, level=1e-3, rate=200.0)
    trial._check_calls(
        {'applied': np.array([0.05] * slow + [1e-4] * (of - slow))},
        [0.04] * slept + [1e-4] * (100 - slept))
    assert [x.passed for x in trial._checks] == [passed]


@pytest.mark.parametrize(('spacing', 'slept', 'passed'), [
    (0.005, 0.0, True), (0.0115, 0.0, False), (0.0115, 0.006, True), (0.03, 0.006, False)])
def test_samples_that_a_busy_host_delays_are_not_called_lost(spacing, slept, passed):
    trial = conformance.ConformanceTrial('', '', {}, level=1e-3, rate=200.0)
    seen = PhaseResults([], [
        Sample(round(1e9 * spacing * i), np.array([1.0 + 1e-4 * i]), np.array([0.0]),
               np.array([0.0])) for i in range(200)], [])
    trial._check_samples([seen], seen, [slept] * 100)
    assert [x.passed for x in trial._checks if x.name == 'samples_lost'] == [passed]


def phase(stretch):
    """Return a phase whose samples have these stretches."""
    return PhaseResults([], [Sample(i, np.array([x]), np.array([0.0]), np.array([0.0]))
                     for i, x in enumerate(stretch)], [])


@pytest.mark.parametrize('noise', [1e-5, 2e-4, 1e-3, 2e-3])
def test_noise_does_not_decide_whether_a_coil_is_off(noise):
    dice = np.random.default_rng(1)
    for _ in range(300):
        trial = conformance.ConformanceTrial('', '', {}, level=1e-3, rate=200.0)
        trial._check_response(*(
            phase(1.0 + x + noise * dice.standard_normal(120)) for x in (0.0, 1e-3, -1e-3)))
        assert all(x.passed for x in trial._checks)
        off = 1.0 + np.mean(noise * dice.standard_normal(120))
        assert trial._untried or abs(off - trial._rest) < 0.3 * trial._apart


@pytest.mark.parametrize(('step', 'tried'), [(1e-3, False), (1e-6, True)])
def test_a_sensor_that_a_level_moves_by_a_few_steps_is_not_said_to_repeat(step, tried):
    dice = np.random.default_rng(1)
    moving = 1.0 + np.repeat([5e-4, 1e-3] * 15, 6) + 1e-5 * dice.standard_normal(180)
    trial = conformance.ConformanceTrial('', '', {}, level=1e-3, rate=200.0)
    seen = phase(step * np.round(moving / step))
    trial._check_samples([seen], seen, [0.0])
    assert ('samples_new' in {x.name for x in trial._checks if x.passed}) is tried
    assert ('samples_new' in ''.join(trial._untried)) is not tried


@pytest.mark.parametrize(('arguments', 'expected'), [
    ('nowhere:Coil', "hardware 'nowhere:Coil' cannot be loaded"),
    ('json:loads --limit 0', 'limit is 0 T: expected a finite number above 0'),
    ('json:loads --rate 0', 'rate is 0 Hz'),
    ('json:loads --set port', '--set port: expected KEY=VALUE'),
    ("json:loads --set 'port=['", 'expected a value as in YAML'),
    ('json:loads --report /no/where.html', 'expected one that exists'),
    ('json:loads', 'does not start')])
def test_what_cannot_be_tried_is_refused(refusal, arguments, expected):
    assert expected in refusal(f'check-driver {arguments}')
