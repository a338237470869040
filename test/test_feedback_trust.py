"""Harmless feedback: effects that samples cannot show are not learnt, and can be reverted."""

from dataclasses import replace
import math

from at_work import sample
from bench_oracle import Bench, MS, paper, Plant
import numpy as np
import pytest

from benchmarks import bench_harm
from benchmarks.laboratory import drawn
from hmsa_lab.adapt import adaptive_joint, corrections, estimator, window
from hmsa_lab.adapt.motion import follow
from hmsa_ros.runtime.records import Severity, StretchRequest, Trajectory

pytestmark = pytest.mark.thorough

MOVES = (1.4, 1.1, 1.4, 1.1, 1.4)


def low_pass(tau):
    seen = []

    def sense(time, stretch):
        before = seen[-1] if seen else stretch
        seen.append(before + (stretch - before) * -math.expm1(-1e-3 / tau))
        return [(time, seen[-1])]
    return sense


# Each made anew for a test: a low-pass goes on from what it has seen.
FAULTS = {
    'low-pass': lambda: low_pass(5e-3),
    'clipped': lambda: lambda time, x: [(time, min(x, 1.25))],
    'scaled': lambda: lambda time, x: [(time, 2.0 * x - 1.0)],
    'ahead': lambda: lambda time, x: [(time + 10 * MS, x)]}


def bench(slow=True, noise=1e-4, plant=None, factors=None, **more):
    """Return a bench; a slow block has a time scale of 44 ms, the other one of 4.4 ms."""
    nominal, true = paper(slow, **(factors or {}))
    found = Bench(
        Plant(true, **(plant or {})), nominal, noise,
        **{'lead': (2 if slow else 50) * MS, **more})
    found.pass_time(100 * MS)
    return found


def moves(it, targets=MOVES):
    """Return vibration and steady-state error of moves in % of the step."""
    slow = it.planner.model.units.time > 0.01
    return np.array([it.move(x, (1200 if slow else 400) * MS) for x in targets])


def check_unlearnt(fault, slow, noise):
    it = bench(slow, noise)
    healthy, it.sense = it.sense, FAULTS[fault]()
    moves(it, MOVES[:2])
    it.sense = healthy
    # With the parameters given it would leave nothing.
    assert np.max(np.abs(moves(it, (1.4, 1.1, 1.3))[2:])) < 0.5
    assert np.max(np.abs(moves(it, (1.15,)))) < 0.5


@pytest.mark.parametrize('fault', ['low-pass'])
def test_what_a_faulty_sensor_taught_is_forgotten_with_a_healthy_one(fault):
    check_unlearnt(fault, slow=False, noise=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize('noise', [1e-4, 1e-3])
@pytest.mark.parametrize('slow', [True, False])
@pytest.mark.parametrize('fault', FAULTS)
def test_all_faults_of_a_sensor_are_forgotten_by_all_actuators(fault, slow, noise):
    check_unlearnt(fault, slow, noise)


def test_a_move_does_not_begin_where_a_sensor_in_doubt_shows_the_actuator():
    it = bench(False, 1e-3, factors={'shear_modulus': 1.1}, glances=True,
               takeover_timeout=500 * MS)
    it.effort = lambda: [level for stamp, level in it.plant.levels if stamp <= it.now][-1]
    it.runtime.request(StretchRequest('a', 1.2))
    it.pass_time(300 * MS)
    moves(it, MOVES[:2])
    it.sense = FAULTS['scaled']()
    moves(it, MOVES[:1])
    # It would wait for a sample with a rate, and begin at twice the strain.
    assert it.runtime.request(StretchRequest('a', 1.1)).code == 'accepted'
    assert it.planner.plan.levels[0].stretch == pytest.approx(1.4, abs=2e-3)


def test_moves_are_those_of_open_loop_once_an_actuator_in_doubt_rang():
    it = bench(False, 1e-4, factors={'shear_modulus': 1.1}, glances=True, report=False,
               takeover_timeout=500 * MS)
    commanded, command, sign = [(it.now, 0.0)], it.plant.command, 1.0

    def amplify(stamp, level):
        commanded.append((stamp, level))
        command(stamp, sign * level)
    it.plant.command = amplify
    it.effort = lambda: [level for stamp, level in commanded if stamp <= it.now][-1]
    it.runtime.request(StretchRequest('a', 1.2))
    it.pass_time(200 * MS)
    assert it.runtime.follower.joints['a'].adapted()
    sign = -1.0
    it.move(1.4, 200 * MS)
    assert not it.runtime.follower.joints['a'].adapted()
    sign, rests = 1.0, it.plant.state[0]
    it.runtime.request(StretchRequest('a', 1.3))
    it.pass_time(200 * MS)
    # A move that begins at 1.4, where its levels should have led it, would leave 600 %.
    assert it.planner.plan.levels[0].stretch == pytest.approx(rests, abs=2e-3)


# What is wrong of the plant, of the block, by how many ms timestamps are late, and what is said:
# what is found, or that samples do not fit.
NOT_NAMED = pytest.mark.parametrize(('plant', 'factors', 'late', 'word'), [
    ({}, {'remanence': 1.05}, 0, 'Br about +5 %; plans use it'),
    ({}, {}, 2, ''),
    pytest.param({'lag': 5e-4}, {}, 0, 'lag about 0.5', marks=pytest.mark.slow),
    pytest.param({'lag': 5e-3}, {}, 0, '', marks=pytest.mark.slow),
    pytest.param({'ratio': 0.05}, {}, 0, '', marks=pytest.mark.slow)])


def check_harmless(slow, plant, factors, late, word):
    left = {}
    for mode in ('off', 'adapt'):
        it = bench(slow, plant=plant, factors=factors, feedback=mode)
        it.sense = lambda time, x: [(time + late * MS, x)]
        left[mode] = moves(it, MOVES[:3])
    assert np.all(np.abs(left['adapt']) < np.abs(left['off']) + 0.5)
    assert word in it.message
    assert 'plans use it' in it.message or '~/reset_estimate' in it.message


@NOT_NAMED
def test_what_nobody_named_is_found_and_does_no_harm(plant, factors, late, word):
    check_harmless(False, plant, factors, late, word)


@pytest.mark.slow
@NOT_NAMED
def test_nor_does_it_with_a_slow_actuator(plant, factors, late, word):
    check_harmless(True, plant, factors, late, word)


# Where others are suspected first, only another look finds it in time.
@pytest.mark.parametrize('slow', [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_creep_alone_is_planned_with_from_the_second_move_on(slow):
    it = bench(slow, plant={'ratio': 0.05})
    # Open loop leaves 5 or 6 % of each.
    assert np.max(np.abs(moves(it, MOVES[:2]))[1]) < 0.1
    assert 'creep about 5 %; plans use it' in it.message


def test_with_a_gain_of_the_sensor_moves_rest_where_it_shows_the_target():
    gain = 1.02
    it = bench(False, 1e-3)
    it.sense = lambda time, x: [(time, 1.0 + gain * (x - 1.0))]
    vibration, offset = moves(it).T
    targets = np.array(MOVES)
    steps = np.abs(np.diff(targets, prepend=1.0))
    shown = 1.0 + gain * (targets + 0.01 * offset * steps - 1.0) - targets
    assert np.max(np.abs(vibration[1:])) < 0.5
    assert np.max(np.abs(shown / steps)[1:]) < 0.005


# Their first moves have nothing confirmed: samples of one do not fit at first, and G changes in
# the next one of the other. Open loop leaves 49 and 27 % of the last moves.
@pytest.mark.parametrize(('seed', 'count'), [
    pytest.param(61009, 3, marks=pytest.mark.slow), (62183, 4)])
def test_without_a_confirmed_move_no_sensor_counts_as_changed(seed, count):
    laboratory = drawn(seed, bench_harm.MOVES, changes=True)
    left = bench_harm.run(replace(laboratory, targets=laboratory.targets[:count]), 'adapt')
    assert left[-1].size < 0.015
    assert 'plans use it' in left[-1].words


def test_a_sensor_that_jumps_in_a_move_is_named_and_costs_nothing():
    # Its gain changes by 1.5 % in the fourth move, which would look like an error of 5 % of the
    # sixth one.
    left = bench_harm.run(drawn(62117, bench_harm.MOVES, changes=True), 'adapt')
    assert left[3].warned
    assert max(x.size for x in left) < 0.01


def jumps(it):
    it.sense = lambda time, x: [(time, x + 0.05)]


@pytest.mark.parametrize('restart', [lambda it: it.runtime.follower.reset(), jumps])
def test_moves_that_get_worse_end_feedback_and_what_it_did_is_taken_back(monkeypatch, restart):
    # What is believed and chosen is wrong, whatever samples say.
    for name, other in (
            ('clearly_better', lambda *_, **__: True), ('differs', lambda *_: True),
            ('learnt_model', lambda model, *_: replace(model, actuator=replace(
                model.actuator, shear_modulus=1.1e4)))):
        monkeypatch.setattr(adaptive_joint, name, other)
    it = bench(False, 1e-3)
    left = np.sum(np.abs(moves(it)), axis=1)
    assert 1 <= np.count_nonzero(left > 0.5) <= 2
    assert np.all(left[3:] < 0.1)
    assert 'feedback has ended, open loop with the parameters given; ~/reset_' in it.message
    assert it.estimates[-1].values['ended'] is True
    assert 'feedback_ended' in it.codes()
    # Nor does it ring where another level takes the place of what was learnt.
    assert 'vibrating' not in it.codes()
    restart(it)
    it.pass_time(900 * MS)
    assert it.estimates[-1].values['ended'] is False


def test_a_move_from_a_learnt_level_leaves_no_more_than_open_loop_once_it_is_forgotten():
    left = {}
    for mode in ('off', 'adapt'):
        it = bench(False, factors={'shear_modulus': 0.85}, feedback=mode)
        moves(it, MOVES[:1])
        if mode == 'adapt':
            it.runtime.follower.reset()
        # A first point that repeats the setpoint is accepted as before.
        assert it.planner.draft_request(
            [(MOVES[0], 0), (MOVES[1], 400 * MS)], None, it.now) is not None
        left[mode] = moves(it, MOVES[1:2])[0]
    assert left['adapt'][0] < left['off'][0] + 0.5


@pytest.mark.parametrize('factors', [
    {'shear_modulus': 0.8, 'damping_coefficient': 2.0},
    pytest.param({'shear_modulus': 1.2}, marks=pytest.mark.slow)])
def test_modulus_and_damping_are_learnt_from_the_first_move(factors):
    it = bench(False, noise=1e-3, factors=factors)
    left = moves(it, MOVES[:2])
    assert abs(left[0, 1]) < 0.2
    assert np.max(np.abs(left[1])) < 0.2
    assert 'plans use it' in it.message


def test_setpoints_that_have_not_begun_are_planned_with_what_was_learnt(monkeypatch):
    # Twice the damping leaves nothing to correct in the setpoint under way.
    monkeypatch.setattr(corrections, '_may_gain', lambda *_: False)
    it = bench(False, factors={'damping_coefficient': 2.0})
    targets, hold = (1.4, 1.15, 1.35, 1.2), 400 * MS
    it.runtime.request(Trajectory(
        ('a',), [((x,), (i + 1) * hold) for i, x in enumerate(targets)], len(targets)))
    begin, truth = it.now, it.pass_time(len(targets) * hold)
    left = []
    for i, (target, before) in enumerate(zip(targets, (1.0, *targets), strict=False)):
        since = begin + i * hold + 50 * MS
        seen = truth[(truth[:, 0] > since + 10 * MS) & (truth[:, 0] < since + 25 * MS), 1]
        left.append(np.ptp(seen) / abs(target - before))
    assert left[0] > 0.05
    assert max(left[1:]) < 0.003
    assert 'corrected' in it.codes()


def test_a_fault_after_a_healthy_move_leaves_what_that_move_confirmed():
    it = bench(False, factors={'shear_modulus': 1.1})
    moves(it, MOVES[:2])
    it.sense = lambda time, x: [(time, x + 0.05)]
    assert np.max(np.abs(moves(it))) < 0.5
    assert 'G about +10 %, bias of the sensor about 0.05; plans do not use it' in it.message
    assert 'plans keep the parameters that samples confirmed last' in it.message


def drifting(rate):
    begun = []

    def sense(time, stretch):
        begun.append(time)
        return [(time, stretch + rate * (time - begun[0]) / 1e9)]
    return sense


CHANGES = {
    'scale 0.9': lambda: lambda time, x: [(time, 1.0 + 0.9 * (x - 1.0))],
    'scale 0.98': lambda: lambda time, x: [(time, 1.0 + 0.98 * (x - 1.0))],
    'offset 0.05': lambda: lambda time, x: [(time, x + 0.05)],
    'drift 1 % a second': lambda: drifting(1e-2), 'drift 3 % a second': lambda: drifting(3e-2)}


# A scale after nothing was learnt, a drift after something was; the others are alike.
@pytest.mark.parametrize(('change', 'modulus'), [
    ('scale 0.9', 1.0), ('drift 1 % a second', 1.1), *(
        pytest.param(*x, marks=pytest.mark.slow) for x in (
            ('scale 0.9', 1.1), ('scale 0.98', 1.0), ('scale 0.98', 1.1),
            ('drift 1 % a second', 1.0)))])
def test_a_sensor_that_changes_is_named_costs_nothing_and_is_forgotten(change, modulus):
    it = bench(False, noise=1e-3, factors={'shear_modulus': modulus})
    moves(it, (1.3, 1.15, 1.4))
    healthy, it.sense = it.sense, CHANGES[change]()
    first = len(it.estimates)
    assert np.max(np.abs(moves(it, (1.2, 1.35, 1.1)))) < 1.0
    named = 'the sensor has changed, according to the samples, or a constant force or the coil'
    assert any(named in x.message and x.severity is Severity.WARN for x in it.estimates[first:])
    it.sense = healthy
    assert np.max(np.abs(moves(it, (1.3, 1.15, 1.4, 1.2)))) < 0.5
    assert 'sensor has changed' not in it.message


def test_a_damping_that_jumps_is_learnt_and_does_not_end_feedback():
    it = bench(False, noise=3e-4, factors={'shear_modulus': 1.1})
    moves(it, (1.3, 1.15))
    it.plant.block = replace(
        it.plant.block, damping_coefficient=2.0 * it.plant.block.damping_coefficient)
    it.plant.solution = None
    # With the damping confirmed before, each of them would vibrate by 17 %.
    assert np.max(np.abs(moves(it, (1.35, 1.05, 1.35, 1.1)))[2:]) < 0.5
    assert 'feedback_ended' not in it.codes()


@pytest.mark.parametrize('seed', [3, *(pytest.param(x, marks=pytest.mark.slow) for x in (2, 4))])
def test_a_modulus_that_returns_to_the_given_one_while_samples_are_lost_is_planned_with(seed):
    it = bench(False, noise=1e-3, factors={'shear_modulus': 1.1}, seed=seed)
    moves(it, (1.3, 1.15))
    random = np.random.default_rng(seed)
    it.sense = lambda time, x: [(time, x)] if random.random() < 0.4 else []
    it.plant.block = replace(it.plant.block, shear_modulus=0.99 * paper(False)[0].shear_modulus)
    it.plant.solution = None
    # With the modulus confirmed before, the first of them rests 29 % of its step beyond.
    assert np.max(np.abs(moves(it, (1.26, 1.07, 1.25)))[:, 1]) < 3.0


def test_a_modulus_that_jumps_is_told_from_a_sensor_in_the_next_move():
    it = bench(False, noise=3e-3, factors={'shear_modulus': 1.1})
    moves(it, (1.3, 1.15, 1.4))
    it.plant.block = replace(it.plant.block, shear_modulus=1.16 * paper(False)[0].shear_modulus)
    it.plant.solution = None
    # With the modulus confirmed before, each of them would leave 5 %.
    assert np.max(np.abs(moves(it, (1.2, 1.35, 1.1, 1.3)))[2:]) < 0.5
    assert 'G about +16 %; plans use it' in it.message


@pytest.mark.parametrize('seed', [95003, pytest.param(95099, marks=pytest.mark.slow)])
def test_a_modulus_that_jumps_in_a_hold_is_found_and_the_hold_corrected_at_once(seed):
    # With the modulus confirmed before, the actuator rests 16 and 3 % of its step off.
    laboratory = drawn(seed, bench_harm.MOVES, changes=True)
    left = bench_harm.run(laboratory, 'adapt')
    assert max(x.size for x in left[laboratory.change.move:]) < 0.01


def test_a_force_that_jumps_in_a_hold_is_not_taken_for_a_modulus():
    # As a modulus, it would leave 2.1 % of the next step.
    laboratory = drawn(93176, bench_harm.MOVES, changes=True)
    left = bench_harm.run(laboratory, 'adapt')
    assert max(x.size for x in left[laboratory.change.move:]) < 0.01


def test_a_move_is_not_corrected_while_its_newest_samples_are_rejected():
    # A force jumps. The first samples look like a coil lag; corrected for that, 15 % were left.
    laboratory = drawn(93332, bench_harm.MOVES, changes=True)
    left = bench_harm.run(replace(laboratory, targets=laboratory.targets[:4]), 'adapt')
    assert left[-1].size < 0.08


def test_a_corrected_move_confirms_parameters():
    # The gain of the sensor changes after two corrected moves. With G as given, the next one would
    # leave 66 %.
    laboratory = drawn(93245, bench_harm.MOVES, changes=True)
    left = bench_harm.run(replace(laboratory, targets=laboratory.targets[:3]), 'adapt')
    assert left[-1].size < 0.01


def test_feedback_does_not_end_with_a_modulus_that_was_confirmed_but_has_changed():
    # With that, the second move leaves 15 %, and open loop then 23 % of the last one.
    laboratory = drawn(93083, bench_harm.MOVES, changes=True)
    left = bench_harm.run(replace(laboratory, targets=laboratory.targets[:4]), 'adapt')
    assert left[-1].size < 0.01


def test_a_bias_that_jumps_at_rest_before_the_first_move_is_not_taken_for_a_force():
    it = bench(False, noise=1e-3)
    it.sense = lambda time, x: [(time, x + 0.002)]
    assert np.max(np.abs(moves(it, (1.14, 1.29, 1.13, 1.39, 1.12)))) < 0.1


@pytest.mark.parametrize('modulus', [pytest.param(1.0, marks=pytest.mark.slow), 1.1])
def test_a_small_bias_that_jumps_and_stays_costs_nothing(modulus):
    it = bench(False, noise=1e-3, factors={'shear_modulus': modulus})
    moves(it, (1.3, 1.15, 1.4))
    it.sense = lambda time, x: [(time, x + 0.002)]
    assert np.max(np.abs(moves(it, (1.2, 1.35, 1.1, 1.3, 1.15, 1.4)))) < 0.5


def test_a_small_bias_that_jumps_does_not_return_as_that_of_an_unchanged_sensor():
    # A force that might hide it would excuse it; plans then err by 1.5 and 2.4 % of later steps.
    laboratory = drawn(93098, bench_harm.MOVES, changes=True)
    left = bench_harm.run(laboratory, 'adapt')
    assert all(x.warned for x in left[laboratory.change.move:])
    assert max(x.size for x in left[laboratory.change.move + 1:]) < 0.015


# The error that samples cannot avoid: they cannot tell a scale from another remanence, nor the
# drift of a sensor from creep.
@pytest.mark.parametrize(('change', 'most', 'after'), [
    pytest.param('scale 0.9', 12.0, 2.0, marks=pytest.mark.slow), ('scale 0.98', 2.5, 0.5),
    ('offset 0.05', 0.1, 0.1),
    pytest.param('drift 3 % a second', 12.0, 1.5, marks=pytest.mark.slow)])
def test_what_a_sensor_showed_that_failed_in_the_first_move_ends_with_it(change, most, after):
    it = bench(False, noise=1e-3)
    healthy, it.sense = it.sense, CHANGES[change]()
    assert np.max(np.abs(moves(it, (1.3, 1.15)))) < most
    it.sense = healthy
    left = np.abs(moves(it, (1.35, 1.2, 1.3)))
    assert np.max(left[:, 1]) < 0.05
    assert np.max(left) < after
    assert it.planner.model.actuator.remanence == pytest.approx(
        it.runtime.follower.joints['a'].given.actuator.remanence, rel=1e-3)


def test_what_a_sensor_showed_that_failed_first_ends_with_it_though_the_modulus_is_wrong():
    it = bench(False, noise=1e-3, factors={'shear_modulus': 1.1})
    healthy, it.sense = it.sense, CHANGES['scale 0.9']()
    moves(it, (1.3, 1.15))
    it.sense = healthy
    # With the remanence that it showed, they would rest up to 34 % of a step beyond.
    assert np.max(np.abs(moves(it, (1.2, 1.35, 1.1, 1.3)))[2:]) < 0.5
    assert 'G about +10 %; plans use it' in it.message


def test_what_a_weak_coil_showed_first_ends_with_it():
    it, part = bench(False, 3e-4, factors={'shear_modulus': 1.1}, report=False), [0.8]
    commanded(it, lambda stamp, level: (stamp, part[0] * level))
    moves(it, (1.22, 1.1))
    part[0] = 1.0
    # No sample can prevent that the first one vibrates.
    left = np.abs(moves(it, (1.3, 1.13, 1.26, 1.05)))
    assert np.max(left[1:, 1]) < 0.5
    assert np.max(left[2:]) < 0.5
    assert 'G about +10 %; plans use it' in it.message


def test_an_actuator_that_rang_is_planned_as_confirmed_once_another_bias_explains_samples():
    it = bench(False, 3e-4, factors={'shear_modulus': 1.1})
    moves(it, (1.33, 1.23))
    slow = low_pass(3e-3)
    it.sense = lambda time, x: [(time, y + 0.01) for _, y in slow(time, x)]
    moves(it, (1.14, 1.39, 1.06))
    it.sense = lambda time, x: [(time, x + 0.01)]
    # With the parameters given, they would leave 15 to 25 %.
    assert np.max(np.abs(moves(it, (1.37, 1.15, 1.38)))[1:]) < 0.5


def test_the_noise_of_a_sensor_that_repeated_a_value_is_not_kept():
    it = bench(False, noise=3e-4, factors={'shear_modulus': 1.1})
    moves(it, (1.3, 1.15))
    healthy, it.sense = it.sense, lambda time, x: [(time, min(x, 1.2))]
    moves(it, (1.35,))
    it.sense = healthy
    assert np.max(np.abs(moves(it, (1.25, 1.4)))) < 0.1
    # With the noise of the repeated value, no explanation of healthy samples would last.
    assert it.estimates[-1].values['new_beginnings'] <= 3


def test_a_saturated_amplifier_does_not_end_feedback():
    it = bench(False, noise=3e-4, factors={'shear_modulus': 1.1})
    moves(it, (1.37, 1.11))
    it.plant.limit = 0.07
    moves(it, (1.24,))
    assert 'feedback_ended' not in it.codes()


def commanded(it, change):
    """Have a device apply what is made of each timestamp and level in T."""
    command = it.plant.command
    it.plant.command = lambda stamp, level: command(*change(stamp, level))


def test_a_reversed_field_is_not_corrected_over_and_over():
    it = bench(False, noise=1e-3, factors={'shear_modulus': 1.1}, lead=2 * MS)
    moves(it, (1.22, 1.06))
    corrected = it.codes().count('corrected')
    commanded(it, lambda stamp, level: (stamp, -level))
    moves(it, (1.2,))
    assert it.codes().count('corrected') == corrected


def test_what_late_levels_leave_is_not_corrected_by_levels_as_late():
    it = bench(False, noise=3e-4, factors={'shear_modulus': 1.1}, lead=2 * MS)
    moves(it, (1.3, 1.15))
    corrected = it.codes().count('corrected')
    commanded(it, lambda stamp, level: (
        stamp + int(np.random.default_rng((4, stamp)).uniform(1, 5) * MS), level))
    moves(it, (1.35, 1.05, 1.35))
    # Until the first levels were late, nobody knows.
    assert it.codes().count('corrected') <= corrected + 3


def test_a_request_tries_again_what_saturated_an_amplifier():
    it = bench(False, plant={'limit': 0.06})
    it.move(1.4, 400 * MS)
    joint = it.runtime.follower.joints['a']
    assert joint.largest == pytest.approx(0.06)
    it.plant.limit = math.inf
    it.move(1.35, 100 * MS)
    assert joint.largest == math.inf


# -- time ----------------------------------------------------------------------------------------

def test_one_sample_from_the_future_does_not_count():
    it = bench(False, factors={'shear_modulus': 1.1})
    it.runtime.observed('a', sample(it.now + 3600 * 10 ** 9, 1.3, came=it.now))
    left = moves(it, MOVES[:3])
    assert np.max(np.abs(left[1:])) < 0.5
    assert it.estimates[-1].values['ahead_of_clock'] == 1
    assert 'G about +10 %; plans use it' in it.message


@pytest.mark.parametrize('ahead', [pytest.param(2e-3, marks=pytest.mark.slow), 0.3, 5.0])
def test_a_clock_that_is_ahead_is_named_and_leaves_no_vibration(ahead):
    it = bench(False)
    it.sense = lambda time, x: [(time + round(ahead * 1e9), x)]
    it.pass_time(100 * MS)
    assert np.max(np.abs(moves(it, MOVES[:3]))) < 0.5
    assert f'{ahead - 2e-3:.3g} s ahead of the clock of the planner' in it.message or ahead < 0.1
    assert 'open loop until samples fit again' in it.message
    if ahead > 0.1:
        assert it.estimates[-1].values['ahead_of_clock'] > 100


def test_timestamps_ahead_of_the_clock_do_not_show_that_a_confirmed_actuator_vibrates():
    it = bench(False, 1e-3, factors={'shear_modulus': 1.1})
    moves(it, (1.3, 1.15))
    it.sense = FAULTS['ahead']()
    # With the parameters given, they would leave up to 39 %.
    assert np.max(np.abs(moves(it, (1.3, 1.2, 1.3)))) < 0.5


@pytest.mark.parametrize('seed', [3, *(pytest.param(x, marks=pytest.mark.slow) for x in (0, 1))])
def test_samples_in_bursts_with_timestamps_of_their_arrival_do_no_harm(seed):
    left = {}
    for mode in ('off', 'adapt'):
        it, waiting = bench(
            False, 1e-3, factors={'shear_modulus': 1.1}, seed=seed, feedback=mode), []

        def bursts(time, stretch, waiting=waiting):
            waiting.append(stretch)
            if len(waiting) < 10:
                return []
            found = [(time + 20_000 * i, x) for i, x in enumerate(waiting)]
            waiting.clear()
            return found
        it.sense = bursts
        left[mode] = np.sum(np.abs(moves(it, (1.14, 1.3, 1.12))), axis=1)
    assert np.all(left['adapt'] < left['off'] + 0.5)


def test_samples_that_queue_with_timestamps_of_their_arrival_leave_what_was_confirmed():
    it, random, queue = bench(False, 1e-3, factors={'shear_modulus': 1.1}), (
        np.random.default_rng(0)), []
    moves(it, (1.3, 1.15))

    def sense(time, stretch):
        since = queue[-1][0] + 1 if queue else 0
        queue.append((max(time + int(random.exponential(3 * MS)), since), stretch))
        found = [x for x in queue if x[0] <= time]
        del queue[:len(found)]
        return found
    it.sense = sense
    # With all samples of each burst, the parameters given return: up to 23 %.
    assert np.max(np.abs(moves(it, (1.3, 1.2, 1.35)))) < 0.5


@pytest.mark.parametrize('seed', [0, *(
    pytest.param(x, marks=pytest.mark.slow) for x in (1, 2))])
def test_an_update_costs_no_more_whatever_timestamps_come(seed, monkeypatch):
    random, work = np.random.default_rng(seed), []
    it = bench(False, seed=seed)
    unit = it.planner.model.units.time

    def counted(values, free, state, levels, begin, times):
        work.append((
            (float(np.max(times)) - begin) / unit if len(times) else 0.0, len(times),
            len(levels.times)))
        return follow(values, free, state, levels, begin, times)

    for module in (estimator, window):
        monkeypatch.setattr(module, 'follow', counted)
    ends = (-2 ** 63, 2 ** 63 - 1, 0, -1, 2 ** 62)

    def sense(time, stretch):
        found = [(time, stretch)]
        kind = random.integers(8)
        if kind == 0:
            found.append((int(random.choice(ends)), stretch))
        elif kind == 1:
            found.append((time + int(random.integers(-10 ** 13, 10 ** 13)), stretch))
        elif kind == 2:
            found = [(time - i * MS // 7, stretch) for i in range(30)]
        elif kind == 3:
            found += found * 5
        return found

    it.sense = sense
    most = 0
    for i, target in enumerate((1.4, 1.1, 1.3, 1.2)):
        work.clear()
        it.move(target, 200 * MS)
        if i == 1:
            it.rest(3 * 3600 * 10 ** 9)
        span, count, levels = np.max(work, axis=0)
        assert span < 450.0
        assert count < 1500
        assert levels < 200
        most = max(most, len(work))
    # Six passes of four halvings at most for each of the updates, which come every 20 ms.
    assert most < 25 * (200 / 20 + 5) * 3


# -- the field -----------------------------------------------------------------------------------

def field_of(it, time):
    """Return the actual level."""
    return [x[1] for x in it.plant.levels if x[0] <= time][-1]


@pytest.mark.parametrize('shown', [True, False])
def test_a_saturated_amplifier_is_neither_learnt_from_nor_asked_for_more(shown):
    # Half of what holds 1.4 flows; only effort shows it.
    it = bench(False, plant={'limit': 0.06}, report=False)
    it.effort = lambda: field_of(it, it.now) if shown else math.nan
    wanted = it.planner.model.holding(1.4) * it.planner.model.units.load
    it.move(1.4, 400 * MS)
    asked = max(abs(x) for _, x in it.sent)
    if not shown:
        return
    assert asked <= 1.01 * wanted
    assert f'the coil has 60 mT where {1e3 * wanted:.3g} mT were commanded' in it.message
    assert it.planner.model.actuator.shear_modulus == 1e4


def test_samples_of_another_actuator_correct_nothing_if_its_field_differs():
    it = bench(False, lead=2 * MS, report=False)
    it.effort = lambda: 1.5 * field_of(it, it.now)
    it.sense = lambda time, x: [(time, 1.0 + 1.5 * (x - 1.0))]
    assert np.max(np.abs(moves(it, (1.15, 1.3)))) < 0.1
    assert 'corrected' not in it.codes()


@pytest.mark.parametrize('later', [4, -4])
def test_a_field_measured_before_or_after_the_stretch_is_no_fault_of_the_coil(later):
    # By a tenth of the time scale; samples arrive 2 ms after their timestamps.
    it = bench(factors={'shear_modulus': 0.8}, report=False)
    it.effort = lambda: field_of(it, it.now + (later - 2) * MS)
    left = np.abs(moves(it))
    values = it.estimates[-1].values
    assert values['new_beginnings'] == 0
    assert np.max(left[2:]) < 0.1
    assert float(values['field_mismatch_ms']) == pytest.approx(4 if later > 0 else 0, abs=3)


def test_nothing_is_learnt_while_the_field_is_not_reported_any_more():
    it = bench(False, report=False)
    off = []
    it.effort = lambda: math.nan if off else field_of(it, it.now)
    it.move(1.4, 300 * MS)
    off.append(True)
    it.plant.command(it.now, 0.0)
    it.plant.limit = 0.0
    it.move(1.1, 400 * MS)
    assert 'the field is no longer reported' in it.message
    assert it.planner.model.actuator.shear_modulus == pytest.approx(1e4, rel=2e-3)
