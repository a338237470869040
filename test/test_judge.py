"""What the judge says of motions of which the truth is known, in closed form."""

import numpy as np
import pytest

from hmsa_ros.judge import judge, missed, Setpoint, Tolerances, worst

MS = 1_000_000
OMEGA, DECAY = 540.0, 54.0
STEP = 0.2


def held(offset=0.0, vibration=0.0, decay=DECAY, noise=0.0, rate=1000, seconds=0.5, seed=0):
    """Return samples from the arrival at time 0 on; offset, vibration and noise in % of STEP."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    size = vibration / (1.0 + np.exp(-np.pi * decay / OMEGA))
    motion = offset + size * np.exp(-decay * time) * np.cos(OMEGA * time)
    error = noise * np.random.default_rng(seed).standard_normal(len(time))
    return (time * 1e9).astype(np.int64), 1.4 + STEP * 0.01 * (motion + error)


def setpoint(**changes):
    return Setpoint(**{
        'target': 1.4, 'start': 1.2, 'begins': -20 * MS, 'arrival': 0, 'end': 500 * MS,
        'frequency': OMEGA, 'decay': DECAY, **changes})


@pytest.mark.parametrize(('motion', 'verdict'), [
    ({}, 'arrived'), ({'noise': 0.3}, 'arrived'), ({'offset': 3.0}, 'off_target'),
    ({'vibration': 5.0}, 'vibrating'), ({'vibration': 1.0, 'noise': 0.1}, 'arrived')])
def test_verdict_is_the_truth(motion, verdict):
    found = judge(*held(**motion), setpoint())
    assert found.verdict == verdict
    assert found.to_dict()['offset_percent'] == pytest.approx(
        motion.get('offset', 0.0), abs=0.1)
    assert found.to_dict()['vibration_percent'] == pytest.approx(
        motion.get('vibration', 0.0), abs=0.5)


@pytest.mark.parametrize('motion', [
    {'offset': 3.0, 'noise': 2.5}, {'vibration': 5.0, 'decay': 0.0, 'noise': 1.0}])
def test_what_is_beyond_is_never_called_arrived(motion):
    verdicts = {str(judge(*held(seed=x, **motion), setpoint()).verdict) for x in range(60)}
    assert 'arrived' not in verdicts


def test_tolerances_count_against_the_step_as_requested():
    time, stretch = held(offset=1.5)
    assert judge(time, stretch, setpoint()).verdict == 'arrived'
    assert judge(time, stretch, setpoint(start=1.35)).verdict == 'off_target'
    assert judge(time, stretch, setpoint(start=1.35), Tolerances(stretch=0.01)).arrived


def test_the_worst_counts():
    arrived = judge(*held(), setpoint())
    left_out = missed(setpoint(number=2, count=2), 'left out')
    assert worst([arrived, left_out]) is left_out
    assert left_out.message == 'setpoint 2 of 2: 1.4 was missed: left out'
