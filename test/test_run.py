"""A complete experiment with one command: measurements, refusals, and end."""

import json
import re
import signal
from types import SimpleNamespace

from mcap.reader import make_reader
import numpy as np
import pytest
from test_report import KNOWN, simulated, write

from hmsa.ending import ENDING
from hmsa.errors import HmsaError
from hmsa.runs.bags import read_runs
from hmsa.runs.record import without_repeats
from hmsa_ros.cli.run import _carried_out
from hmsa_ros.clients.experiment import Experiment
from hmsa_ros.clients.processes import Session

RUN_SECONDS = 300.0
SETPOINTS = ('1.10:0.1', '1.20:0.1', '1.00:0.1')
MISMATCHED = """\
/**:
  ros__parameters:
    actuator.shear_modulus: 10000.0
/**/plant:
  ros__parameters:
    mismatch.shear_modulus: 1.1
"""
CREEPING = """\
/**:
  ros__parameters:
    actuator.density: 1900.0
    viscoelastic.ratio: [0.1, 0.05]
    viscoelastic.time: [0.02, 1.0]
"""

pytestmark = pytest.mark.ros


def test_a_simulated_experiment_arrives_and_leaves_its_bag_and_a_report(start, tmp_path):
    out = tmp_path / 'out'
    # Shorter than a recorder takes to read the parameters of the nodes.
    setpoints = ('1.10:0.03', '1.20:0.03', '1.00:0.03')
    run = start.hmsa('run', *setpoints, '--simulate', '--report', '--out', str(out), '--json')
    assert run.wait(RUN_SECONDS) == 0, run.output
    result = json.loads(run.stdout)
    assert result['verdict'] == 'arrived'
    assert [(x['setpoint'], x['target'], x['verdict']) for x in result['setpoints']] == [
        (1, 1.1, 'arrived'), (2, 1.2, 'arrived'), (3, 1.0, 'arrived')]
    for x, step in zip(result['setpoints'], (0.1, 0.1, 0.2), strict=True):
        assert abs(x['offset']) < 1e-6
        assert x['offset_percent'] == pytest.approx(100.0 * x['offset'] / step)
        assert x['vibration'] < 1e-6
        assert x['offset_std'] < 1e-6
        assert x['vibration_std'] < 1e-6
    assert result['exits'] == {'controller': 0, 'recorder': 0}
    assert '<html' in (out / 'report.html').read_text()
    # The bag itself is held against rosbags behind each test.
    found, = read_runs(out / 'run')
    assert len(without_repeats(found.commands)[0]) == 2 * len(setpoints)
    assert found.parameters_known


@pytest.mark.slow
def test_a_wave_comes_back_to_its_amplitude_and_mean_in_the_nodes(start, tmp_path):
    file, path, out = (tmp_path / x for x in ('softer.yaml', 'path.csv', 'out'))
    file.write_text(MISMATCHED.replace('1.1', '0.9'))
    wave = ('wave', 'sine', '--frequency', '30', '--amplitude', '0.05', '--path', str(path))
    assert start.hmsa(*wave).wait(RUN_SECONDS) == 0
    run = start.hmsa(
        'run', '--path', str(path), '--simulate', '--feedback', 'adapt', '--params-file',
        str(file), '--out', str(out), '--json')
    assert run.wait(RUN_SECONDS) == 0, run.output
    assert json.loads(run.stdout)['verdict'] == 'arrived'
    found, = read_runs(out / 'run')
    begin = without_repeats(found.commands)[0][0].stamp
    turns = 30.0 * (np.asarray(found.time) - begin) / 1e9

    def kept(first):
        inside = (turns >= first) & (turns < first + 1)
        angle = 2.0 * np.pi * turns[inside]
        mean, *both = np.linalg.lstsq(np.column_stack([
            np.ones(len(angle)), np.sin(angle), np.cos(angle), np.sin(2.0 * angle),
            np.cos(2.0 * angle)]), found.stretch[inside], rcond=None)[0][:3]
        return np.hypot(*both) / 0.05 - 1.0, (mean - 1.0) / 0.05

    assert kept(1)[0] > 0.05
    assert np.abs(kept(9)).max() < 3e-3


@pytest.mark.slow
def test_a_plant_that_is_not_as_the_planner_thinks_fails_with_the_figures(start, tmp_path):
    file = tmp_path / 'mismatched.yaml'
    file.write_text(MISMATCHED)
    run = start.hmsa('run', '1.10:0.1', '--simulate', '--params-file', str(file),
                     '--out', str(tmp_path / 'out'))
    assert run.wait(RUN_SECONDS) == 1, run.output
    # A block that is a tenth stiffer stays a tenth of the way short.
    assert re.search(r'setpoint 1 of 1: rests 0\.009\S* \(9\.\S* %\) short of 1\.1', run.stdout), (
        run.output)
    again = start.hmsa('run', '1.10:0.1', '--simulate', '--out', str(tmp_path / 'out'))
    assert again.wait(RUN_SECONDS) == 2
    assert 'earlier run' in again.stderr


@pytest.mark.slow
def test_noise_of_the_sensor_is_no_vibration(start, tmp_path):
    file = tmp_path / 'noisy.yaml'
    file.write_text(MISMATCHED.replace('mismatch.shear_modulus: 1.1', 'stretch_noise: 0.001'))
    run = start.hmsa('run', '1.3:1', '1.05:1', '1.3:1', '--simulate', '--params-file', str(file),
                     '--out', str(tmp_path / 'out'), '--json')
    assert run.wait(RUN_SECONDS) == 0, run.output
    assert {x['verdict'] for x in json.loads(run.stdout)['setpoints']} == {'arrived'}


@pytest.mark.slow
@pytest.mark.parametrize('feedback', ['off', 'adapt'])
def test_a_block_arrives_and_stays_though_it_creeps(start, tmp_path, feedback):
    file = tmp_path / 'creeping.yaml'
    file.write_text(f'{CREEPING}    feedback: "{feedback}"\n')
    run = start.hmsa('run', '1.4:0.1', '1.1:0.2', '--simulate', '--params-file', str(file),
                     '--report', '--out', str(tmp_path / 'out'), '--json')
    assert run.wait(RUN_SECONDS) == 0, run.output
    for x, step in zip(json.loads(run.stdout)['setpoints'], (0.4, 0.3), strict=True):
        # Unknown to the planner, creep leaves a fifth of the step.
        assert x['vibration'] < 1e-3 * step
        assert abs(x['offset']) < 1e-3 * step


@pytest.mark.slow
def test_an_interrupted_experiment_brings_the_running_actuator_to_rest(start, ros, tmp_path):
    from hmsa.interfaces import topics

    statuses = ros.collect(topics.STATUS, 'planner/status')
    # Far enough ahead for a busy machine, and no time passes where that stops the plant.
    nodes = [
        start.hmsa('plant', '--ros-args', '-p', 'publish_clock:=true'),
        start.hmsa('planner', '--ros-args', '-p', 'use_sim_time:=true', '-p', 'lead_time:=3.0')]

    def now(key: str) -> str:
        return {x.key: x.value for x in statuses[-1].values}.get(key, '') if statuses else ''

    run = start.hmsa('run', '1.2:30', '1.0:30', '--out', str(tmp_path / 'out'))
    ros.spin_until(lambda: now('state') == 'holding' or not run.alive(), 'the first setpoint')
    assert run.stop(signal.SIGINT) == 130, run.output
    assert 'Traceback' not in run.output
    ros.spin_until(lambda: now('setpoints') != '2', 'the stop')
    assert now('state') in ('at_rest', 'settling')
    assert all(x.alive() for x in nodes)
    with next((tmp_path / 'out' / 'run').glob('*.mcap')).open('rb') as file:
        assert make_reader(file).get_summary() is not None
    found, = read_runs(tmp_path / 'out' / 'run')
    assert found.stretch[-1] == pytest.approx(1.2, abs=1e-3)
    assert abs(found.rate[-1]) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize('moment', ['controller.log', 'recorder.log', 'run/*.mcap'])
def test_an_experiment_can_be_interrupted_at_any_moment(start, tmp_path, wait_until, moment):
    out = tmp_path / 'out'
    run = start.hmsa('run', '1.1:1', '1.2:1', '--simulate', '--out', str(out))
    wait_until(lambda: list(out.glob(moment)), moment, RUN_SECONDS)
    assert run.stop(signal.SIGINT, RUN_SECONDS) == 130, run.output
    assert 'Traceback' not in run.output
    for file in out.glob('run/*.mcap'):
        with file.open('rb') as opened:
            assert make_reader(opened).get_summary() is not None


@pytest.mark.slow
def test_commands_that_nobody_takes_fail_before_anything_is_sent(start, tmp_path):
    start.hmsa('planner')
    run = start.hmsa('run', '1.1:0.1', '--out', str(tmp_path / 'out'))
    assert run.wait(RUN_SECONDS) == 1
    assert 'no node receives the commands' in run.stderr
    assert not (tmp_path / 'out' / 'run').exists()


@pytest.mark.slow
def test_nodes_with_other_parameters_than_the_file_are_refused(start, tmp_path):
    file = tmp_path / 'other.yaml'
    file.write_text('/**:\n  ros__parameters:\n    actuator.shear_modulus: 66000.0\n')
    start.hmsa('planner')
    start.hmsa('plant')
    run = start.hmsa(
        'run', '1.1:0.1', '--out', str(tmp_path / 'out'), '--params-file', str(file))
    assert run.wait(RUN_SECONDS) == 2
    assert 'planner.actuator.shear_modulus is 10000.0 and not 66000.0' in run.stderr
    # After what was under way, one line.
    *before, error = run.stderr.strip().splitlines()
    assert error.startswith('hmsa: error: ')
    assert all(x.endswith(' ...') for x in before)


def test_feedback_that_there_is_not_is_refused(start, tmp_path):
    run = start.hmsa('run', '1.1:0.1', '--feedback', 'guess', '--out', str(tmp_path / 'out'))
    assert run.wait(RUN_SECONDS) == 2
    assert "invalid choice: 'guess'" in run.stderr


@pytest.mark.slow
@pytest.mark.ros
def test_a_simulated_experiment_with_feedback_arrives_and_records_what_is_believed(
        start, tmp_path):
    file = tmp_path / 'mismatched.yaml'
    # In slow motion: a busy machine takes its time, and feedback shall correct a move in it.
    file.write_text(f'{MISMATCHED}    real_time_factor: 0.3\n')
    run = start.hmsa('run', '1.1:1.5', '1.3:1.5', '--simulate', '--feedback', 'adapt',
                     '--params-file', str(file), '--out', str(tmp_path / 'out'))
    assert run.wait(RUN_SECONDS) == 0, run.output
    assert 'all 2 moves arrived' in run.stdout
    file, = (tmp_path / 'out').rglob('*.mcap')
    with open(file, 'rb') as stream:
        topics = {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert '/planner/estimate' in topics


@pytest.mark.slow
def test_a_simulated_experiment_never_commands_nodes_that_run_already(start, ros, tmp_path):
    from hmsa.interfaces import topics

    asked = ros.collect(topics.JOINT_TRAJECTORY, 'planner/joint_trajectory')
    start.hmsa('plant')
    planner = start.hmsa('planner')
    ros.spin_until(lambda: 'planner' in ros.node.get_node_names() or not planner.alive(), 'it')
    run = start.hmsa('run', '1.1:0.1', '--simulate', '--out', str(tmp_path / 'out'))
    assert run.wait(RUN_SECONDS) == 1
    assert 'another planner, plant or driver is running' in run.stderr
    assert not asked


@pytest.mark.parametrize(('error', 'status'), [
    (KeyboardInterrupt, 130), (HmsaError('the planner ended early'), 1)])
def test_the_repeats_that_have_ended_are_printed_after_an_interrupt_or_an_error(
        handlers, command, monkeypatch, tmp_path, error, status):
    left = [1, 2]

    def conduct(experiment, *_):
        if not left:
            raise error
        left.pop()
        write(experiment.bag, simulated(), **KNOWN)
        return SimpleNamespace(
            measured=True, exits={}, notes=(), seconds={'start': 1.0, 'sequence': 1.0}, pace=1.0)

    monkeypatch.setattr('hmsa_ros.clients.experiment.conduct', conduct)
    line = 'run 1.1:10 1.2:10 1.4:10 --simulate --repeat 4 --json --out'
    found, shown, said = command(line, tmp_path / 'out')
    assert found == status
    assert ('interrupted' if status == 130 else 'the planner ended early') in said
    result = json.loads(shown)
    assert [x['verdict'] for x in result['repeats']] == ['arrived', 'arrived']
    assert [x['repeats'] for x in result['statistics']] == [2, 2, 2]


def test_the_evaluation_of_a_run_can_be_interrupted(handlers, monkeypatch, tmp_path):
    experiment = Experiment(tmp_path, ((1.1, 1.0),))
    monkeypatch.setattr(
        'hmsa_ros.clients.experiment.conduct', lambda *_: SimpleNamespace(measured=True))
    monkeypatch.setattr(
        'hmsa.runs.bags.read_runs', lambda *_, **__: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(ENDING, 'asked', False)
    ENDING.note()
    with pytest.raises(KeyboardInterrupt):
        _carried_out(SimpleNamespace(report=False), experiment, None, lambda *_: None)


def test_a_node_that_could_not_write_its_log_ends_with_the_full_disk_as_the_reason(
        tmp_path, monkeypatch):
    session = Session(tmp_path)
    session.log('recorder').touch()
    assert session.last_words('recorder').startswith('it printed nothing (log: ')
    monkeypatch.setattr('shutil.disk_usage', lambda _: SimpleNamespace(free=0))
    assert session.last_words('recorder').startswith(f'the disk of {tmp_path} is full (log: ')
