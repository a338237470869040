"""A selection of the faults that `python -m benchmarks faults` injects, and a short soak."""

import json
import math
import random
import signal
from threading import Thread

from conftest import wait_until
import numpy as np
import pytest

from benchmarks import __main__ as program
from benchmarks import bench_faults, bench_soak
from benchmarks.faults import memory, rows
from benchmarks.faults.rig import Rig, settled
from benchmarks.faults.table import inject, Seen
from hmsa.bag.writer import BagTopic, BagWriter

MIB = 2**20


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.xdist_group('loops')
@pytest.mark.parametrize('fault', [
    pytest.param(x, id=x.key) for x in rows.FAULTS if x.key in rows.QUICK])
def test_fault_is_answered_as_expected(fault, ros_domain_id):
    seen = inject(fault, ros_domain_id)
    assert seen.met, f'expected {fault.expected}; seen {seen.text} ({seen.figure})'


@pytest.mark.ros
def test_a_rig_is_ready_once_its_relay_has_found_planner_and_plant(ros_domain_id, tmp_path):
    with Rig(tmp_path, ros_domain_id) as rig:
        remap = rig.relay()
        relay = rig.children[-1]
        relay.send(signal.SIGSTOP)
        rig.start('plant')
        rig.start('planner', remap=remap)
        late = Thread(target=lambda: (
            wait_until(lambda: rig.diagnostics.keys() > {'plant: time', 'planner: commands'},
                       'both nodes'), relay.send(signal.SIGCONT)))
        late.start()
        rig.ready('plant', 'planner')
        late.join()
        assert 'joined' in relay.said


def test_every_fault_has_a_name_of_its_own_and_says_what_is_expected():
    keys = [x.key for x in rows.FAULTS]
    assert len(set(keys)) == len(keys)
    assert set(rows.QUICK) <= set(keys)
    assert all(x.name and x.how and x.expected for x in rows.FAULTS)


@pytest.mark.ros
def test_a_row_that_is_not_met_fails_the_run(ros_domain_id, monkeypatch, tmp_path, capfd):
    fault = rows.FAULTS[0]
    wrong = type(fault)(
        'wrong', 'none', 'nothing', 'something', lambda _: Seen('nothing', '-', met=False))
    monkeypatch.setattr(rows, 'FAULTS', (wrong,))
    monkeypatch.setenv('ROS_DOMAIN_ID', str(ros_domain_id))
    page, file = tmp_path / 'page.md', tmp_path / 'faults.json'
    page.write_text('<!-- begin faults -->\n<!-- end faults -->\n')
    assert program.main(['faults', '--page', str(page), '--json', str(file)]) == 1
    assert '**not met**' in page.read_text()
    assert json.loads(file.read_text())['faults']['figures']['rows'][0]['met'] is False
    out, err = capfd.readouterr()
    assert '0 of 1 as expected; not: wrong' in out
    assert 'NOT MET' in err


def test_table_says_what_was_expected_beside_what_was_seen():
    fault = rows.FAULTS[0]
    sheet = bench_faults.sheet([fault] * 2, [
        Seen('a | b', '1e-9', met=True), Seen('a | b', '1e-9', met=False)])
    assert not sheet.passed
    *_, head, _, met, missed = sheet.markdown().splitlines()
    assert head.count('|') == 5
    assert met.endswith(f'| {fault.expected} | 1e-9 |')
    assert missed.endswith(f'| {fault.expected}; **not met**: a \\| b | 1e-9 |')


def test_residual_counts_from_the_last_change_of_the_field():
    time = np.arange(200)
    flux = np.where(time < 50, 0.0, np.where(time < 56, 0.2, 0.1))
    stretch = np.where(time < 56, 1.0 + 0.0005 * time, 1.1)
    stretch[60] += 0.005
    stretch[100] += 0.002
    values = np.column_stack([stretch, 0.0 * time, flux])
    # The last change brings back the level of the samples before and after it.
    applied = [(50, 0.2), (56, 0.1), (60, 0.2), (60, 0.1), (500, 0.3)]
    residual, error = settled(time, values, applied, 1.11, 0.1)
    assert residual == pytest.approx(0.02)
    assert error == pytest.approx(0.1)


def lives(slope, *, noise=0.0, count=400, lives=3):
    """Return samples of several lives of an hour each, growing by a rate in bytes per hour."""
    dice = random.Random(1)
    samples = []
    for life in range(lives):
        for i in range(count):
            age = i / count
            own = 50 * MIB + life * 3 * MIB + slope * age + dice.gauss(0.0, noise)
            samples.append(memory.Sample(life + age, life, age, round(own), 0, 0))
    return samples


def test_a_leak_is_found_through_restarts_and_noise():
    found = memory.trend(lives(6 * MIB, noise=0.3 * MIB), 0.1)
    assert found.slope == pytest.approx(6 * MIB, rel=0.05)
    assert not found.flat


@pytest.mark.parametrize(('slope', 'noise'), [(0.0, 0.5 * MIB), (0.3 * MIB, 0.0), (-MIB, 0.0)])
def test_memory_that_does_not_grow_is_flat(slope, noise):
    assert memory.trend(lives(slope, noise=noise), 0.1).flat


def test_memory_of_a_process_is_read_and_one_that_is_gone_has_none():
    import os
    own, pss, rss = memory.used(os.getpid())
    assert 0 < own <= rss
    assert 0 < pss <= rss
    assert memory.used(2**22 + 1) == (0, 0, 0)


def test_garbage_among_the_samples_of_a_rough_bag_is_counted_and_not_read(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        number = writer.add_topic(BagTopic('/joint_states', 'sensor_msgs/msg/JointState'))
        writer.write([(number, 1, 1, 1, bytes(8)), (number, 2, 2, 2, bytes(100))])
    found = bench_soak.check_bag(tmp_path / 'bag', 'rough', '')
    assert (found.samples, found.missing, found.failure) == (2, 0, '')


def test_the_soak_fails_for_each_thing_that_must_not_be():
    flat = memory.Trend(0.0, 1.0, 1.0, 10)
    good = bench_soak.Cycle('calm', '', samples=10, difference=0.0)
    assert bench_soak.Result(cycles=[good], trends={'plant': flat}).failures() == []
    for result, text in (
            (bench_soak.Result(traces=['planner: ValueError']), 'exception'),
            (bench_soak.Result(ended=['plant with status 1']), 'ended'),
            (bench_soak.Result(statuses=[0, 1]), 'exit status 1'),
            (bench_soak.Result(cycles=[bench_soak.Cycle('rough', '', samples=1, lost=3)]), 'lost'),
            (bench_soak.Result(cycles=[bench_soak.Cycle(
                'calm', '', samples=10, missing=2, difference=0.0)]), 'missing'),
            (bench_soak.Result(cycles=[bench_soak.Cycle('calm', '', samples=10)]), 'differs'),
            (bench_soak.Result(trends={'plant': memory.Trend(9e6, 1.0, 1.0, 10)}), 'grows')):
        found, = result.failures()
        assert text in found
    assert math.isnan(bench_soak.Cycle('calm', '').difference)
