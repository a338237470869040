"""Planner, plant and recorder on hosts with connection losses and different clocks."""

from pathlib import Path
import signal
from time import time

import numpy as np
import pytest

from benchmarks.faults.hosts import ACROSS, hosts, unavailable
from hmsa_ros.middleware import PROFILES

WHY = unavailable()
ONLOOKER = Path(__file__).with_name('onlooker.py')
PLANNER = """
import sys
from hmsa_ros.middleware import prepare_middleware
prepare_middleware()
from hmsa_ros.nodes.planner import PlannerNode
from hmsa_ros.nodes.managed import run

class Shifted(PlannerNode):
    def now(self):
        return super().now() + int({ahead} * 1e9)

sys.exit(run(Shifted, []))
"""

PLANT = ('plant', '--ros-args')
# Far ahead for a busy machine.
PLANNER_AHEAD = ('planner', '--ros-args', '-p', 'lead_time:=0.5')

pytestmark = [pytest.mark.slow, pytest.mark.ros]
on_hosts = pytest.mark.skipif(bool(WHY), reason=WHY)


class Laboratory:
    """Processes on several hosts."""

    def __init__(self, made, start, tmp_path, wait_until):
        self.hosts, self._start, self._file = made, start, tmp_path / 'seen.npy'
        self.wait_until = wait_until

    def run(self, host, *arguments):
        """Start this Python with arguments on a host."""
        import sys
        return self._start(
            *self.hosts.on(host, sys.executable, *map(str, arguments)),
            **dict.fromkeys(PROFILES, ''), **ACROSS)

    def hmsa(self, host, *arguments):
        return self.run(host, '-m', 'hmsa_ros', *arguments)

    def look_on(self, host):
        self._onlooker = self.run(host, ONLOOKER, self._file)
        self._onlooker.wait_for_output('sees')

    def seen(self):
        """Return timestamps and times of arrival in s, stretches and flux densities in T."""
        assert self._onlooker.stop(signal.SIGTERM) == 0, self._onlooker.output
        return np.load(self._file).T

    def wait(self, seconds):
        end = time() + seconds
        self.wait_until(lambda: time() > end, f'{seconds} s')


@pytest.fixture
def laboratory(start, tmp_path, wait_until):
    with hosts('bench', 'desk', 'third') as made:
        yield Laboratory(made, start, tmp_path, wait_until)


@on_hosts
@pytest.mark.parametrize(('end', 'lost', 'outage', 'words'), [
    ('cut', ['desk'], 2.0, 'no receipt'), ('cut', ['desk'], 25.0, 'no receipt'),
    # One way alone.
    ('lose', ['desk', 'bench'], 8.0, 'commands of joint actuator do not arrive'),
    ('lose', ['bench', 'desk'], 8.0, 'no receipt')])
def test_after_an_outage_nothing_moves_that_nobody_has_asked_for(
        laboratory, end, lost, outage, words):
    plant = laboratory.hmsa('bench', *PLANT, '-p', 'safe_flux:=zero')
    planner = laboratory.hmsa('desk', *PLANNER_AHEAD)
    laboratory.look_on('bench')
    sent = laboratory.hmsa('desk', 'send', '1.2:1', '--wait')
    assert sent.wait() == 0, sent.output
    sent = laboratory.hmsa('desk', 'send', '1.1:1', '1.35:600', '--wait')
    sent.wait_for_output('setpoint 2 of 2: at_rest')
    laboratory.wait(1.0)
    # A busy machine takes its time for the cut itself.
    cut = time()
    getattr(laboratory.hosts, end)(*lost)
    plant.wait_for_output('the field goes to zero')
    planner.wait_for_output(words)
    laboratory.wait(cut + outage - time())
    getattr(laboratory.hosts, {'cut': 'join', 'lose': 'find'}[end])(*lost)
    joined = time()
    planner.wait_for_output('was cut off by the plant or driver')
    assert sent.wait() == 1, sent.output
    laboratory.wait(1.0)
    again = time()
    sent = laboratory.hmsa('desk', 'send', '1.2:1', '--wait')
    assert sent.wait() == 0, sent.output
    stamps, _, stretches, fields = laboratory.seen()
    before = stretches[(stamps < cut) & (stamps > cut - 1.0)]
    assert before == pytest.approx(1.35, abs=1e-3)
    waiting = (stamps > joined) & (stamps < again)
    assert waiting.any()
    assert not fields[waiting].any()
    assert stretches[waiting] == pytest.approx(1.0, abs=1e-3)
    asked = stretches[stamps > again]
    assert 1.199 < asked.max() < 1.202
    assert asked[-100:] == pytest.approx(1.2, abs=1e-4)


@on_hosts
@pytest.mark.parametrize('where', ['bench', 'desk'])
def test_a_recorder_whose_host_goes_away_holds_nobody_up(laboratory, where):
    plant = laboratory.hmsa('bench', *PLANT)
    planner = laboratory.hmsa(where, *PLANNER_AHEAD)
    recorder = laboratory.run('third', ONLOOKER, '/dev/null')
    recorder.wait_for_output('sees')
    laboratory.look_on('bench')
    cut = time()
    laboratory.hosts.cut('third')
    sent = laboratory.hmsa(
        where, 'send', *(f'{x}:1' for x in (1.2, 1.4, 1.1, 1.3, 1.0)), '--wait')
    assert sent.wait() == 0, sent.output
    laboratory.wait(cut + 10.0 - time())
    _, arrivals, _, _ = laboratory.seen()
    # By default a send waits there for up to 6 s, or is dropped for as long.
    assert np.diff(arrivals[arrivals > cut]).max() < 1.0
    assert 'no receipt' not in planner.output
    assert 'heartbeat' not in plant.output
    assert 'clock' not in plant.output


@pytest.mark.parametrize(('ahead', 'text'), [
    (0.6, 'after their timestamps'), (-3.0, 'before their timestamps')])
def test_a_planner_with_another_clock_refuses_to_move(start, tmp_path, ahead, text):
    plant = start.hmsa('plant')
    planner = start.python('-c', PLANNER.format(ahead=ahead))
    onlooker = start.python(ONLOOKER, tmp_path / 'seen.npy')
    onlooker.wait_for_output('sees')
    sent = start.hmsa('send', '1.2:1', '--wait')
    assert sent.wait() == 2, sent.output
    assert text in planner.output
    assert 'refused (clocks_differ)' in planner.output
    assert onlooker.stop(signal.SIGTERM) == 0
    assert not np.load(tmp_path / 'seen.npy')[:, 3].any()
    assert plant.alive()
