"""The planner over time, with its command stream applied to a simulated actuator."""

from dataclasses import replace
import math

from core_oracle import follow, holding_load
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import Plant, set_options
import pytest

from hmsa.errors import BadInputError
from hmsa.model.equations import elastic_force
from hmsa.model.moves import Setpoint
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.status import Code, RefusedError
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import plan_sequence

ACTUATOR = paper_actuator()
GROUP = ACTUATOR.nondimensional
TESLA = ACTUATOR.flux_density_unit
MS = 1_000_000
LEAD = 50 * MS
# A stamp of this century, where doubles no longer resolve a nanosecond.
START = 1_760_000_000_123_456_789
# How far the simulated actuator may be from what the planner predicts: stamps are rounded to
# nanoseconds, half of which at full speed is some 1e-8 of stretch.
PREDICTED = 1e-7
RESIDUAL = 1e-6


class Rig:
    """A planner and an actuator that obeys its commands, polled as by the node."""

    def __init__(self, *, zeta=0.2, stretch=1.0, tick=2 * MS, **options):
        self.actuator = paper_actuator(NondimensionalParameters(zeta=zeta))
        self.planner = Planner(self.actuator, Options(**options), stretch=stretch)
        self.simulation = Plant(
            self.actuator, time=START, stretch=stretch,
            slew_limit=options.get('slew_limit', math.inf))
        self.now = START
        self.tick = tick
        self.sent = []

    def send(self):
        for level in self.planner.due(self.now):
            assert level.stamp <= self.now + self.planner.options.lead_time
            # Nothing that has been superseded is sent, and nothing too late.
            assert level in self.planner.plan.levels
            assert self.simulation.command(level.stamp, level.flux_density) == 0
            self.sent.append(level)

    def request(self, points, stamp=None):
        plan = self.planner.request(
            [(x, round(t * MS)) for x, t in points], stamp, self.now)
        self.send()
        return plan

    def setpoint(self, stretch):
        plan = self.planner.setpoint(stretch, self.now)
        self.send()
        return plan

    def stop(self):
        plan = self.planner.stop(self.now)
        self.send()
        return plan

    def wait(self, milliseconds, *, check=True):
        """Advance time, and compare the actuator with the prediction at every tick."""
        end = self.now + round(milliseconds * MS)
        while self.now < end:
            self.now = min(self.now + self.tick, end)
            self.send()
            self.simulation.advance(self.now)
            if check:
                self.compare()

    def compare(self):
        predicted = self.planner.state(self.now)
        assert self.simulation.stretch == pytest.approx(predicted.stretch, abs=PREDICTED)
        unit = self.actuator.time_unit
        assert self.simulation.rate * unit == pytest.approx(predicted.rate, abs=10 * PREDICTED)

    def rest(self, milliseconds, stretch, step=0.1):
        """Advance time, after which the actuator is at rest."""
        self.wait(milliseconds)
        assert self.at_rest(stretch, step)

    def at_rest(self, stretch, step=0.1):
        return self.simulation.residual(stretch) < RESIDUAL * step


def refused(code, reason, attempt):
    """Check a refusal, and that it changes nothing."""
    with pytest.raises(RefusedError, match=reason) as caught:
        attempt()
    assert caught.value.code is code


# -- requests -----------------------------------------------------------------------------------


def test_before_the_first_request_it_rests_where_it_is_told():
    planner = Planner(ACTUATOR, Options(), stretch=1.2)
    assert planner.plan.number == 0
    assert planner.plan.segments == ()
    assert not planner.pending
    assert planner.due(START) == ()
    assert planner.segment(START) is None
    state = planner.state(START)
    assert (state.stretch, state.rate) == (1.2, 0.0)
    assert state.load == pytest.approx(holding_load(1.2, 5.0), rel=1e-13)


def test_a_sequence_for_now_begins_a_lead_time_ahead():
    rig = Rig()
    plan = rig.request([(1.1, 40), (1.2, 80), (1.4, 120)])
    begin = START + LEAD
    assert plan.number == 1
    assert [x.begin - begin for x in plan.segments] == [0, 40 * MS, 80 * MS]
    assert [x.stretch for x in plan.segments] == [1.1, 1.2, 1.4]
    assert [x.code for x in plan.segments] == [Code.TWO_STEP] * 3
    assert len(plan.levels) == 7
    # The same command as without time and units.
    segments = plan_sequence(
        [Setpoint(x, 40e-3 / ACTUATOR.time_unit) for x in (1.1, 1.2, 1.4)], GROUP)
    expected = [
        (round((x.begin + y.time) * ACTUATOR.time_unit * 1e9), y.load * TESLA)
        for x in segments for y in x.move.levels]
    for level, (stamp, flux_density) in zip(plan.levels[1:], expected, strict=True):
        assert abs(level.stamp - begin - stamp) <= 1
        assert level.flux_density == pytest.approx(flux_density, rel=1e-6)


@pytest.mark.parametrize('zeta', [0.0, 0.02, 0.2, 1.1])
@pytest.mark.parametrize('tick', [1 * MS, 2 * MS, 7_654_321])
def test_a_sequence_leaves_no_vibration_end_to_end(zeta, tick):
    rig = Rig(zeta=zeta, tick=tick)
    plan = rig.request([(1.1, 44), (1.2, 88), (1.4, 132), (0.8, 176), (0.6, 220)])
    steps = [0.1, 0.1, 0.2, 0.6, 0.2]
    for segment, step in zip(plan.segments, steps, strict=True):
        rig.wait((segment.arrival - rig.now) / MS)
        assert rig.now == segment.arrival
        assert rig.at_rest(segment.stretch, step)
        rig.rest(20, segment.stretch, step)
    assert not rig.planner.pending
    assert len(rig.sent) == 10


def test_every_command_is_sent_once_and_in_time():
    rig = Rig()
    plan = rig.request([(1.1, 100), (1.2, 200), (1.3, 300)])
    handed = list(rig.sent)
    for now in range(START, START + 500 * MS, 3 * MS):
        due = rig.planner.due(now)
        assert all(now - 3 * MS < x.stamp - LEAD <= now for x in due if x not in rig.sent)
        handed += due
        assert rig.planner.due(now) == ()
    assert tuple(handed) == plan.levels[1:]
    assert not rig.planner.pending


def test_a_future_request_keeps_the_running_plan_until_then():
    rig = Rig()
    rig.request([(1.1, 60), (1.2, 120), (1.3, 180)])
    rig.wait(70)
    before = rig.planner.plan
    stamp = START + LEAD + 90 * MS
    plan = rig.request([(1.05, 30), (1.0, 60)], stamp)
    kept = [x for x in plan.ahead(rig.now) if x.stamp < stamp]
    assert kept == [x for x in before.levels if x.stamp < stamp][-len(kept):]
    # The setpoints still under way stay in the plan; what never arrives says so.
    assert [(x.stretch, x.begin - START - LEAD) for x in plan.segments] == [
        (1.1, 0), (1.2, 60 * MS), (1.05, 90 * MS), (1.0, 120 * MS)]
    assert rig.planner.segment(rig.now)[1].stretch == 1.1
    rig.wait(65)
    assert rig.planner.segment(rig.now)[1].stretch == 1.2
    assert rig.at_rest(1.2)
    rig.rest(100, 1.0)


def test_a_past_request_joins_the_sequence_in_the_middle():
    rig = Rig()
    # 1.1 is over, 1.2 is under way at the soonest possible time.
    stamp = START + LEAD - 130 * MS
    plan = rig.request([(1.1, 100), (1.2, 200), (1.3, 300)], stamp)
    assert [x.stretch for x in plan.segments] == [1.2, 1.3]
    assert plan.segments[0].begin == START + LEAD
    assert plan.segments[1].begin == stamp + 200 * MS
    rig.rest(60, 1.2, 0.2)
    rig.rest(200, 1.3)


def test_a_request_that_is_over_is_refused_with_the_times():
    rig = Rig()
    refused(Code.IN_THE_PAST, r'stamped .* s ends at .* s, now is .* s: .*use_sim_time',
            lambda: rig.request([(1.1, 100)], START - 100 * MS))
    # Its end lies ahead, but within the lead time.
    refused(Code.IN_THE_PAST, 'more than lead_time',
            lambda: rig.request([(1.1, 100)], START - 60 * MS))
    assert rig.planner.plan.number == 0


def test_a_first_point_at_time_0_where_the_actuator_is_asks_for_nothing():
    rig = Rig(stretch=1.1)
    plan = rig.request([(1.1, 0), (1.2, 50)])
    assert [x.stretch for x in plan.segments] == [1.2]
    rig.rest(110, 1.2)
    refused(Code.SPELL_TOO_SHORT, 'asks for stretch 1.3 at time_from_start 0, the actuator is '
            'at 1.2', lambda: rig.request([(1.3, 0), (1.4, 50)]))
    refused(Code.SPELL_TOO_SHORT, 'stretch 1.4 is due at time_from_start 0',
            lambda: rig.request([(1.4, 0)]))


BAD_POINTS = {
    'empty': (Code.BAD_INPUT, 'no points', []),
    'not a number': (Code.BAD_INPUT, 'stretch is nan', [(1.1, 40), (math.nan, 80)]),
    'infinite': (Code.BAD_INPUT, 'stretch is inf', [(math.inf, 40)]),
    'minus infinite': (Code.BAD_INPUT, 'stretch is -inf', [(-math.inf, 40)]),
    'zero': (Code.BAD_INPUT, 'stretch is 0: expected a finite number greater', [(0.0, 40)]),
    'negative': (Code.BAD_INPUT, 'stretch is -1: expected a finite number', [(-1.0, 40)]),
    'above': (Code.OUT_OF_RANGE, 'target stretch is 2.7: .*0.2520 and 2.6940',
              [(1.1, 40), (2.7, 80)]),
    'below': (Code.OUT_OF_RANGE, 'target stretch is 0.2: ', [(0.2, 40)]),
    'equal times': (Code.NOT_INCREASING, r'point 1 is 0.04 s after 0.04 s',
                    [(1.1, 40), (1.2, 40)]),
    'falling times': (Code.NOT_INCREASING, r'point 2 is 0.05 s after 0.08 s',
                      [(1.1, 40), (1.2, 80), (1.3, 50)]),
    'negative time': (Code.NOT_INCREASING, r'point 0 is -0.001 s: expected at least 0 s',
                      [(1.1, -1)]),
    'too short': (Code.SPELL_TOO_SHORT, r'takes 0.005\d+ s, its setpoint lasts 0.003 s',
                  [(1.1, 40), (1.2, 43)]),
    'too strong': (Code.FLUX_LIMIT, r'stretch 2.2 needs a flux density of .* T: expected -0.4 T '
                   'to 0.4 T', [(1.1, 40), (2.2, 80)]),
}


@pytest.mark.parametrize('name', BAD_POINTS)
@pytest.mark.parametrize('when', [0, 52, 300])
def test_a_refused_request_leaves_plan_and_outbox_alone(name, when):
    code, reason, points = BAD_POINTS[name]
    rig = Rig(flux_density_min=-0.4, flux_density_max=0.4)
    rig.request([(1.1, 40), (1.2, 80), (1.3, 200)])
    rig.wait(when)
    planner = rig.planner
    plan, pending = planner.plan, planner.pending
    for stamp in (None, rig.now + LEAD + 30 * MS):
        refused(code, reason, lambda stamp=stamp: rig.request(points, stamp))
        assert planner.plan is plan
        assert planner.pending == pending
    if len(points) == 1 and points[0][1] > 0 and code in (Code.BAD_INPUT, Code.OUT_OF_RANGE):
        refused(code, reason, lambda: rig.setpoint(points[0][0]))
        assert planner.plan is plan
    # The rest of the stream is as if nobody had asked.
    rig.wait(400)
    assert tuple(rig.sent) == plan.levels[1:]
    assert rig.at_rest(1.3)


# -- pre-emption --------------------------------------------------------------------------------


def test_the_prediction_is_continuous_across_a_pre_emption():
    rig = Rig(lead_time=3 * MS)
    rig.setpoint(1.3)
    rig.wait(4)
    begin = rig.now + 3 * MS
    before = rig.planner.state(begin)
    just = rig.planner.state(begin - 1)
    rig.setpoint(0.9)
    after = rig.planner.state(begin)
    assert (after.stretch, after.rate) == pytest.approx(
        (before.stretch, before.rate), abs=1e-12)
    assert rig.planner.state(begin - 1) == just
    level = next(x for x in rig.planner.plan.levels if x.stamp == begin)
    assert level.stretch == pytest.approx(before.stretch, abs=1e-12)
    assert level.rate * ACTUATOR.time_unit == pytest.approx(before.rate, abs=1e-12)


def test_a_second_pre_emption_before_the_first_applies():
    rig = Rig()
    rig.setpoint(1.1)
    for target in (1.3, 0.9, 1.2):
        rig.wait(10)
        rig.setpoint(target)
    rig.wait(45)
    rig.wait(40)
    # Each was taken up a lead time after it was asked for, in the middle of the one before.
    begins = [START + LEAD + i * 10 * MS for i in range(4)]
    assert {x.stamp for x in rig.sent} >= set(begins)
    stamps = [x.stamp for x in rig.sent]
    assert stamps == sorted(set(stamps))
    assert rig.at_rest(1.2)


def test_commands_already_sent_are_superseded_when_the_lead_time_falls():
    rig = Rig()
    rig.setpoint(1.3)
    rig.wait(8)
    assert len(rig.sent) == 2
    set_options(rig.planner, replace(rig.planner.options, lead_time=1 * MS))
    rig.setpoint(1.1)
    assert rig.sent[-1].stamp < rig.sent[0].stamp
    rig.rest(30, 1.1)
    rig.rest(60, 1.1)


def test_repeated_single_points_a_little_ahead_are_followed():
    # A teleoperation: a new point every 7 ms, each stamped 60 ms ahead.
    rig = Rig()
    target = 1.0
    for i in range(60):
        target = 1.0 + 0.2 * math.sin(0.2 * i)
        rig.request([(target, 12)], rig.now + 60 * MS)
        rig.wait(7)
    rig.rest(120, target)
    # Old levels and segments do not pile up.
    assert len(rig.planner.plan.ahead(rig.now)) < 40
    assert len(rig.planner.plan.levels) < 72
    assert len(rig.planner.plan.segments) < 40


def test_the_plan_forgets_what_is_over():
    rig = Rig()
    for i in range(30):
        rig.setpoint(1.1 + 0.1 * (i % 2))
        rig.wait(70)
    assert len(rig.planner.plan.ahead(rig.now)) <= 4
    # Some more are kept until there is news of them.
    assert len(rig.planner.plan.levels) < 40
    assert len(rig.planner.plan.segments) <= 2
    assert rig.planner.plan.number == 30


def test_a_setpoint_now_drops_a_future_sequence():
    rig = Rig()
    rig.request([(1.3, 50), (1.4, 100)], START + 500 * MS)
    rig.wait(20)
    plan = rig.setpoint(1.1)
    assert [x.stretch for x in plan.segments] == [1.1]
    rig.rest(800, 1.1)
    assert len(rig.sent) == 2


def test_sending_the_same_target_again_changes_nothing():
    rig = Rig()
    plan = rig.setpoint(1.2)
    for wait in (0.5, 30, 22, 1, 3, 40, 1000):
        rig.wait(wait)
        assert rig.setpoint(1.2) is plan
        if rig.now > START + 2 * MS:
            # A single point says the same; what would begin before the plan does is new.
            assert rig.request([(1.2, 30)]) is plan
    assert rig.at_rest(1.2, 0.2)
    assert len(rig.sent) == 2


def test_the_same_target_after_another_one_is_a_new_request():
    rig = Rig()
    rig.setpoint(1.2)
    rig.wait(5)
    rig.setpoint(1.1)
    rig.wait(5)
    assert rig.setpoint(1.2).number == 3
    rig.rest(120, 1.2)


@settings(max_examples=35, deadline=None)
@given(
    steps=st.lists(st.tuples(
        st.sampled_from(['setpoint', 'now', 'future', 'past', 'stop', 'bad']),
        st.floats(0.0, 70.0), st.floats(0.75, 1.5), st.floats(0.75, 1.5),
        st.floats(1.0, 60.0)), min_size=1, max_size=8),
    zeta=st.sampled_from([0.02, 0.2, 1.1]),
    short_spell=st.sampled_from(['refuse', 'continue']),
    lead=st.sampled_from([0, 1, 10, 50]),
    hardware=st.sampled_from([
        {}, {}, {'period': MS}, {'period': 2_500_000}, {'slew_limit': 100.0},
        {'period': MS, 'slew_limit': 20.0}]))
def test_whatever_is_asked_the_actuator_does_what_is_predicted(
        steps, zeta, short_spell, lead, hardware):
    rig = Rig(
        zeta=zeta, short_spell=short_spell, lead_time=lead * MS, flux_density_min=-0.5,
        flux_density_max=0.5, **hardware)
    for kind, wait, first, second, span in steps:
        points = [(first, span), (second, 2 * span)]
        before = rig.planner.plan
        try:
            if kind == 'setpoint':
                rig.setpoint(first)
            elif kind == 'now':
                rig.request(points)
            elif kind == 'future':
                rig.request(points, rig.now + round(span * 2 * MS))
            elif kind == 'past':
                rig.request(points, rig.now - round(span * 0.5 * MS))
            elif kind == 'stop':
                rig.stop()
            else:
                rig.request([(first, span), (99.0, 2 * span)])
        except RefusedError:
            assert rig.planner.plan is before
        else:
            assert kind != 'bad'
        # The simulation is compared with the prediction at each tick.
        rig.wait(wait)
    rig.wait(400)
    assert not rig.planner.pending
    assert all(-0.5 - 1e-12 <= x.flux_density <= 0.5 + 1e-12 for x in rig.sent)
    if rig.planner.plan.segments and rig.planner.plan.segments[-1].arrival is not None:
        assert rig.at_rest(rig.planner.plan.segments[-1].stretch, 1.0)
        assert rig.now > rig.planner.plan.segments[-1].arrival


# -- spells too short ---------------------------------------------------------------------------


def test_short_spells_are_continued_from_where_the_actuator_is():
    rig = Rig(short_spell='continue')
    plan = rig.request([(1.2, 4), (1.1, 8), (1.3, 60)])
    assert [x.code for x in plan.segments] == [
        Code.SPELL_TOO_SHORT, Code.SPELL_TOO_SHORT, Code.TWO_STEP]
    assert [x.arrival for x in plan.segments[:2]] == [None, None]
    rig.rest(120, 1.3)


def test_a_spell_within_one_command_period_is_refused():
    rig = Rig(period=10 * MS)
    rig.setpoint(1.1)
    plan = rig.planner.plan
    refused(Code.SPELL_TOO_SHORT, 'stretch 1.3 begins and ends within one command period of '
            '0.01 s', lambda: rig.request([(1.2, 31), (1.3, 32), (1.1, 80)]))
    assert rig.planner.plan is plan


@pytest.mark.parametrize('target', [1.05, 1.137, 1.199, 1.3, 0.8, 0.61])
def test_the_time_that_the_plan_names_is_enough(target):
    for now in range(START, START + 50):
        planner = Planner(ACTUATOR, Options())
        segment = planner.setpoint(target, now).segments[-1]
        again = Planner(ACTUATOR, Options())
        plan = again.request([(target, segment.arrival - segment.begin)], None, now)
        assert plan.segments[-1].arrival == segment.arrival
        with pytest.raises(RefusedError):
            Planner(ACTUATOR, Options()).request(
                [(target, segment.arrival - segment.begin - 1)], None, now)


# -- stop ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('wait', [0, 51, 52.3, 53.7, 55.1, 57, 200])
@pytest.mark.parametrize('limit', [0.05, 0.3, math.inf])
def test_stop_comes_to_rest_and_keeps_the_limits(wait, limit):
    rig = Rig(flux_density_min=-limit, flux_density_max=limit, lead_time=LEAD)
    rig.request([(1.1, 30), (0.9, 60), (1.1, 90)])
    rig.wait(wait)
    plan = rig.stop()
    assert plan.segments[-1].begin == rig.now + LEAD
    target = plan.segments[-1].stretch
    # At rest it stays where it is.
    assert wait < 200 or target == pytest.approx(1.1, abs=1e-9)
    rig.wait(LEAD / MS + 30)
    assert all(-limit <= x.flux_density <= limit for x in rig.sent)
    assert rig.at_rest(target)
    assert rig.now > plan.segments[-1].arrival
    rig.rest(200, target)
    assert not rig.planner.pending
    # From there on it plans as from any rest.
    rig.setpoint(1.05)
    rig.rest(80, 1.05)


def test_a_stop_is_near_where_it_was_asked():
    rig = Rig(lead_time=0)
    rig.setpoint(1.4)
    rig.wait(3)
    here = rig.simulation.stretch
    target = rig.stop().segments[-1].stretch
    assert here < target < here + 0.05
    rig.rest(20, target)


@pytest.mark.parametrize('wait', [1.0, 2.75, 3.0, 3.5, 5.0, 6.5, 8.0, 9.25])
def test_a_stop_beyond_what_the_limits_hold_comes_back_to_what_they_do(wait):
    # The unshaped step overshoots to stretches that need more than the largest flux density.
    most = 1.02 * float(elastic_force(1.4, 5.0)) * TESLA
    rig = Rig(shaper='step', flux_density_min=-0.02, flux_density_max=most, lead_time=0)
    rig.setpoint(1.4)
    rig.wait(wait)
    target = rig.stop().segments[-1].stretch
    rig.wait(400)
    assert all(-0.02 - 1e-15 <= x.flux_density <= most + 1e-15 for x in rig.sent)
    assert rig.at_rest(target)


# -- long times ---------------------------------------------------------------------------------


@pytest.mark.parametrize('zeta', [0.0, 0.02, 0.2, 20.0])
@pytest.mark.parametrize('hours', [1, 1000])
def test_after_hours_of_holding_it_plans_as_after_none(zeta, hours):
    planner = Planner(paper_actuator(NondimensionalParameters(zeta=zeta)), Options())
    planner.setpoint(1.1, START)
    later = START + hours * 3_600_000 * MS
    state = planner.state(later)
    assert state.stretch == pytest.approx(1.1, abs=1e-8)
    assert abs(state.rate) < 1e-7
    plan = planner.setpoint(1.2, later)
    fresh = Planner(
        paper_actuator(NondimensionalParameters(zeta=zeta)), Options(), stretch=1.1)
    expected = fresh.setpoint(1.2, later)
    assert plan.levels[-1].flux_density == expected.levels[-1].flux_density
    assert [x.stamp for x in plan.levels[-len(expected.levels) + 1:]] == pytest.approx(
        [x.stamp for x in expected.levels[1:]], abs=200)


# -- options, restart ---------------------------------------------------------------------------


def test_options_apply_from_the_next_request_on():
    rig = Rig()
    rig.setpoint(1.1)
    set_options(rig.planner, replace(rig.planner.options, shaper='step'))
    assert rig.planner.plan.segments[-1].code is Code.TWO_STEP
    rig.rest(80, 1.1)
    assert rig.setpoint(1.2).segments[-1].code is Code.STEP
    set_options(rig.planner, replace(rig.planner.options, flux_density_max=0.05))
    refused(Code.FLUX_LIMIT, 'to 0.05 T', lambda: rig.setpoint(1.4))


@pytest.mark.parametrize('options', [
    {'shaper': 'tow_step'}, {'flux_density_min': 0.1, 'flux_density_max': 0.0},
    {'flux_density_min': math.nan}, {'slew_limit': 0.0}, {'slew_limit': -1.0}, {'period': -1}])
def test_options_out_of_range_are_refused_and_the_old_ones_stay(options):
    planner = Planner(ACTUATOR, Options())
    old = planner.options
    with pytest.raises(BadInputError):
        set_options(planner, replace(old, **options))
    assert planner.options is old
    planner.setpoint(1.1, START)
    with pytest.raises(BadInputError):
        Planner(ACTUATOR, Options(**options))


@pytest.mark.parametrize('stretch', [0.0, 0.25, 2.7, math.nan])
def test_a_start_outside_the_limits_is_refused(stretch):
    with pytest.raises(BadInputError, match='initial stretch is'):
        Planner(ACTUATOR, Options(), stretch=stretch)


def test_after_the_clock_jumped_back_the_actuator_is_taken_to_be_where_it_began():
    rig = Rig()
    rig.setpoint(1.2)
    # In the middle of the move: beta_p is in force.
    rig.wait(53, check=False)
    rig.planner.restart()
    assert not rig.planner.pending
    state = rig.planner.state(START - 10 ** 12)
    assert (state.stretch, state.rate, state.load) == (1.0, 0.0, 0.0)
    planner = rig.planner
    planner.setpoint(1.1, START - 10 ** 12)
    assert planner.plan.segments[-1].begin == START - 10 ** 12 + LEAD
    assert planner.plan.kept == 0


def test_too_damped_is_planned_as_a_step_and_never_arrives():
    rig = Rig(zeta=5.0)
    plan = rig.setpoint(1.2)
    assert plan.segments[-1].code is Code.TOO_DAMPED
    assert plan.segments[-1].arrival is None
    assert 'too damped' in plan.segments[-1].reason
    rig.wait(400)
    end = follow((1.0, 0.0), [(350e-3 / ACTUATOR.time_unit, holding_load(1.2, 5.0))],
                 5.0, 5.0, 2.0)
    assert rig.simulation.stretch == pytest.approx(end[0], abs=1e-9)
