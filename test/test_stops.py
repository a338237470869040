"""Stopped is said of what plant or driver has acknowledged, and of nothing else; without ROS."""

from dataclasses import replace
import math

from at_work import sample
import pytest
from test_runtime_hosts import BEATING, Bench
from test_runtime_planner import HOLD, MS, QUIET, Rig, SEQUENCE, START, trajectory

from hmsa.interfaces.diagnostics import StatusVerdict
from hmsa_ros.nodes.conversions import to_planner_status
from hmsa_ros.runtime.records import Severity, StatusChanged, Stop, StretchRequest

SECOND = 1000 * MS
LONG = ((1.1, HOLD), (1.2, 2 * HOLD), (1.3, 20 * SECOND))


def moving(rig, span=47 * MS):
    """Return a rig in the first move of a sequence, or later."""
    rig.go(trajectory(*LONG), START + span)
    return rig


def stopped_in_the_middle(rig):
    """Return a rig that was stopped during the first move."""
    moving(rig)
    assert rig.runtime.request(Stop('the stop')).code == 'accepted'
    rig.tick()
    assert rig.status.verdict.message.startswith('stopping: ')
    return rig


def outcomes(rig):
    """Return the verdicts on the stop so far."""
    return list(dict.fromkeys(
        x.verdict.code for x in rig.outputs
        if isinstance(x, StatusChanged) and x.verdict.request == 'the stop'))


class Steady(Rig):
    """A rig whose steady clock advances, without receipts."""

    def run(self, end, step=2 * MS):
        while self.now < end:
            self.steady += step
            super().run(min(self.now + step, end), step)


def test_a_stop_has_stopped_once_its_last_level_was_acknowledged_at_its_time():
    rig = stopped_in_the_middle(Bench())
    rest = rig.planner.plan.segments[-1].arrival
    rig.run(rest - 2 * MS)
    assert outcomes(rig) == ['accepted']
    rig.run(rest + 300 * MS)
    assert outcomes(rig) == ['accepted', 'stopped']
    assert rig.status.verdict.severity is Severity.OK
    assert rig.status.verdict.message == 'stopped: at rest, acknowledged by plant or driver'


def test_a_stop_at_rest_is_acknowledged_too():
    rig = moving(Bench(), SECOND)
    rig.go(Stop('the stop'), rig.now + SECOND)
    assert outcomes(rig) == ['accepted', 'stopped']


def test_a_stop_at_rest_is_acknowledged_by_hardware_that_rounds_times_and_levels(monkeypatch):
    rig = Bench()
    hear = rig.runtime.applied
    # As a serial board: levels in steps of 1 uT, and times in steps of 1 us.
    monkeypatch.setattr(rig.runtime, 'applied', lambda joint, stamp, level: hear(
        joint, stamp - 438, round(level, 6)))
    rig.go(trajectory(*LONG), START + SECOND)
    rig.go(Stop('the stop'), rig.now + SECOND)
    assert outcomes(rig) == ['accepted', 'stopped']


def test_a_plan_that_goes_on_without_the_lost_levels_of_a_stop_is_no_stop():
    rig = stopped_in_the_middle(Bench())
    rig.hears = False
    # Samples rest where the level from before keeps the actuator.
    for _ in range(500):
        rig.run(rig.now + 10 * MS)
        rig.runtime.looks_at(rig.now)
        rig.observe()
    assert 'stopped' not in outcomes(rig)


@pytest.mark.parametrize('fault', ['hears', 'linked'])
def test_a_stop_that_does_not_arrive_has_not_stopped_until_it_does(fault):
    rig = Bench()
    rig.go(trajectory(*LONG), START + 200 * MS)
    setattr(rig, fault, False)
    rig.go(Stop('the stop'), rig.now + 6 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard']
    assert rig.status.verdict.severity is Severity.ERROR
    assert 'has not acknowledged it for 2.' in rig.status.verdict.message
    assert 'switch the coil off there' in rig.status.verdict.message
    assert rig.plant.stretch > 1.25
    setattr(rig, fault, True)
    rig.run(rig.now + 3 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard', 'stopped']


def test_a_stop_is_sent_to_a_device_whose_receipts_are_silent():
    rig = Bench()
    rig.runtime.request(trajectory(*((1.2 + 0.1 * (i % 2), 400 * MS * i) for i in range(1, 9))))
    rig.run(START + 500 * MS)
    rig.mute = True
    rig.run(START + 1380 * MS)
    assert rig.runtime.devices.receipts.silent
    rig.run(START + 1600 * MS)
    rig.go(Stop('the stop'), rig.now + 4 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard']
    level = rig.planner.plan.levels[-1].flux_density
    assert rig.wire == []
    assert [x.flux_density for _, x in rig.sent][-1] == rig.plant.flux_density == level
    rig.mute = False
    rig.run(rig.now + 2 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard', 'stopped']


def test_a_stop_that_a_silent_device_may_have_carried_out_is_sent_once(monkeypatch):
    rig, reports = Bench(), []
    rig.runtime.request(trajectory(*((1.2 + 0.1 * (i % 2), 400 * MS * i) for i in range(1, 9))))
    rig.run(START + 500 * MS)
    # Commands arrive, but nothing comes back.
    rig.mute, hear = True, rig.runtime.applied
    monkeypatch.setattr(rig.runtime, 'applied', lambda *report: reports.append(report))
    rig.run(START + 1600 * MS)
    rig.go(Stop('the stop'), rig.now + SECOND)
    assert reports
    count = len(rig.sent)
    rig.run(rig.now + 25 * SECOND, step=20 * MS)
    assert len(rig.sent) == count
    assert outcomes(rig) == ['accepted', 'unheard']
    rig.mute = False
    monkeypatch.setattr(rig.runtime, 'applied', hear)
    for report in reports:
        rig.runtime.applied(*report)
    rig.run(rig.now + SECOND)
    assert outcomes(rig) == ['accepted', 'unheard', 'stopped']
    assert 'replanned' not in rig.codes()


def test_the_lost_levels_of_a_stop_are_planned_anew_only_once_the_device_is_heard():
    rig = moving(Bench())
    rig.hears = False
    rig.go(Stop('the stop'), rig.now + 2 * SECOND)
    rig.mute = True
    rig.run(rig.now + SECOND)
    assert rig.runtime.devices.receipts.silent
    assert rig.runtime.deviations.astray
    count = len(rig.sent)
    rig.run(rig.now + 25 * SECOND, step=20 * MS)
    assert len(rig.sent) == count
    assert outcomes(rig)[-1] == 'unheard'
    rig.hears, rig.mute = True, False
    rig.run(rig.now + 2 * SECOND)
    assert outcomes(rig)[-1] == 'stopped'


def test_no_level_is_sent_in_vain_while_commands_do_not_arrive():
    rig = moving(Bench())
    rig.hears = False
    rig.go(Stop('the stop'), rig.now + 2 * SECOND)
    count = rig.runtime.devices.sent
    rig.run(rig.now + 25 * SECOND, step=20 * MS)
    assert rig.runtime.devices.sent == count
    # Heartbeats go on, with the level that is in force.
    assert rig.sent[-1][1].flux_density == rig.plant.flux_density
    rig.hears = True
    rig.run(rig.now + 2 * SECOND)
    assert outcomes(rig)[-1] == 'stopped'


def test_a_stop_is_not_carried_out_before_its_time_by_the_clock_of_the_device():
    rig = moving(Bench())
    rig.ahead = -5 * SECOND
    rig.go(Stop('the stop'), rig.now + 8 * SECOND)
    assert outcomes(rig) == ['accepted', 'clocks_differ', 'unheard']
    assert 'behind that of the planner' in rig.status.verdict.message
    assert rig.status.verdict.message.endswith('switch the coil off there')


def test_without_receipts_a_reported_level_counts():
    rig = stopped_in_the_middle(Steady())
    rig.run(rig.now + 3 * SECOND)
    assert outcomes(rig) == ['accepted', 'stopped']


def test_without_receipts_another_level_in_force_is_no_stop():
    rig = Steady()
    rig.go(trajectory(*LONG), START + 47 * MS)
    rig.hold_back = True
    rig.go(Stop('the stop'), rig.now + 5 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard']
    assert 'T was commanded: switch the coil off there' in rig.status.verdict.message


def test_without_any_report_it_is_said_that_nothing_is_known(monkeypatch):
    rig = Steady()
    monkeypatch.setattr(rig.runtime, 'applied', lambda *_: None)
    stopped_in_the_middle(rig)
    rig.run(rig.now + 5 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard']
    assert 'the actuator may still move' in rig.status.verdict.message


def test_without_a_device_nothing_has_stopped():
    rig = Steady()
    rig.unheard = 'no node subscribes to flux_density_command: start a plant or a driver'
    rig.go(Stop('the stop'), rig.now + 5 * SECOND)
    assert outcomes(rig) == ['accepted', 'unheard']
    assert 'start a plant or a driver' in rig.status.verdict.message


@pytest.mark.parametrize(('amplitude', 'code', 'words'), [
    (0.0, 'stopped', 'stopped: at rest, measured'),
    (0.05, 'vibrating', 'the stop was acknowledged, but ')])
def test_samples_that_vibrate_contradict_a_stop(amplitude, code, words):
    rig = stopped_in_the_middle(Bench())
    # It rests beside the predicted stretch, which is no matter.
    rest = rig.planner.plan.segments[-1].stretch + 0.03
    frequency = rig.planner.model.frequency(rest) / rig.planner.model.units.time
    while rig.now < START + 3 * SECOND:
        rig.run(rig.now + 2 * MS)
        noise = 1e-5 * (rig.now // MS % 7)
        stretch = rest + noise + amplitude * math.sin(1e-9 * frequency * rig.now)
        rig.runtime.looks_at(rig.now)
        rig.runtime.observed('a', sample(rig.now, stretch, 0.0, rig.plant.flux_density))
    assert outcomes(rig) == ['accepted', code]
    assert rig.status.verdict.message.startswith(words)


def test_a_coil_that_is_cut_off_has_stopped():
    rig = stopped_in_the_middle(Bench())
    rig.cut_off()
    rig.come_back()
    rig.run(START + 500 * MS)
    assert outcomes(rig)[:2] == ['accepted', 'cut_off']


def test_a_request_that_follows_a_stop_ends_it_and_a_refused_one_does_not():
    rig = stopped_in_the_middle(Bench())
    rig.go(StretchRequest('a', 9.0, 'refused'), START + 500 * MS)
    assert outcomes(rig) == ['accepted', 'stopped']
    assert rig.status.answers['refused'][0].code == 'out_of_range'
    rig = stopped_in_the_middle(Bench())
    rig.go(StretchRequest('a', 1.3, 'taken'), START + 3 * SECOND)
    assert outcomes(rig) == ['accepted']


def test_requests_at_once_have_a_verdict_each():
    rig = Rig(settings=replace(QUIET, takeover_timeout=0))
    names = [f'request {i}' for i in range(20)]
    for i, name in enumerate(names):
        rig.runtime.request(StretchRequest('a', 9.0 if i % 3 else 1.1 + 0.01 * i, name))
    rig.tick()
    seen = StatusVerdict.read(to_planner_status(rig.status))
    verdicts = [seen.on(x) for x in names]
    assert [x.code for x in verdicts] == [
        'out_of_range' if i % 3 else 'accepted' for i in range(20)]
    assert [x.request for x in verdicts] == names
    # Each knows the plan that it has made.
    assert [x.plan for x in verdicts if x.code == 'accepted'] == list(range(1, 8))
    assert seen.on('another') is None


def test_verdicts_are_repeated_for_a_while_and_in_bounded_number():
    rig = Steady(settings=BEATING)
    for i in range(200):
        rig.runtime.request(StretchRequest('a', 9.0, f'request {i}'))
    rig.tick()
    assert list(rig.status.answers) == [f'request {i}' for i in range(136, 200)]
    rig.run(START + 31 * SECOND, 50 * MS)
    rig.runtime.request(trajectory(*SEQUENCE, name='new'))
    rig.tick()
    assert list(rig.status.answers) == ['new']


@pytest.mark.parametrize('text', ['[]', '{"a": 1}', '{"a": [1]}', '{"a": [0, 1, 2, 3]}', '{'])
def test_answers_of_any_content_are_read(text):
    rig = Rig()
    status = to_planner_status(replace(
        rig.status if rig.outputs else rig.tick()[-1], answers={}))
    status.values[0].value = text
    status.values[0].key = 'answers'
    assert StatusVerdict.read(status).on('a') is None


def test_a_request_of_a_unique_name_that_comes_again_is_carried_out_once():
    rig = Rig()
    for name, plans in (('0123456789abcdef' * 2, 1), ('base_link', 3)):
        for _ in range(2):
            rig.runtime.request(trajectory(*SEQUENCE, name=name))
            rig.tick()
            assert rig.status.verdict.request == name
        assert rig.group.number == plans
