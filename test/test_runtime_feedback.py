"""A planner that learns from samples: a simulated device, without ROS."""

import math

import numpy as np
import pytest
from test_runtime_measured import Loop, MS, START

from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.planner import Options
from hmsa_ros.core.timeline import Model
from hmsa_ros.runtime.records import EstimateChanged, Send, Settings, Severity, StatusChanged


def estimates(loop):
    return [x for x in loop.outputs if isinstance(x, EstimateChanged)]


def codes(loop):
    return [x.verdict.code for x in loop.outputs if isinstance(x, StatusChanged)]


def commands(loop):
    return [(x.stamp, x.flux_density) for x in loop.outputs if isinstance(x, Send)]


def left(truth, begin, end, target, step):
    """Return vibration and offset between two times in ms after the start, as shares of a step."""
    seen = truth[(truth[:, 0] >= START + begin * MS) & (truth[:, 0] < START + end * MS), 1]
    return np.ptp(seen) / step, (np.mean(seen) - target) / step


@pytest.mark.parametrize('factor', [0.8, 1.2])
def test_observing_says_what_is_wrong_and_changes_nothing(factor):
    loop, plain = (
        Loop(factor, 1e-3, heartbeat_period=0, feedback=x) for x in ('observe', 'off'))
    truth, same = loop.run((1.4, 300 * MS)), plain.run((1.4, 300 * MS))
    assert np.array_equal(truth, same)
    assert not estimates(plain)
    last = estimates(loop)[-1]
    short, change = ('short', '+20 %') if factor > 1.0 else ('far', '-20 %')
    assert last.severity is Severity.WARN
    assert f'% {short}' in last.message
    assert ' Hz: G about ' + change in last.message
    assert 'feedback: adapt mends it' in last.message
    assert float(last.values['shear_modulus']) == pytest.approx(
        factor * 1e4, abs=5 * float(last.values['shear_modulus.std']))
    assert last.values['used_by_plans'] is False


@pytest.mark.parametrize(('factor', 'noise'), [(0.8, 1e-3), (1.2, 1e-3), (1.2, 0.0)])
def test_adapting_corrects_the_first_move_and_plans_the_second_with_what_was_learnt(
        factor, noise):
    loop = Loop(factor, noise, delay=2 * MS, feedback='adapt')
    truth = loop.run((1.4, 300 * MS), (1.1, 300 * MS))
    # 50 ms ahead of their stamps, commands come too late for the first move itself.
    assert max(map(abs, left(truth, 60, 80, 1.4, 0.4))) > 0.1
    for begin, end, target, step in ((200, 300, 1.4, 0.4), (420, 600, 1.1, 0.3)):
        vibration, offset = left(truth, begin, end, target, step)
        assert vibration < 0.005
        assert abs(offset) < 0.005
    # What the second move left without a further correction.
    vibration, offset = left(truth, 360, 400, 1.1, 0.3)
    assert vibration < 0.01
    assert abs(offset) < 0.01
    assert 'corrected' in codes(loop)
    assert codes(loop)[-1] == 'arrived'
    assert 'plans use it' in estimates(loop)[-1].message


def test_an_actuator_that_is_as_known_is_left_alone():
    loop, plain = (Loop(1.0, 1e-3, heartbeat_period=0, feedback=x) for x in ('adapt', 'off'))
    truth = loop.run((1.4, 300 * MS))
    plain.run((1.4, 300 * MS))
    assert len(commands(loop)) <= len(commands(plain)) + 3
    vibration, offset = left(truth, 200, 300, 1.4, 0.4)
    assert vibration < 0.0025
    assert abs(offset) < 0.0025
    assert estimates(loop)[-1].message == 'as known'


def test_a_sensor_that_fails_leaves_the_plan_in_force_and_is_named():
    def jump(samples):
        return [(x, y + 0.05 * (x > START + 250 * MS)) for x, y in samples]

    def nothing(samples):
        return [(x, math.nan if x > START + 250 * MS else y) for x, y in samples]

    for spoil, word in ((jump, 'jump'), (nothing, 'G about')):
        loop = Loop(1.2, 1e-3, heartbeat_period=0, feedback='adapt')
        loop.spoil = spoil
        truth = loop.run((1.4, 600 * MS))
        assert word in estimates(loop)[-1].message
        assert not [x for x in commands(loop) if x[0] > START + 310 * MS]
        vibration, offset = left(truth, 400, 600, 1.4, 0.4)
        assert vibration < 0.005
        assert abs(offset) < 0.005


def test_what_was_learnt_outlives_other_options_but_not_another_block():
    loop = Loop(1.2, 1e-3, feedback='adapt')
    loop.run((1.4, 300 * MS))
    planner = loop.runtime.group.planners['a']
    assert planner.model.actuator.shear_modulus == pytest.approx(1.2e4, rel=5e-3)
    given = Model(paper_actuator(), Options(shaper='robust'))
    settings = Settings(feedback='adapt', takeover_timeout=0)
    loop.runtime.change(settings, {'a': given}, simultaneous=False)
    assert planner.model.options.shaper == 'robust'
    assert planner.model.actuator.shear_modulus == pytest.approx(1.2e4, rel=5e-3)
    loop.runtime.change(
        Settings(takeover_timeout=0), {'a': given}, simultaneous=False)
    assert planner.model.actuator.shear_modulus == 1e4
