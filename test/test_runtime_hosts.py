"""A planner and a device on another host, without ROS: silence, cut-offs, clocks, lost states."""

from dataclasses import replace
import math

from at_work import sample
import pytest
from test_runtime_planner import (
    HOLD,
    LEAD,
    MS,
    PATIENT,
    QUIET,
    Rig,
    SEQUENCE,
    SLENDER,
    START,
    trajectory,
)

from hmsa_ros.runtime.records import ObservedSample, Severity, Stop, StretchRequest

BEATING = replace(QUIET, heartbeat_period=200 * MS)
WAITING = replace(BEATING, takeover_timeout=500 * MS)


class Bench(Rig):
    """A rig whose device sends receipts, has its own clock, and may be cut off."""

    def __init__(self, *, settings=BEATING, **options):
        super().__init__(settings=settings, **options)
        self.runtime.environment.glance = self.glance
        self.ahead = 0  # lead of the device's clock
        self.linked = True
        self.cut = False
        self.refused = []
        self.lost = False  # whether samples show rest without a field
        self.samples = True
        self.rates = True  # whether samples contain a rate
        self.hears = True  # whether commands arrive while the link works
        self.mute = False  # whether receipts are lost
        self.cut_at = START + 1  # time that names the cut-off
        self.limit = math.inf  # lateness above which a command is rejected
        self._newest = 0
        self._late = False
        self._came = 0  # time of the device at which a command arrived
        self._next = START

    def glance(self):
        if self.samples:
            stretch = 1.0 if self.lost else self.plant.stretch
            yield 'a', ObservedSample(
                self.now + self.ahead, stretch,
                math.nan if not self.rates else 0.0 if self.lost else self.plant.rate,
                self.plant.flux_density, -self.ahead)

    def deliver(self):
        if not self.linked:
            return
        if not self.hears:
            self.wire = []
        for _, x in self.wire:
            self._newest, self._came = x.stamp, self.now + self.ahead
            self._late = self._came - x.stamp > self.limit
        self.wire = [x for x in self.wire if self.now + self.ahead - x[1].stamp <= self.limit]
        if self.cut:
            while self.wire and self.cut:
                _, x = self.wire.pop(0)
                self.cut = (x.stamp, x.flux_density) != (self.cut_at, 0.0)
                if self.cut:
                    self.refused.append(x.flux_density)
        super().deliver()
        self.give_receipt()

    def give_receipt(self):
        """Acknowledge commands soon, and give a sign of life now and then."""
        if self.mute:
            return
        if self.now >= self._next or self._came and self.now >= self._next - 80 * MS:
            self._next = self.now + 100 * MS
            self.runtime.received(
                'a', self._came or self.now + self.ahead,
                self.cut_at if self.cut else self._newest, cut_off=self.cut, late=self._late)
            self._came = 0

    def cut_off(self):
        """Disconnect the device, whose watchdog switches the coil off."""
        self.linked, self.cut = False, True
        self.plant.command(self.now, 0.0)
        self.plant.advance(self.now)

    def come_back(self):
        """Reconnect, and deliver the device's reports on its coil."""
        self.linked, self.wire = True, []
        self.runtime.applied('a', self.plant.time - 1, 0.0)

    def run(self, end, step=2 * MS):
        while self.now < end:
            self.steady += step
            super().run(min(self.now + step, end), step)

    def advance(self):
        if self.linked:
            super().advance()
        else:
            for plant in self.plants.values():
                plant.advance(self.now)


def test_a_device_that_is_not_heard_any_more_is_sent_nothing_and_named():
    rig = Bench()
    rig.go(trajectory((1.2, HOLD)), START + 400 * MS)
    assert (rig.status.unheard, rig.runtime.report()[0]) == ('', Severity.OK)
    rig.linked = False
    rig.run(START + 1500 * MS)
    assert 'no receipt of joint a from the plant or driver' in rig.status.unheard
    assert rig.runtime.report()[0] is Severity.ERROR
    sent = len(rig.sent)
    rig.run(START + 4000 * MS)
    assert len(rig.sent) == sent
    rig.linked = True
    rig.run(START + 5000 * MS)
    assert (rig.status.unheard, rig.runtime.report()[0]) == ('', Severity.OK)
    assert len(rig.sent) > sent
    assert rig.residual(1.2) < 1e-6
    rig.runtime.request(StretchRequest('a', 1.3))
    rig.linked = False
    rig.run(START + 6000 * MS)
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    rig.run(START + 17_000 * MS)
    assert rig.status.verdict.code == 'unheard'
    assert 'for 10 s, and no receipts either: start the plant' in rig.status.verdict.message


def test_a_device_that_comes_late_is_not_put_on_a_level_in_one_step():
    rig = Rig(settings=BEATING)
    rig.runtime.environment.glance = lambda: [('a', ObservedSample(
        rig.now, rig.plant.stretch, rig.plant.rate, rig.plant.flux_density, 0))]
    rig.found = False
    rig.go(trajectory((1.1, HOLD)), START + 1000 * MS)
    # What was sent so far has reached nobody.
    rig.plants, rig.wire = {'a': type(rig.plant)(rig.blocks['a'], time=rig.now)}, []
    rig.found = True
    rig.run(rig.now + 1000 * MS)
    assert rig.codes()[-1] == 'missed'
    assert rig.plant.stretch == 1.0
    rig.go(trajectory((1.1, HOLD)), rig.now + LEAD + HOLD)
    assert rig.residual(1.1) < 1e-6
    rig.run(rig.now + 1000 * MS)
    assert rig.residual(1.1) < 1e-6


@pytest.mark.parametrize('outage', [10, 1500])
@pytest.mark.parametrize('begin', [300, 1500])
@pytest.mark.parametrize('reports', [False, True])
def test_a_device_that_begins_anew_is_not_put_on_a_level_in_one_step(outage, begin, reports):
    rig = Bench()
    rig.go(trajectory((1.2, 400 * MS), (1.4, 60_000 * MS)), START + begin * MS)
    rig.linked = False
    rig.run(rig.now + outage * MS)
    # Its process is another one, which the graph of nodes does not show.
    rig.plants = {'a': type(rig.plant)(rig.blocks['a'], time=rig.now)}
    rig.wire, rig._newest = [], 0
    rig.linked, rig._next = True, rig.now
    if reports:
        rig.runtime.applied('a', rig.plant.time - 1, 0.0)
    rig.run(rig.now + 1000 * MS)
    assert (rig.status.verdict.code, rig.status.verdict.severity) == ('missed', Severity.ERROR)
    assert (rig.plant.stretch, rig.status.unheard) == (1.0, '')
    rig.go(trajectory((1.1, HOLD)), rig.now + 1000 * MS)
    assert rig.residual(1.1) < 1e-6


def test_a_device_in_slow_motion_is_heard_again_after_a_silence():
    rig = Bench()
    rig.runtime.environment.one_clock = lambda: True
    rig.runtime.request(trajectory((1.2, HOLD)))

    def pass_slowly(seconds):
        for _ in range(round(seconds / 0.1)):
            rig.steady += 100 * MS
            rig.now += MS
            rig.tick()
            if rig.linked:
                newest = rig.sent[-1][1].stamp if rig.sent else 0
                rig.runtime.received('a', rig.now, newest, cut_off=False)

    pass_slowly(1.0)
    rig.linked = False
    pass_slowly(2.0)
    assert 'no receipt of joint a' in rig.status.unheard
    rig.linked = True
    pass_slowly(0.5)
    assert rig.status.unheard == ''


@pytest.mark.parametrize('sampled', [False, True])
def test_a_level_whose_report_is_late_is_not_taken_back_by_a_heartbeat(sampled):
    rig = Bench()
    rig.go(StretchRequest('a', 1.2), START + 1000 * MS)
    # As of a plant that has stood still: its receipts come at once, its samples when they are due.
    seen = rig.now if sampled else None
    with rig.unreported() as reports:
        rig.runtime.request(StretchRequest('a', 1.4))
        first = len(rig.sent)
        planned = {x.flux_density for x in rig.planner.plan.levels}
        for _ in range(150 if sampled else 70):
            rig.run(rig.now + 4 * MS)
            if seen is not None:
                seen += MS
                rig.runtime.looks_at(seen)
        assert len(reports) == 2
    rig.run(rig.now + 1000 * MS)
    assert {x.flux_density for _, x in rig.sent[first:]} <= planned
    assert rig.residual(1.4) < 1e-9


@pytest.mark.parametrize('begins', [(0, 140), pytest.param((70,), marks=pytest.mark.slow)])
@pytest.mark.parametrize('how', ['lost', 'late', 'deaf'])
def test_a_level_that_was_lost_is_not_repeated_by_a_heartbeat(how, begins):
    highest = 0.0
    for begin in begins:
        for outage in (20, 60, 140, 460, 580, 1200):
            rig = Bench()
            rig.limit = 100 * MS
            rig.go(StretchRequest('a', 1.2), START + (1000 + begin) * MS)
            rig.linked, rig.hears = how == 'deaf', how != 'deaf'
            rig.go(StretchRequest('a', 1.4), rig.now + outage * MS)
            rig.linked = rig.hears = True
            if how == 'late':
                # With the first in time, the move would be as planned.
                rig.wire = [x for x in rig.wire if rig.now - x[1].stamp > rig.limit]
            else:
                rig.wire = []
            for _ in range(150):
                rig.run(rig.now + 8 * MS, 4 * MS)
                highest = max(highest, rig.plant.stretch)
            assert rig.residual(1.4) < 1e-6
    # In one step it would swing to 1.54.
    assert highest < 1.401


def test_a_device_without_receipts_is_sent_everything():
    rig = Rig(settings=BEATING)
    rig.runtime.request(trajectory((1.2, HOLD)))
    rig.steady += 10_000 * MS
    rig.run(START + 3000 * MS)
    assert rig.status.unheard == ''
    assert len(rig.sent) > 12


def test_commands_that_do_not_arrive_at_a_device_that_is_heard_are_named():
    rig = Bench()
    rig.go(trajectory((1.2, HOLD)), START + 400 * MS)
    while rig.now < START + 1500 * MS:
        rig.wire = []
        rig.run(rig.now + 10 * MS)
        rig.sent.clear()
    rig.hold_back = True
    newest = rig._newest
    while rig.now < START + 3000 * MS:
        rig.wire = []
        rig._newest = newest
        rig.run(rig.now + 2 * MS)
    assert 'commands of joint a do not arrive' in rig.status.unheard


@pytest.mark.parametrize('outage', [2000, 30_000])
def test_after_a_cut_off_the_planner_waits_and_then_starts_from_where_the_actuator_is(outage):
    rig = Bench()
    rig.go(trajectory((1.2, 400 * MS), (1.4, 60_000 * MS), (1.3, 90_000 * MS)), START + 1500 * MS)
    assert rig.residual(1.4) < 1e-6
    rig.cut_off()
    rig.run(rig.now + outage * MS)
    rig.come_back()
    rig.run(rig.now + 1000 * MS)
    assert (rig.status.verdict.code, rig.status.verdict.severity) == ('cut_off', Severity.ERROR)
    assert rig.status.progress.state == 'idle'
    assert rig.refused == []
    assert not rig.cut
    # It waits to be asked, and gives signs of life with the level in force.
    assert {x.flux_density for t, x in rig.sent if t > rig.now - 800 * MS} == {0.0}
    assert rig.residual(1.0) < 1e-6
    assert rig.runtime.request(StretchRequest('a', 1.4)).code == 'accepted'
    rig.run(rig.now + 500 * MS)
    assert rig.residual(1.4) < 1e-6


@pytest.mark.parametrize('reaction', ['wait', 'resume'])
def test_a_planner_that_stood_still_sends_nothing_until_it_knows_of_the_coil(reaction):
    rig = Bench(settings=replace(BEATING, after_cut_off=reaction, takeover_timeout=500 * MS))
    rig.go(trajectory(*((1.2 + 0.1 * (i % 2), 400 * i * MS) for i in range(1, 20))),
           START + 600 * MS)
    rig.runtime.serve_by(rig.steady)
    rig.cut_off()
    sent = len(rig.sent)
    rig.now, rig.steady = rig.now + 1700 * MS, rig.steady + 1700 * MS
    # Nothing arrives yet, not even what was sent during the stall.
    rig.run(rig.now + 3000 * MS)
    assert [x.flux_density for _, x in rig.sent[sent:]] == []
    rig.come_back()
    rig.run(rig.now + 1000 * MS)
    assert rig.sent[sent][1].flux_density == 0.0
    assert ('cut_off' in rig.codes()) == (reaction == 'wait')
    assert any(x.flux_density for _, x in rig.sent[sent:]) == (reaction == 'resume')


def test_a_planner_that_is_asked_for_nothing_leaves_a_device_cut_off():
    rig = Bench(settings=WAITING)
    rig.cut_off()
    rig.come_back()
    # Its watchdog would have been silenced for a moment only, again and again.
    rig.run(START + 3000 * MS)
    assert (rig.cut, rig.sent) == (True, [])
    rig.go(StretchRequest('a', 1.2), START + 4000 * MS)
    assert rig.refused == []
    assert rig.residual(1.2) < 1e-6


def test_a_request_before_the_first_receipt_of_a_device_that_was_cut_off_is_carried_out():
    rig = Bench(settings=WAITING)
    rig.runtime.environment.reports = lambda joint: True
    rig.cut_off()
    rig.come_back()
    rig._next = START + 150 * MS
    rig.go(StretchRequest('a', 1.2), START + 1000 * MS)
    assert rig.refused == []
    assert 'cut_off' not in rig.codes()
    assert rig.residual(1.2) < 1e-6


def test_a_cut_off_that_is_never_over_refuses_the_request():
    rig = Bench(settings=WAITING)
    rig.cut_off()
    rig.linked = True
    # The coil is never reported off.
    rig.runtime.applied('a', rig.plant.time - 1, 0.01)
    rig.run(START + 500 * MS)
    rig.go(StretchRequest('a', 1.2), START + 11_000 * MS)
    assert (rig.status.verdict.code, rig.refused) == ('cut_off', [])
    assert 'has not acknowledged 0 T for 10 s' in rig.status.verdict.message


@pytest.mark.parametrize('deaf', [3000, 15_000])
def test_after_a_cut_off_a_request_waits_until_the_device_hears(deaf):
    rig = Bench()
    rig.go(trajectory((1.2, 400 * MS), (1.4, 60_000 * MS)), START + 1500 * MS)
    rig.cut_off()
    rig.run(rig.now + 2000 * MS)
    # What the device reports arrives again, and commands do not yet.
    rig.hears = False
    rig.come_back()
    rig.run(rig.now + 500 * MS)
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'waiting'
    rig.run(rig.now + deaf * MS)
    assert rig.status.verdict.code == ('cut_off' if deaf < 10_000 else 'unheard')
    rig.hears = True
    rig.run(rig.now + 1000 * MS)
    if deaf > 10_000:
        assert 'commands of joint a have not arrived for 10 s' in rig.status.verdict.message
        assert rig.residual(1.0) < 1e-6
        rig.arrive(1.3, rig.now + 1000 * MS)
    assert rig.refused == []


def test_a_device_that_dds_has_lost_and_found_is_not_a_new_one():
    rig = Bench()
    rig.runtime.environment.reporters = lambda joint: frozenset({b'one'} if rig.found else ())
    rig.go(trajectory((1.2, 400 * MS), (1.4, 60_000 * MS)), START + 1500 * MS)
    rig.cut_off()
    rig.runtime.applied('a', rig.plant.time - 1, 0.0)
    rig.found = False
    rig.run(rig.now + 25_000 * MS)
    # What it has reported is not reported again.
    rig.linked, rig.wire, rig.found = True, [], True
    rig.run(rig.now + 1000 * MS)
    assert rig.status.verdict.code == 'cut_off'
    assert not rig.noted('started after the commands were sent')
    assert (rig.cut, rig.refused, rig.status.unheard) == (False, [], '')
    assert {x.flux_density for t, x in rig.sent if t > rig.now - 800 * MS} == {0.0}
    rig.arrive(1.3, rig.now + 1000 * MS)


def test_after_a_cut_off_the_planner_may_go_on_by_itself_with_a_shaped_move():
    rig = Bench(settings=replace(BEATING, after_cut_off='resume', takeover_timeout=500 * MS))
    rig.go(trajectory((1.2, 400 * MS), (1.4, 10_000 * MS)), START + 1500 * MS)
    rig.cut_off()
    rig.run(rig.now + 2000 * MS)
    rig.come_back()
    rig.run(rig.now + 1000 * MS)
    assert rig.status.verdict.code == 'replanned'
    assert rig.residual(1.4) < 1e-6


@pytest.mark.parametrize('rates', [True, False])
def test_a_move_does_not_start_from_a_state_that_samples_contradict(rates):
    rig = Bench(settings=WAITING)
    rig.rates = rates
    rig.go(StretchRequest('a', 1.2), START + 800 * MS)
    # The board has begun anew with its coil off, and nobody has noticed.
    rig.plant.set_state(1.0, 0.0, 0.0)
    rig.go(StretchRequest('a', 1.05), START + 1600 * MS)
    assert rig.noted('is at 1 on joint_states, where 1.2 was predicted')
    assert rig.residual(1.05) < 1e-6
    assert max(x.flux_density for t, x in rig.sent if t > START + 800 * MS) < 0.06


def test_a_planner_starts_from_rest_that_samples_without_a_rate_show():
    rig = Bench(settings=WAITING)
    rig.rates = False
    model = rig.planner.model
    level = model.flux_density(model.holding(1.3))
    rig.plant.set_state(1.3, 0.0, level, level)
    rig.arrive(1.15, START + 200 * MS + LEAD + HOLD)
    assert rig.notes() == []


def test_samples_that_have_waited_to_be_read_do_not_hide_rest():
    rig = Bench(settings=WAITING)
    rig.go(StretchRequest('a', 1.2), START + 5000 * MS)
    rig.rates = False
    rig.plant.set_state(1.0, 0.0, 0.0)
    asked = rig.now
    rig.runtime.request(StretchRequest('a', 1.05))
    for k in range(125):
        old = asked - 4000 * MS + k * MS
        rig.runtime.observed('a', sample(old, 1.2, flux_density=rig.plant.flux_density))
        rig.run(rig.now + 2 * MS)
    rig.run(rig.now + 500 * MS)
    assert not rig.noted('do not show rest')
    assert rig.residual(1.05) < 1e-6


def test_a_start_that_samples_without_a_rate_do_not_show_is_named():
    rig = Bench(settings=WAITING, blocks={'a': SLENDER})
    rig.rates = False
    rig.plant.set_state(1.1, 0.0, 0.0)
    rig.go(StretchRequest('a', 1.15), START + 400 * MS)
    assert rig.sent == []
    rig.run(START + 700 * MS)
    assert rig.status.verdict.code == 'accepted'
    assert rig.noted('contain no rate, and do not show rest: it is assumed at rest')
    # Later it rests elsewhere, then moves.
    rig.run(START + 800 * MS)
    rig.plant.set_state(1.3, 0.0, rig.plant.flux_density)
    rig.go(StretchRequest('a', 1.2), rig.now + 700 * MS)
    assert rig.noted('do not show rest: planning continues from the prediction')


def test_a_model_that_cannot_be_followed_is_no_longer_in_the_way_once_it_is_replaced():
    rig = Bench(settings=WAITING)
    rig.go(StretchRequest('a', 1.2), START + 800 * MS)
    model = rig.planner.model
    stiff = replace(model, actuator=replace(model.actuator, damping_coefficient=1e12))
    rig.runtime.change(rig.runtime.settings, {'a': stiff}, simultaneous=False)
    rig.go(Stop(), START + 1600 * MS)
    rig.runtime.change(rig.runtime.settings, {'a': model}, simultaneous=False)
    rig.go(StretchRequest('a', 1.3), START + 2600 * MS)
    assert rig.noted('on joint_states, where nothing was predicted: ')
    assert rig.residual(1.3) < 1e-6


@pytest.mark.parametrize('level', [-1e12, 1e300, 1.7e308])
def test_a_report_or_a_sample_that_cannot_be_is_ignored(level):
    rig = Rig(settings=replace(QUIET, takeover_timeout=500 * MS))
    rig.runtime.request(StretchRequest('a', 1.2))
    for _ in range(50):
        rig.runtime.observed('a', sample(rig.now, 1.1, 1.0, level))
        rig.steady += 20 * MS
        rig.run(rig.now + 20 * MS)
    rig.runtime.applied('a', rig.now - MS, level)
    rig.run(rig.now + 1000 * MS)
    assert rig.noted('T took effect is ignored') == 1
    assert rig.noted('sample of joint a ignored')
    rig.arrive(1.1, rig.now + 1000 * MS)


def test_a_wrong_model_is_no_contradiction():
    rig = Bench()
    rig.go(StretchRequest('a', 1.4), START + 500 * MS)
    rig.plant.set_state(1.33, 0.0, rig.plant.flux_density)
    assert rig.runtime.request(StretchRequest('a', 1.3)).code == 'accepted'
    assert not rig.noted('on joint_states')


def test_a_move_does_not_start_where_samples_have_ceased():
    rig = Bench(settings=WAITING)
    rig.go(StretchRequest('a', 1.2), START + 500 * MS)
    rig.go(StretchRequest('a', 1.3), START + 1000 * MS)
    rig.samples = False
    rig.run(START + 8000 * MS)
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'waiting'
    rig.run(START + 9000 * MS)
    assert (rig.status.verdict.code, rig.status.verdict.severity) == ('unseen', Severity.ERROR)
    assert rig.runtime.request(Stop()).severity is Severity.OK
    # Whoever has no sensor any more is not refused.
    rig.observable = False
    assert rig.runtime.request(StretchRequest('a', 1.1)).code == 'accepted'


def test_a_request_is_taken_while_simulated_time_stands_still():
    rig = Bench(settings=WAITING)
    rig.runtime.environment.one_clock = lambda: True
    rig.go(StretchRequest('a', 1.2), START + 1000 * MS)
    rig.runtime.request(StretchRequest('a', 1.3))
    # No more samples come.
    rig.samples = False
    rig.run(START + 1300 * MS)
    rig.steady += 10_000 * MS
    assert rig.runtime.request(StretchRequest('a', 1.2)).code == 'accepted'


def test_samples_that_cease_are_named_when_they_do_and_when_they_come_again():
    rig = Bench()
    rig.go(StretchRequest('a', 1.2), START + 3000 * MS)
    assert rig.status.unseen == ''
    rig.samples = False
    rig.run(START + 4900 * MS)
    assert rig.status.unseen == ''
    rig.run(START + 5400 * MS)
    text = 'no sample of joint a for more than 2 s, though samples came before'
    assert text in rig.status.unseen
    assert rig.noted(text) == 1
    severity, message, _ = rig.runtime.report()
    assert (severity, text in message) == (Severity.WARN, True)
    rig.samples = True
    rig.run(START + 6000 * MS)
    assert (rig.status.unseen, rig.runtime.report()[0]) == ('', Severity.OK)
    # While the clock stands still none is to come, nor from a publisher that has ended in order.
    rig.samples = False
    rig.steady += 10_000 * MS
    rig.runtime.report()
    rig.observable = False
    rig.run(START + 9000 * MS)
    assert rig.status.unseen == ''
    assert rig.noted(text) == 1


@pytest.mark.parametrize(('lag', 'text'), [
    (600, 'come 0.600 s after their timestamps'), (-600, 'come 0.600 s before their timestamps'),
    (-100, 'are 0.100 s ahead of the clock of the planner'),
    (1_700_000_000_000, 'simulated time, or time since a start')])
def test_samples_of_another_clock_are_refused_and_the_clocks_are_named(lag, text):
    rig = Rig(settings=PATIENT)
    rig.now += 2_000_000_000_000 * MS
    assert rig.runtime.request(StretchRequest('a', 1.2)).code == 'waiting'
    for _ in range(300):
        rig.runtime.observed('a', sample(rig.now - lag * MS, 1.3, 0.0, 0.05, came=rig.now))
        rig.steady += 2 * MS
        rig.tick()
    assert rig.status.verdict.code == 'clocks_differ'
    assert text in rig.status.verdict.message
    assert rig.sent == []
    # Times that are decades apart are named at once.
    assert rig.codes().count('clocks_differ') == 1


def test_samples_that_are_late_by_a_clock_that_agrees_are_gone_on_from():
    rig = Rig(settings=PATIENT)
    rig.plant.set_state(1.3, 0.0, 0.05)
    rig.runtime.request(StretchRequest('a', 1.2))
    for _ in range(300):
        rig.runtime.received('a', rig.now - MS, 0, cut_off=False)
        rig.runtime.observed('a', sample(rig.now - 600 * MS, 1.3, 0.0, 0.05, came=rig.now))
        rig.steady += 2 * MS
        rig.tick()
    assert rig.status.verdict.code == 'accepted'
    assert rig.planner.plan.levels[0].stretch == 1.3


@pytest.mark.parametrize('ahead', [-200 * MS, 3 * MS, 30 * MS, 80 * MS])
def test_the_offset_of_clocks_is_measured_and_named_where_commands_are_late(ahead):
    rig = Bench()
    rig.samples = False
    rig.ahead = ahead
    rig.go(StretchRequest('a', 1.2), START + 1500 * MS)
    severity, message, values = rig.runtime.report()
    offset, error = (
        float(values[f'clock_offset_{x}']) for x in ('ms', 'error_ms'))
    assert abs(offset - ahead / MS) <= error < 20.0
    assert severity is Severity.WARN
    assert 'ahead of' in message if ahead > 0 else 'behind' in message
    again = rig.runtime.request(StretchRequest('a', 1.3))
    assert again.code == ('clocks_differ' if ahead > LEAD else 'accepted')
    if ahead > LEAD:
        assert 'every command would come too late' in again.message


def test_clocks_that_agree_are_not_warned_of():
    rig = Bench()
    rig.go(trajectory(*SEQUENCE), START + 1500 * MS)
    severity, message, values = rig.runtime.report()
    assert (severity, message) == (Severity.OK, 'commands sent in time')
    assert abs(float(values['clock_offset_ms'])) <= float(values['clock_offset_error_ms'])


def test_a_planner_with_a_plan_to_replace_rests_while_its_device_is_away():
    rig = Bench()
    rig.go(trajectory((1.2, HOLD), (1.1, HOLD)), START + 400 * MS)
    rig.linked = False
    rig.run(START + 2000 * MS)
    rig.runtime.deviations.replan('a')
    assert rig.runtime.wake > rig.now


def test_nobody_is_asked_whether_a_device_reports_that_has_given_receipts():
    rig, asked = Bench(), []
    rig.go(trajectory((1.2, HOLD)), START + 400 * MS)
    rig.runtime.environment.reports = asked.append
    rig.go(StretchRequest('a', 1.1), START + 800 * MS)
    assert (asked, rig.status.verdict.code) == ([], 'accepted')
