"""The complete demo: real processes over DDS, with one core loaded, evaluated from its bag."""

import json
import os
from pathlib import Path
import signal

from extras import needs
from mcap.reader import make_reader
import pytest

# Slow motion makes it last some 15 s; a loaded machine takes longer.
DEMO_SECONDS = 120.0
LARGEST_RESIDUAL = 1e-6

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.mark.slow
def test_every_setpoint_is_reached_and_held_while_another_process_loads_a_core(start, tmp_path):
    out = tmp_path / 'out'
    busy = start.python('-c', 'while True: pass')
    demo = start.hmsa('demo', '--out', str(out), '--json')
    assert demo.wait(DEMO_SECONDS) == 0, demo.output
    assert busy.alive()
    result = json.loads(demo.stdout)
    assert result['succeeded']
    assert [x['stretch'] for x in result['setpoints']] == [1.1, 1.2, 1.4]
    for setpoint in result['setpoints']:
        assert setpoint['residual'] <= LARGEST_RESIDUAL
        assert setpoint['error'] <= LARGEST_RESIDUAL
        assert setpoint['residual_unshaped'] > 0.5
    # Known values of the paper's first and third move.
    assert result['setpoints'][0]['tau_p'] == pytest.approx(1.315749737, abs=1e-6)
    assert result['setpoints'][2]['b_p'] ** 2 == pytest.approx(0.778278436, abs=1e-6)
    assert result['exits'] == {'recorder': 0, 'plant': 0, 'planner': 0}
    # The second act: open loop misses, feedback arrives.
    for move in result['adapting']['moves']:
        worst = max(move['vibration'], abs(move['offset']))
        assert worst < 0.005 if move['feedback'] == 'cautious' else worst > 0.1
    assert Path(result['adapting']['picture']).read_bytes().startswith(b'\x89PNG')
    assert Path(result['picture']).read_bytes().startswith(b'\x89PNG')
    _check_bag(Path(result['bag']))

    # The same folder again would mix two runs.
    again = start.hmsa('demo', '--out', str(out))
    assert again.wait(DEMO_SECONDS) == 2
    assert 'earlier run' in again.stderr
    assert 'Traceback' not in again.stderr


def _check_bag(bag: Path) -> None:
    """Read the bag with two independent readers."""
    typesys = needs('rosbags.typesys')
    with needs('rosbags.highlevel').AnyReader(
            [bag], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_JAZZY)) as reader:
        counts = {x.topic: x.msgcount for x in reader.connections}
        # Two a setpoint, and signs of life with the last one.
        assert counts['/flux_density_command'] >= 6
        connections = [x for x in reader.connections if x.topic == '/joint_states']
        stamps = []
        for connection, _, data in reader.messages(connections=connections):
            message = reader.deserialize(data, connection.msgtype)
            stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
    # 20 kHz of the plant's own time, none missing.
    assert {b - a for a, b in zip(stamps, stamps[1:], strict=False)} == {50_000}
    with next(bag.glob('*.mcap')).open('rb') as file:
        assert make_reader(file).get_summary().statistics.message_count == sum(counts.values())


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('moment', ['starting the nodes', 'running the sequence'])
def test_an_interrupted_demo_ends_its_processes_and_leaves_a_readable_bag(
        start, tmp_path, wait_until, number, moment):
    out = tmp_path / 'out'
    demo = start.hmsa('demo', '--out', str(out))
    if moment == 'running the sequence':
        wait_until(lambda: list(out.glob('run/*.mcap')), 'the bag', DEMO_SECONDS)
    else:
        wait_until(lambda: list(out.glob('*.log')), 'the first node', DEMO_SECONDS)
    children = _children(demo.popen.pid)
    assert demo.stop(number, DEMO_SECONDS) == 128 + number, demo.output
    assert 'Traceback' not in demo.output
    assert not [pid for pid in children if Path(f'/proc/{pid}').exists()]
    if moment == 'running the sequence':
        with next(out.glob('run/*.mcap')).open('rb') as file:
            assert make_reader(file).get_summary() is not None


@pytest.mark.slow
def test_a_planner_that_stands_still_for_longer_than_its_lead_time_has_a_second_run(
        start, tmp_path, wait_until):
    out = tmp_path / 'out'
    demo = start.hmsa('demo', '--out', str(out), '--json')
    wait_until(lambda: 'end of the sequence, 2 s' in demo.stderr, 'the first move', DEMO_SECONDS)
    planner, = (x for x in _children(demo.popen.pid)
                if b'\0planner\0' in Path(f'/proc/{x}/cmdline').read_bytes())
    os.kill(planner, signal.SIGSTOP)
    # Three lead times later, at 0.02 of real time.
    wait_until(lambda: 'end of the sequence, 9 s' in demo.stderr, 'the stall', DEMO_SECONDS)
    os.kill(planner, signal.SIGCONT)
    assert demo.wait(2.0 * DEMO_SECONDS) == 0, demo.output
    note, = json.loads(demo.stdout)['notes']
    assert f'(bag kept in {out / "late_1"})' in note
    assert (out / 'late_1' / 'run_0.mcap').exists()
    _check_bag(out / 'run')


def _children(pid: int) -> list[int]:
    text = Path(f'/proc/{pid}/task/{pid}/children').read_text(encoding='ascii')
    return [int(x) for x in text.split()]


def test_an_output_folder_that_cannot_be_written_is_refused_in_one_line(start, tmp_path):
    file = tmp_path / 'file'
    file.touch()
    demo = start.hmsa('demo', '--out', str(file / 'out'))
    assert demo.wait(DEMO_SECONDS) == 2
    assert len(demo.stderr.strip().splitlines()) == 1
    assert 'cannot write' in demo.stderr
