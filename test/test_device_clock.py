"""A device whose clock is set: its plan is dropped, and it is obeyed again once clocks agree."""

from dataclasses import replace
import random
import re

import pytest
from test_runtime_hosts import BEATING, Bench
from test_runtime_planner import HOLD, LEAD, MS, START, trajectory

from hmsa_ros.runtime.receipts import DeviceClock, Receipts
from hmsa_ros.runtime.records import Severity, Stop, StretchRequest

SECOND = 1000 * MS


class Apart(Bench):
    """A bench whose device carries out commands by its own clock, and switches its coil off."""

    TIMEOUT = SECOND

    def __init__(self, **options):
        super().__init__(**options)
        self._fed = None
        self.runtime.applied('a', START - 1, 0.0)
        self.levels = []  # levels that took effect: time of the planner's clock, and in T

    def deliver(self):
        if not self.linked:
            return
        arrived, self.wire = self.wire, []
        there = self.now + self.ahead
        for _, x in arrived:
            self._newest, self._came = x.stamp, there
            if self.cut:
                # Only the acknowledgement, which has the time of the cut-off, is obeyed.
                self.cut = (x.stamp, x.flux_density) != (self.cut_at, 0.0)
                self._fed = self.now
                if self.cut:
                    self.refused.append(x.flux_density)
                continue
            if there - x.stamp > 20 * MS or x.stamp - there > self.TIMEOUT:
                # It comes too late, or is for a time after the watchdog has tripped.
                continue
            self._fed = self.now
            self.plant.command(max(x.stamp - self.ahead, self.plant.time), x.flux_density)
        self.give_receipt()
        if self._fed is not None and self.now - self._fed > self.TIMEOUT and not self.cut:
            self.plant.command(self.plant.time, 0.0)
            self.cut, self.cut_at = True, there

    def advance(self):
        for stamp, level in self.plant.go_on(self.now):
            self.levels.append((self.now, level))
            self.runtime.applied('a', stamp + self.ahead, level)

    def set_device(self, by):
        """Set the clock of the device: what waits in it applies by the clock as it is now."""
        self.ahead += by
        waiting = self.plant.schedule.ahead()
        if waiting:
            # Commands at or after a time replace all later ones.
            self.plant.command(self.plant.time, self.plant.schedule.current)
        for stamp, level in waiting:
            self.plant.command(max(stamp - by, self.plant.time), level)

    def settle(self):
        self.run(self.now + 3 * SECOND)


@pytest.mark.parametrize(('when', 'by'), [
    *((130, sign * x * MS) for x in (100, 500, 1000, 3_600_000) for sign in (1, -1)),
    *(pytest.param(130, sign * x * MS, marks=pytest.mark.slow)
      for x in (5000, 60_000) for sign in (1, -1)),
    (20, -5000 * MS), (20, 100 * MS), (2000, 5000 * MS), (2000, -5000 * MS)])
def test_a_device_whose_clock_is_set_halts_the_plan_and_is_found_again(when, by):
    rig = Apart()
    rig.runtime.request(trajectory(
        (1.2, HOLD), (1.1, 6 * HOLD), (1.3, 8 * HOLD), (1.4, 10 * HOLD), (1.2, 4 * SECOND)))
    rig.run(START + when * MS)
    rig.set_device(by)
    static = by > LEAD or by < -SECOND / 2
    rig.run(rig.now + SECOND)
    assert (rig.status.verdict.code, rig.status.verdict.severity) == (
        'clocks_differ', Severity.ERROR)
    assert 'the clock of the plant or driver' in rig.status.verdict.message
    changes = len(rig.levels)
    sent = len(rig.sent)
    rig.settle()
    # What the watchdog does is all that happens.
    assert all(level == 0.0 for _, level in rig.levels[changes:])
    assert not any(x.flux_density for _, x in rig.sent[sent:])
    again = rig.runtime.request(StretchRequest('a', 1.3))
    assert (again.code == 'clocks_differ') is static
    if static:
        found = re.search(
            r'driver is ([0-9.]+) s (ahead of|behind) .*to ([0-9.]+) s', again.message)
        assert abs(float(found[1]) - abs(by) / SECOND) < float(found[3]) + 1e-3
        assert (found[2] == 'behind') is (by < 0)
        assert rig.runtime.request(Stop()).code == 'clocks_differ'
    rig.settle()
    rig.set_device(-by)
    rig.run(rig.now + 1200 * MS)
    rig.go(StretchRequest('a', 1.25), rig.now + LEAD + HOLD)
    assert rig.status.verdict.severity is Severity.OK
    assert rig.residual(1.25) < 1e-6


@pytest.mark.parametrize('by', [5000, -5000, 3_600_000])
def test_without_samples_a_start_after_clocks_agree_again_knows_that_the_coil_was_off(by):
    rig = Apart()
    rig.samples = rig.observable = False
    rig.go(trajectory((1.2, HOLD), (1.3, 8 * HOLD)), START + 130 * MS)
    rig.set_device(by * MS)
    rig.settle()
    assert rig.cut
    rig.set_device(-by * MS)
    rig.run(rig.now + SECOND)
    rig.arrive(1.25, rig.now + LEAD + HOLD)


def test_a_small_delay_of_a_device_at_rest_stops_nothing():
    rig = Apart()
    rig.go(trajectory((1.2, HOLD), (1.3, 4 * SECOND)), START + SECOND)
    rig.set_device(-300 * MS)
    rig.run(rig.now + 2 * SECOND)
    assert rig.status.verdict.severity is Severity.OK
    rig.arrive(1.1, rig.now + SECOND)


@pytest.mark.parametrize(('back', 'outage'), [
    (500, 1500), (1000, 1500), (2500, 10_000), (5000, 1500)])
def test_receipts_are_accepted_after_an_outage_in_which_the_clock_was_set_back(back, outage):
    rig = Apart()
    rig.go(StretchRequest('a', 1.2), START + SECOND)
    rig.linked = False
    rig.run(rig.now + outage * MS // 2)
    rig.set_device(-back * MS)
    rig.run(rig.now + outage * MS // 2)
    rig.linked = True
    rig.run(rig.now + 650 * MS)
    assert 'no receipt' not in rig.status.unheard
    rig.set_device(back * MS)
    rig.run(rig.now + 1200 * MS)
    rig.go(StretchRequest('a', 1.3), rig.now + SECOND)
    assert rig.status.verdict.severity is Severity.OK
    assert rig.residual(1.3) < 1e-6


def test_receipts_that_were_held_up_by_an_outage_do_not_end_the_silence():
    time = 0
    receipts = Receipts(lambda: time)

    def pass_time(span):
        nonlocal time
        for _ in range(0, span, 50):
            time += 50 * MS
            receipts.look()
        return receipts.silent

    receipts.received('a', time, 0, time, comparable=True)
    assert pass_time(5000) == {'a'}
    for sent in range(200, 1400, 200):
        receipts.received('a', sent * MS, 0, time, comparable=True)
    assert pass_time(100) == {'a'}
    receipts.received('a', time, 0, time, comparable=True)
    assert pass_time(100) == set()


def test_a_planner_that_stood_still_knows_that_commands_did_not_arrive_before():
    time = 0
    receipts = Receipts(lambda: time)
    receipts.received('a', time, 0, time, comparable=True)
    receipts.sent('a', 50 * MS, time)
    for stall in (0, 700, 0, 0, 500, 0, 0, 0, 0):
        time += 100 * MS + stall * MS
        receipts.look()
        # That it has received nothing.
        receipts.received('a', time, 0, time, comparable=True)
        assert not receipts.lost('a')
    for _ in range(3):
        time += 100 * MS
        receipts.look()
        receipts.received('a', time, 0, time, comparable=True)
    assert receipts.lost('a')


def test_a_level_that_was_dropped_after_its_acknowledgement_is_not_carried_out():
    time = 0
    receipts = Receipts(lambda: time)
    receipts.received('a', time, 0, time, comparable=True)
    receipts.sent('a', 50 * MS, time, level=True)
    assert receipts.owed('a')
    time = 60 * MS
    receipts.received('a', time, 50 * MS, time, comparable=True)
    assert (receipts.owed('a'), receipts.carried_out('a', 50 * MS)) == (False, True)
    receipts.received('a', time, 50 * MS, time, comparable=True, late=True)
    assert (receipts.owed('a'), receipts.carried_out('a', 50 * MS)) == (True, False)
    receipts.sent('a', 100 * MS, time)
    receipts.received('a', time, 100 * MS, time, comparable=True)
    assert not receipts.owed('a')


@pytest.mark.parametrize('seed', range(5))
def test_delays_are_never_taken_for_a_clock_that_was_set(seed):
    chance, clock = random.Random(seed), DeviceClock()
    now = 0
    for _ in range(2000):
        now += chance.randrange(1, 200 * MS)
        clock.sent(now, now)
        there, back = (round(chance.expovariate(1 / 50) * MS) for _ in range(2))
        arrived = now + there + back
        assert clock.received(now + there - 3 * SECOND, now, arrived, arrived) == 0
        assert clock.offset.least <= -3 * SECOND <= clock.offset.most
        now = arrived


@pytest.mark.parametrize('by', [-5 * SECOND, 3600 * SECOND])
def test_a_clock_of_both_that_is_set_is_no_difference(by):
    clock, now, steady = DeviceClock(), 0, 0

    def exchange():
        nonlocal now, steady
        clock.sent(now, now)
        now, steady = now + 20 * MS, steady + 20 * MS
        return clock.received(now - 19 * MS, now - 20 * MS, now, steady)

    assert not any(exchange() for _ in range(10))
    before = now
    now += by
    clock.set(steady)
    # Receipts of before are still in transit.
    assert not any(clock.received(before, None, now, steady + x * MS) for x in (0, 20, 40))
    assert not any(exchange() for _ in range(10))


def test_a_clock_of_the_planner_alone_that_is_set_halts_the_plan():
    rig = Apart()
    rig.go(trajectory((1.2, HOLD), (1.1, 6 * HOLD), (1.3, 8 * HOLD)), START + 130 * MS)
    # Seen by the planner, its clock was set ahead.
    rig.runtime.devices.receipts.clock_set()
    rig.set_device(-5 * SECOND)
    rig.run(rig.now + SECOND)
    assert rig.status.verdict.code == 'clocks_differ'


SLOW = ((1.2, HOLD), (1.1, 6 * HOLD), (1.3, 8 * HOLD), (1.4, 10 * HOLD), (1.2, 4 * SECOND))


@pytest.mark.parametrize('outage', [320, 416, 700])
def test_lateness_from_an_outage_is_no_reason_to_raise_lead_time(outage):
    rig = Bench()
    rig.go(trajectory(*SLOW), START + 100 * MS)
    rig.linked = False
    rig.run(rig.now + outage * MS)
    rig.linked = True
    rig.run(rig.now + 2 * SECOND)
    _, message, values = rig.runtime.report()
    assert values['late'] > 0
    said = [x for x in (*rig.notes(), message) if 'late' in x]
    assert any('receipt of joint a arrived for' in x for x in said)
    assert not any('raise lead_time' in x for x in said)


def test_lateness_from_a_stall_of_the_planner_is_no_reason_to_raise_lead_time():
    rig = Bench(settings=replace(BEATING, replan_late=False))
    rig.go(trajectory(*SLOW), START + 100 * MS)
    rig.now += 500 * MS
    rig.steady += 500 * MS
    rig.run(rig.now + 2 * SECOND)
    message = rig.runtime.report()[1]
    assert 'the planner stood still for 0.5' in message
    assert 'raise lead_time' not in message


def test_a_planner_that_was_starting_has_not_stood_still():
    time = 0
    receipts = Receipts(lambda: time)
    for said in ([], ['the planner stood still for 0.500 s']):
        # Before the first look, as where a driver in the same process starts.
        time += 500 * MS
        receipts.look()
        assert [x.words for x in receipts.take_disturbances()] == said


def test_lateness_from_a_clock_is_no_reason_to_raise_lead_time():
    rig = Bench()
    rig.go(trajectory(*SLOW), START + 100 * MS)
    rig.ahead = 41_500 * MS
    # What it applies has the timestamps of its clock.
    rig.runtime.applied('a', rig.now + rig.ahead, 0.03)
    rig.run(rig.now + 2 * SECOND)
    assert not any('raise lead_time' in x for x in (*rig.notes(), rig.runtime.report()[1]))


def test_lateness_of_a_slow_link_is_a_reason_to_raise_lead_time_after_an_outage_too():
    rig = Bench()
    rig.transport = 60 * MS
    rig.go(trajectory(*SLOW), START + 100 * MS)
    rig.linked = False
    rig.run(rig.now + 400 * MS)
    rig.linked = True
    rig.run(rig.now + 2 * SECOND)
    rig.go(trajectory(*SLOW), rig.now + SECOND)
    needed = re.search(r'raise lead_time to more than ([0-9.]+) s', rig.runtime.report()[1])
    assert 0.05 < float(needed[1]) < 0.075


def test_the_level_of_a_coil_is_known_after_the_clock_of_the_planner_was_set():
    rig = Bench()
    rig.go(StretchRequest('a', 1.2), START + SECOND)
    rig.cut_off()
    rig.come_back()
    rig.hears = False
    rig.run(rig.now + 300 * MS)
    # Without its level, the cut-off would not be acknowledged.
    rig.runtime.clock_set(MS)
    rig.run(rig.now + 300 * MS)
    rig.hears = True
    rig.go(StretchRequest('a', 1.3), rig.now + SECOND)
    assert rig.refused == []
    assert rig.residual(1.3) < 1e-6
