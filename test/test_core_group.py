"""Several planners under one request, and plans invalidated by events."""

from dataclasses import replace
import math

from hypothesis import given, settings
from hypothesis import strategies as st
from plants import Plant, set_options
import pytest

from hmsa.errors import BadInputError
from hmsa.model.creep import Creep
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.status import Code, RefusedError
from hmsa.planning.group import PlannerGroup, Progress, resumed
from hmsa.planning.history import Deviation
from hmsa.planning.planner import Options, Planner

MS = 1_000_000
LEAD = 50 * MS
START = 1_760_000_000_123_456_789
TOLERANCE = 5000
# Of the step: see test_core_planner.
RESIDUAL = 1e-6
BLOCKS = {
    'left': paper_actuator(), 'right': paper_actuator(NondimensionalParameters(zeta=0.05)),
    'top': replace(paper_actuator(), remanence=0.15, density=4000.0)}
SOME = [(1.1, 44 * MS), (1.2, 88 * MS), (1.4, 132 * MS)]


class Joint:
    """A planner and an actuator that obeys it, with transport delay of commands."""

    def __init__(self, actuator=None, stretch=1.0, once=False, **options):
        self.actuator = actuator or paper_actuator()
        self.planner = Planner(self.actuator, Options(**options), stretch=stretch)
        self.group = PlannerGroup({'x': self.planner})
        self.plant = Plant(
            self.actuator, time=START, stretch=stretch,
            slew_limit=options.get('slew_limit', math.inf))
        self.delay = 0
        # Whether the wire is as fast as before after the first that comes late.
        self.once = once
        # Whether a plan that cannot be resumed is a matter of course.
        self.stops = False
        self.now = START
        self.wire = []
        self.deviations = []

    def news(self, stamp, flux_density):
        found = self.group.applied('x', stamp, flux_density, TOLERANCE)
        if found is None or not found.beyond(TOLERANCE):
            return None
        self.deviations.append(found)
        self.delay = 0 if self.once else self.delay
        return found

    def wait(self, milliseconds, *, resume=True, step=MS // 4):
        end = self.now + round(milliseconds * MS)
        while self.now < end:
            for level in self.planner.due(self.now):
                # In the order in which they were sent.
                last = self.wire[-1][0] if self.wire else 0
                self.wire.append((max(self.now + self.delay, last), level))
            self.now = min(self.now + step, end)
            arrived = [x for x in self.wire if x[0] <= self.now]
            self.wire = [x for x in self.wire if x[0] > self.now]
            for at, level in arrived:
                self.advance(at, resume)
                self.plant.command(level.stamp, level.flux_density)
            self.advance(self.now, resume)

    def advance(self, time, resume=False):
        """Advance the actuator, and report each change of level that takes effect."""
        for change in self.plant.go_on(time):
            if self.news(*change) and resume:
                self.resume()

    def resume(self):
        if not self.group.may_resume('x'):
            return None
        found = resumed(self.group.planners['x'], self.now)
        assert self.stops or not found.refusal
        self.group.resume('x', found, self.now)
        return found


def group(**options):
    return PlannerGroup({
        name: Planner(block, Options(**options)) for name, block in BLOCKS.items()})


# -- several joints -----------------------------------------------------------------------------


def test_each_joint_is_planned_as_it_would_be_alone():
    joints = group()
    drafts = joints.draft_request(dict.fromkeys(BLOCKS, SOME), None, START)
    assert joints.take(drafts, START)
    assert joints.number == 1
    for name, block in BLOCKS.items():
        alone = Planner(block, Options())
        plan = alone.request(SOME, None, START)
        assert joints.planners[name].plan == plan
        assert joints.planners[name].due(START + LEAD) == alone.due(START + LEAD)
    assert not joints.take({}, START)
    assert joints.number == 1


@pytest.mark.parametrize('bad', [(3.0, 44 * MS), (math.nan, 44 * MS), (1.3, MS)])
@pytest.mark.parametrize('name', BLOCKS)
def test_what_one_joint_cannot_do_none_does(bad, name):
    joints = group()
    joints.take(joints.draft_request(dict.fromkeys(BLOCKS, SOME), None, START), START)
    before = {name: x.plan for name, x in joints.planners.items()}
    with pytest.raises(RefusedError, match=f'^joint (left|{name}): '):
        joints.draft_request(
            {x: [bad if x == name else (1.2, bad[1])] for x in BLOCKS}, None, START + MS)
    assert all(joints.planners[x].plan is plan for x, plan in before.items())


def test_stop_and_setpoint_and_progress():
    joints = group()
    assert joints.progress(START)[0] == Progress()
    joints.take(joints.draft_setpoint('left', 1.2, START), START)
    assert joints.draft_setpoint('left', 1.2, START + LEAD) == {}
    assert joints.next_command() == START
    found, each = joints.progress(START + LEAD)
    assert (found, each['right']) == (Progress('moving', 1, 1, ''), Progress())
    assert each['left'] == Progress('moving', 1, 1, '1.2')
    now = START + 2 * MS
    joints.take(joints.draft_request(dict.fromkeys(BLOCKS, SOME), None, now), now)
    stop = now + 3 * MS
    joints.take(joints.draft_stop(stop), stop)
    for planner in joints.planners.values():
        planner.due(stop + LEAD)
        assert abs(planner.state(stop + 10**9).rate) < 1e-8
    end = joints.progress(stop + 10**9)[0]
    assert (end.state, end.setpoint) == ('at_rest', end.setpoints)
    assert joints.next_command() is None
    assert joints.next_change(stop + 10**9) is None
    joints.restart()
    assert joints.next_command() is None
    assert joints.next_change(START) is None


@pytest.mark.parametrize('period', [0, MS])
def test_simultaneous_arrival_is_that_of_the_slowest_to_the_nanosecond(period):
    joints = group(period=period)
    now = START // MS * MS
    alone = group(period=period)
    alone.take(alone.draft_request(dict.fromkeys(BLOCKS, SOME), None, now), now)
    joints.simultaneous = True
    joints.take(joints.draft_request(dict.fromkeys(BLOCKS, SOME), None, now), now)
    for k in range(3):
        sooner = [x.plan.segments[k] for x in alone.planners.values()]
        found = [x.plan.segments[k] for x in joints.planners.values()]
        assert len({x.arrival for x in sooner}) > 1
        assert {x.arrival for x in found} == {max(x.arrival for x in sooner)}
        for one, other in zip(sooner, found, strict=True):
            assert other.begin - one.begin == other.arrival - one.arrival >= 0
            assert other.since == one.begin
    for name, planner in joints.planners.items():
        plant = ActuatorSimulation(BLOCKS[name], time=now)
        for level in planner.due(now + 10**9):
            plant.command(level.stamp, level.flux_density)
            if period:
                assert level.stamp % period == 0
        for segment in planner.plan.segments:
            plant.advance(segment.arrival)
            assert plant.stretch == pytest.approx(segment.stretch, abs=1e-7)
            assert plant.rate * BLOCKS[name].time_unit == pytest.approx(0.0, abs=1e-6)
            state = planner.state(segment.arrival)
            assert plant.stretch == pytest.approx(state.stretch, abs=1e-7)


def test_joint_in_motion_is_not_held_back():
    joints = group()
    joints.simultaneous = True
    joints.take(joints.draft_setpoint('left', 1.2, START), START)
    joints.planners['left'].due(START + LEAD)
    now = START + 2 * MS
    drafts = joints.draft_request(
        dict.fromkeys(BLOCKS, [(1.1, 44 * MS)]), None, now)
    assert drafts['left'].segments[0].begin == now + LEAD
    assert drafts['left'].levels[0].stamp == now + LEAD
    latest = max(x.segments[0].arrival for x in drafts.values())
    assert all(
        x.segments[0].arrival == latest for name, x in drafts.items() if name != 'left')


@pytest.mark.parametrize('creep', [Creep(), Creep((0.1, 0.05), (0.01, 0.2))])
def test_preview_has_every_joint_at_every_change(creep):
    joints = PlannerGroup({
        name: Planner(replace(block, creep=creep), Options()) for name, block in BLOCKS.items()})
    joints.take(joints.draft_request(dict.fromkeys(BLOCKS, SOME), None, START), START)
    stamps, samples = joints.preview(START, 10_000)
    assert stamps == sorted({
        x.stamp for p in joints.planners.values() for x in p.plan.levels if x.stamp > 0})
    for name, planner in joints.planners.items():
        unit = BLOCKS[name].time_unit
        for stamp, (stretch, rate, flux_density) in zip(stamps, samples[name], strict=True):
            state = planner.state(stamp)
            assert stretch == pytest.approx(state.stretch, abs=1e-10)
            assert rate * unit == pytest.approx(state.rate, abs=1e-10)
            assert flux_density == planner.plan.level(stamp).flux_density
    # From when on each joint has the level that is in force.
    begun = stamps[len(stamps) // 2]
    assert joints.preview(begun, 10_000)[0] == [x for x in stamps if x >= begun]


# -- late, lost and foreign commands ------------------------------------------------------------


@pytest.mark.parametrize('zeta', [0.0, 0.2])
@pytest.mark.parametrize('late', [0.01, 0.4, 2.0, 7.0])
@pytest.mark.parametrize('hardware', [{}, {'slew_limit': 100.0}, {'period': MS}])
def test_late_command_is_taken_in_and_the_end_is_at_rest(zeta, late, hardware):
    block = paper_actuator(NondimensionalParameters(zeta=zeta))
    joint = Joint(block, once=True, lead_time=5 * MS, **hardware)
    joint.planner.setpoint(1.2, START)
    joint.wait(2)
    # What is sent from now on is on its way longer than it is ahead: beta_1 of the move.
    joint.delay = round((5 + late) * MS)
    joint.wait(100)
    # What was on its way behind it is late, too.
    assert joint.deviations
    assert all(x.late > 0 for x in joint.deviations)
    assert joint.plant.residual(1.2) < 0.2 * RESIDUAL


def test_without_planning_anew_a_late_command_leaves_vibration():
    joint = Joint(lead_time=5 * MS)
    joint.planner.setpoint(1.2, START)
    joint.wait(2)
    joint.delay = 7 * MS
    joint.wait(20, resume=False)
    assert len(joint.deviations) == 1
    assert joint.plant.residual(1.2) > 1e-3
    # The prediction knows it all the same.
    assert joint.planner.state(joint.now).stretch == pytest.approx(joint.plant.stretch, abs=1e-7)


def test_the_rest_of_a_sequence_keeps_its_times():
    joint = Joint(once=True, lead_time=5 * MS)
    plan = joint.planner.request(SOME, None, START)
    joint.wait(2)
    joint.delay = 8 * MS
    joint.wait(15)
    anew = joint.planner.plan
    assert (anew.number, anew.kept) == (1, 0)
    assert [x.stretch for x in anew.segments] == [1.1, 1.2, 1.4]
    assert [x.since for x in anew.segments] == [x.since for x in plan.segments]
    for segment, step in zip(anew.segments, (0.1, 0.1, 0.2), strict=True):
        joint.wait((segment.arrival - joint.now) / MS)
        assert joint.plant.residual(segment.stretch) < step * RESIDUAL


def test_setpoint_there_is_no_time_left_for_is_left_out():
    joint = Joint(lead_time=5 * MS)
    joint.planner.request([(1.1, 44 * MS), (1.3, 60 * MS)], None, START)
    level, _ = joint.planner.due(START + 10 * MS)
    draft = joint.planner.draft_resumption(START + 39 * MS)
    assert (draft.missed, [x.stretch for x in draft.segments]) == (0, [1.1, 1.3])
    # The first move begins 36 ms late: its time is over before it is.
    assert joint.news(START + 41 * MS, level.flux_density) == Deviation(36 * MS)
    draft = joint.planner.draft_resumption(START + 41 * MS)
    assert (draft.missed, [x.stretch for x in draft.segments]) == (1, [1.3])
    assert draft.segments[0].begin == START + 46 * MS
    # It would do with less of a rest at the first.
    set_options(joint.planner, replace(joint.planner.options, short_spell='continue'))
    draft = joint.planner.draft_resumption(START + 41 * MS)
    assert (draft.missed, [x.stretch for x in draft.segments]) == (0, [1.1, 1.3])
    joint.planner.restart()
    assert joint.planner.draft_resumption(START) is None


def test_what_cannot_be_resumed_is_stopped():
    joint = Joint(lead_time=5 * MS, flux_density_min=-0.5, flux_density_max=0.5)
    joint.planner.setpoint(1.4, START)
    joint.planner.due(START + 2 * MS)
    set_options(joint.planner, replace(joint.planner.options, flux_density_max=0.1))
    found = resumed(joint.planner, START + 3 * MS)
    assert 'stretch 1.4 needs a flux density of' in found.refusal
    joint.group.resume('x', found, START + 3 * MS)
    rest = joint.planner.state(START + 10**9)
    assert abs(rest.rate) < 1e-9
    assert rest.stretch != pytest.approx(1.4)


def test_missed_levels_are_dropped_and_the_rest_is_planned_from_what_happens():
    joint = Joint()
    joint.planner.request(SOME, None, START)
    joint.wait(1)
    # Nothing is handed out for 130 ms: two setpoints are over then.
    joint.now += 130 * MS
    joint.advance(joint.now)
    # The levels of the third that were to come within lead_time make no sense without the first.
    assert joint.planner.drop_missed(joint.now, 0) == 5
    assert joint.planner.drop_missed(joint.now, 0) == 0
    found = joint.resume()
    assert found.draft.segments[-1].stretch == 1.4
    joint.wait(120)
    assert joint.plant.residual(1.4) < 0.4 * RESIDUAL


def test_lost_command_is_noticed_by_the_next_one():
    joint = Joint(lead_time=5 * MS)
    joint.planner.setpoint(1.2, START)
    first, second = joint.planner.due(START + 20 * MS)
    # Only the second one arrives.
    joint.plant.command(second.stamp, second.flux_density)
    joint.plant.advance(second.stamp)
    joint.now = second.stamp
    assert joint.news(second.stamp, second.flux_density) == Deviation(lost=1)
    assert [x.stamp for x in joint.planner.plan.levels][1:] == [second.stamp]
    joint.resume()
    joint.wait(100)
    assert joint.plant.residual(1.2) < 0.2 * RESIDUAL
    assert first not in joint.planner.plan.levels


def test_the_level_in_force_is_not_the_early_beginning_of_a_gentle_path():
    joint = Joint(flux_density_min=-0.5, flux_density_max=0.5)
    path = [((1.0 + 0.3 * x * x * (3.0 - 2.0 * x), 9.0 * x * (1.0 - x), math.nan),
             round(200 * MS * x)) for x in (i / 20 for i in range(21))]
    joint.planner.take(joint.planner.draft_path(path, None, START), START)
    sent = joint.planner.due(START + 50 * MS)
    assert len(sent) > 50
    # Its levels begin and differ by less than hardware that rounds resolves.
    assert 0.0 < abs(sent[0].flux_density) < 1e-4
    assert joint.group.applied('x', START, 0.0, TOLERANCE) is None
    for level in sent:
        assert joint.group.applied(
            'x', level.stamp, level.flux_density, TOLERANCE) == Deviation()


def test_foreign_level_is_taken_in():
    joint = Joint(lead_time=5 * MS)
    joint.planner.setpoint(1.2, START)
    joint.wait(100)
    # A watchdog takes the flux away.
    joint.plant.command(joint.now, 0.0)
    joint.plant.advance(joint.now)
    assert joint.news(joint.now, 0.0) == Deviation(foreign=True)
    joint.wait(3)
    assert joint.planner.state(joint.now).stretch == pytest.approx(
        joint.plant.stretch, abs=1e-7)
    joint.resume()
    joint.wait(100)
    assert joint.plant.residual(1.2) < 0.2 * RESIDUAL


def test_news_as_planned_is_no_deviation():
    joint = Joint(lead_time=5 * MS)
    joint.planner.request(SOME, None, START)
    plan = joint.planner.plan
    levels = joint.planner.due(START + 150 * MS)
    assert joint.news(START - 10**9, 0.0) is None
    for level in levels:
        assert joint.news(level.stamp, level.flux_density) is None
        # Said again, as to who comes late.
        assert joint.news(level.stamp, level.flux_density) is None
    assert joint.planner.plan == plan
    for i in range(2, 100):
        now = START + i * 100 * MS
        joint.planner.setpoint(1.1 + 0.1 * (i % 2), now)
        for level in joint.planner.due(now + 50 * MS):
            assert joint.news(level.stamp, level.flux_density) is None
    assert len(joint.planner.plan.levels) < 10


def test_levels_without_news_do_not_pile_up():
    joint = Joint(lead_time=5 * MS)
    for i in range(100):
        now = START + i * 100 * MS
        joint.planner.setpoint(1.1 + 0.1 * (i % 2), now)
        levels = joint.planner.due(now + 50 * MS)
        if i == 3:
            joint.news(levels[0].stamp, levels[0].flux_density)
    assert len(joint.planner.plan.levels) < 40


@settings(max_examples=30, deadline=None)
@given(
    delays=st.lists(st.floats(0.0, 20.0), min_size=1, max_size=6),
    targets=st.lists(st.floats(0.8, 1.4), min_size=1, max_size=5),
    wait=st.floats(1.0, 60.0))
def test_whatever_is_late_the_prediction_follows_and_the_end_is_at_rest(delays, targets, wait):
    joint = Joint(lead_time=5 * MS, flux_density_min=-1.0, flux_density_max=1.0)
    joint.stops = True
    for target, delay in zip(targets, delays * 5, strict=False):
        joint.delay = round(delay * MS)
        try:
            joint.planner.setpoint(target, joint.now)
        except RefusedError:
            continue
        joint.wait(wait)
    joint.delay = 0
    joint.wait(60)
    state = joint.planner.state(joint.now)
    assert state.stretch == pytest.approx(joint.plant.stretch, abs=1e-6)
    if joint.planner.plan.segments:
        joint.planner.stop(joint.now)
        joint.wait(60)
        assert joint.plant.residual(joint.planner.plan.segments[-1].stretch) < RESIDUAL


def test_commands_that_are_late_for_ever_are_not_planned_anew_for_ever():
    joint = Joint(lead_time=5 * MS)
    joint.delay = 12 * MS
    joint.planner.setpoint(1.2, START)
    joint.wait(300)
    count = len(joint.deviations)
    assert 3 <= count < 12
    assert joint.resume() is None
    # A new request is a new beginning, and so is a command in time.
    joint.delay = 0
    drafts = joint.group.draft_setpoint('x', 1.3, joint.now)
    joint.group.take(drafts, joint.now)
    assert joint.resume().draft is not None
    joint.wait(100)
    assert len(joint.deviations) == count
    assert joint.plant.residual(1.3) < 0.1 * RESIDUAL


# -- taking over, and other models --------------------------------------------------------------


@pytest.mark.parametrize('hardware', [{}, {'slew_limit': 30.0}])
@pytest.mark.parametrize('wait', [52.0, 53.5, 56.0, 200.0])
def test_another_planner_takes_over_from_the_state_in_force(hardware, wait):
    joint = Joint(**hardware)
    joint.planner.request(SOME, None, START)
    joint.wait(wait)
    plant = joint.plant
    planner = Planner(joint.actuator, joint.planner.options)
    planner.take_over(
        joint.now, plant.stretch, plant.rate, plant.flux_density, plant.schedule.current)
    # The first command ahead begins from the level in force: no jump before it.
    assert planner.last_sent.flux_density == plant.schedule.current
    plan = planner.setpoint(1.25, joint.now)
    assert [x.stretch for x in plan.segments] == [1.25]
    # What the old one had sent ahead takes effect, and is told.
    ahead = len(plant.schedule)
    joint.planner = planner
    joint.group = PlannerGroup({'x': planner})
    joint.wait(200)
    assert len(joint.deviations) <= ahead
    assert all(x.foreign for x in joint.deviations)
    assert joint.plant.residual(1.25) < 0.2 * RESIDUAL


def test_rest_is_believed_where_the_model_would_have_it_move():
    planner = Planner(paper_actuator(), Options())
    stronger = replace(paper_actuator(), remanence=0.11)
    plant = ActuatorSimulation(stronger, stretch=1.3)
    planner.take_over(START, 1.3, 0.0, plant.flux_density)
    state = planner.state(START + 3 * MS)
    assert (state.stretch, state.rate) == (1.3, 0.0)


def test_an_estimate_is_asked_for_once_where_the_rest_of_a_plan_is_possible_at_once():
    planner, asked = Planner(paper_actuator(), Options()), []
    planner.request(SOME, None, START)
    planner.believed = asked.append
    assert planner.draft_resumption(START + MS) is not None
    assert len(asked) == 1


@pytest.mark.parametrize('seen', [0.998, 1.0005, 1.004])
def test_noise_of_a_sensor_at_rest_is_no_motion(seen):
    planner = Planner(paper_actuator(), Options())
    fresh = planner.request(SOME, None, START)
    planner = Planner(paper_actuator(), Options())
    planner.take_over(START - MS, seen, 0.0, 0.0)
    found = planner.request(SOME, None, START)
    assert [x.flux_density for x in found.levels[1:]] == [
        x.flux_density for x in fresh.levels[1:]]


@pytest.mark.parametrize('state', [
    (math.nan, 0.0, 0.0), (3.0, 0.0, 0.0), (1.0, math.inf, 0.0), (1.0, 0.0, math.nan)])
def test_impossible_state_in_force_is_refused(state):
    planner = Planner(paper_actuator(), Options())
    plan = planner.plan
    with pytest.raises(BadInputError, match='in force'):
        planner.take_over(START, *state)
    assert planner.plan is plan


def test_other_block_is_planned_for_from_the_next_request_on():
    joint = Joint(lead_time=5 * MS)
    joint.planner.setpoint(1.2, START)
    joint.wait(8)
    stronger = replace(joint.actuator, remanence=0.2, density=3000.0, damping_coefficient=0.1)
    plan = joint.planner.plan
    set_options(joint.planner, joint.planner.options, stronger)
    assert joint.planner.plan is plan
    # Up to the switch it moves as the old one, from then on as the new one.
    joint.planner.setpoint(1.4, joint.now)
    switch = joint.now + 5 * MS
    joint.wait(5)
    assert joint.planner.state(switch - 1).stretch == pytest.approx(
        joint.plant.stretch, abs=1e-6)
    plant = ActuatorSimulation(stronger, time=switch)
    plant.set_state(joint.plant.stretch, joint.plant.rate, joint.plant.flux_density)
    for level in joint.planner.plan.levels:
        if level.stamp >= switch:
            plant.command(level.stamp, level.flux_density)
    plant.advance(switch + 100 * MS)
    assert plant.stretch == pytest.approx(1.4, abs=1e-6)
    assert plant.rate * stronger.time_unit == pytest.approx(0.0, abs=1e-6)


def test_block_that_cannot_be_where_it_is_held_is_refused():
    planner = Planner(paper_actuator(), Options())
    planner.setpoint(1.8, START)
    with pytest.raises(BadInputError, match='the stretch that is held is 1.8'):
        set_options(planner, planner.options, replace(paper_actuator(), chain_limit=1.0))
    assert planner.model.actuator == paper_actuator()
    for options in ({'short_spell': 'ignore'}, {'lead_time': -1}):
        with pytest.raises(BadInputError, match=next(iter(options))):
            set_options(planner, replace(planner.options, **options))


def test_code_of_a_refusal_stays():
    joints = group()
    with pytest.raises(RefusedError) as caught:
        joints.draft_setpoint('top', 9.0, START)
    assert caught.value.code is Code.OUT_OF_RANGE
