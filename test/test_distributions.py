"""Nodes and bags of one ROS 2 distribution beside those of another."""

import os
from pathlib import Path
import signal

import pytest

from hmsa_ros.middleware import PROFILES

#: Interpreter of an environment with another distribution, as .ci/run makes one.
OTHER = os.environ.get('OTHER_PYTHON', '')
# What this process has set for its own distribution.
NEUTRAL = dict.fromkeys(
    ('LD_LIBRARY_PATH', 'PYTHONPATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE', *PROFILES), '')

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(not OTHER, reason='OTHER_PYTHON names no other environment')]


@pytest.fixture
def of(start):
    """Return a starter of ``hmsa`` of this distribution or of the other."""
    def run(other, *arguments):
        if not other:
            return start.hmsa(*arguments)
        # Not as a module, which Python would look for in the working directory first.
        return start(Path(OTHER).with_name('hmsa'), *arguments, **NEUTRAL)
    return run


def words(process):
    assert process.wait() == 0, process.output
    return process.output


@pytest.mark.parametrize('other', [False, True], ids=['planner-here', 'planner-there'])
def test_a_planner_moves_a_plant_of_the_other_and_each_measures_the_arrival(of, other):
    plant = of(not other, 'plant')
    planner = of(other, 'planner', '--ros-args', '-p', 'lead_time:=0.5')
    for sender in (other, not other):
        halts = 0
        while True:
            send = of(sender, 'send', '--wait', '--timeout', '30', '1.2:0.5', '1.1:0.5')
            failed = send.wait()
            # A machine that starts two distributions at once may halt one of the processes.
            now = sum(x.output.count(y) for x in (plant, planner) for y in (
                'behind the clock', 'stood still'))
            if not failed or now == halts:
                break
            halts = now
        assert 'measured' in words(send)


@pytest.mark.parametrize('other', [False, True], ids=['recorded-here', 'recorded-there'])
def test_a_bag_of_one_is_verified_reported_and_replayed_by_the_other(of, other, tmp_path):
    bag = tmp_path / 'bag'
    of(other, 'plant', '--ros-args', '-p', 'publish_rate:=200.0')
    of(other, 'planner', '--ros-args', '-p', 'lead_time:=0.5')
    recorder = of(other, 'recorder', '--ros-args', '-p', f'storage.uri:={bag}')
    words(of(other, 'send', '--wait', '--recorded', '--timeout', '30', '1.2:0.5', '1.1:0.5'))
    assert recorder.stop(signal.SIGINT) == 0, recorder.output
    verified = words(of(not other, 'bag', 'verify', bag))
    assert '0 late' in verified
    assert words(of(not other, 'report', bag, '--out', tmp_path / 'report.html'))
    played = of(not other, 'player', '--ros-args', '-p', f'storage.uri:={bag}',
                '-p', 'play.rate:=10.0')
    assert played.wait() == 0, played.output
