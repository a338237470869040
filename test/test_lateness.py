"""Effects of late, rounded and saturated levels, and the planner's reactions."""

from dataclasses import replace
import math
import random

from at_work import AtWork, MS, planner, START
from core_oracle import follow
import numpy as np
import pytest

from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa.planning.lateness import better_than_keeping
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.records import (
    Settings,
    Severity,
    StatusChanged,
    Trajectory,
)

LIMIT = 0.5
QUIET = Settings(heartbeat_period=0, takeover_timeout=0)
# A move that begins from rest, two more, and times to come to rest in, in units of time.
TARGETS, SPAN = (1.2, 1.4, 1.1, 1.3), 8.0


class Bench(AtWork):
    """A runtime with a coil that writes late; SciPy simulates the actuator."""

    def __init__(
            self, unit, lead, settings=QUIET, write=lambda number, level: (0, level),
            shaper='two_step'):
        paper = paper_actuator()
        slow = unit / paper.time_unit
        self.block = replace(
            paper, density=paper.density * slow ** 2, damping_coefficient=1e-3 * slow)
        self.span = round(SPAN * unit * 1e9)
        self.lead, self.write = lead, write
        super().__init__(
            {'a': planner(self.block, shaper=shaper, lead_time=lead)}, settings,
            steady=lambda: 0)
        self.ahead, self.applied, self.sent = [], [(0, 0.0)], []
        self.number = 0
        # How late news come.
        self.lag = 0
        self.news = []

    def go(self, targets=TARGETS, raw=False, spans=None):
        points = spans or [(x, (i + 1) * self.span) for i, x in enumerate(targets)]
        self.begin = self.now + self.lead
        return self.runtime.request(Trajectory(
            ('a',), [((x,), t) for x, t in points], len(points), raw=raw))

    def run(self, span):
        end = self.now + span
        while self.now < end:
            for x in self.tick():
                self._take(x)
            due = [x.stamp for x in self.ahead] + [x[0] for x in self.news]
            wake = self.group.next_command()
            self.now = min([end, self.now + self.span // 40] + [
                x for x in (*due, *([wake] if wake is not None else [])) if x > self.now])
            while self.ahead and self.ahead[0].stamp <= self.now:
                x = self.ahead.pop(0)
                if x.flux_density != self.applied[-1][1]:
                    self.applied.append((x.stamp, x.flux_density))
                    self.news.append((x.stamp + self.lag, self.applied[-1]))
            while self.news and self.news[0][0] <= self.now:
                self.runtime.applied('a', *self.news.pop(0)[1])

    def _take(self, command):
        late, level = 0, command.flux_density
        if not self.sent or level != self.sent[-1].flux_density:
            late, level = self.write(self.number, level)
            self.number += 1
        self.sent.append(command)
        last = self.ahead[-1].stamp if self.ahead else self.applied[-1][0]
        self.ahead.append(replace(
            command, stamp=max(command.stamp + late, self.now, last), flux_density=level))

    def left(self, target, step, at=None):
        """Return residual vibration and distance from a target, peak to peak, in % of a step."""
        group, at = self.block.nondimensional, self.now if at is None else at
        unit, load = self.block.time_unit, self.block.flux_density_unit
        stamps = [START, *(max(x, START) for x, _ in self.applied if x < at), at]
        pieces = [((b - a) / 1e9 / unit, level / load) for a, b, (_, level) in zip(
            stamps, stamps[1:], [(0, 0.0), *self.applied], strict=False)]
        stretch, rate = follow(
            (1.0, 0.0), pieces, group.zeta, group.j_lim, group.c1, tolerance=1e-9)
        frequency = self.group.planners['a'].model.frequency(target)
        return 200.0 * math.hypot(stretch - target, rate / frequency) / step

    def mean(self, targets=TARGETS):
        # The last one is held on, in which it may still be put right.
        starts, ends = (1.0, *targets), (*range(1, len(targets)), len(targets) + 1)
        return float(np.mean([
            self.left(x, abs(x - start), self.begin + end * self.span - 1)
            for x, start, end in zip(targets, starts, ends, strict=False)]))


def sequence(unit, lead, write, **more):
    bench = Bench(unit, lead, write=write, **more)
    assert bench.go().severity is Severity.OK
    bench.run(lead + 5 * bench.span)
    return bench


# -- doing nothing competes ---------------------------------------------------------------------


@pytest.mark.parametrize('lead', [5 * MS, 50 * MS])
def test_constant_delay_leaves_no_vibration_and_calls_for_no_plan(lead):
    bench = sequence(0.0044, lead, lambda number, level: (9 * MS, level))
    assert bench.status.replanned == 0
    assert bench.mean() < 1e-4
    severity, message, _ = bench.runtime.report()
    assert (severity, 'all alike' in message) == (Severity.OK, True)


def test_one_late_write_among_punctual_ones_is_planned_for():
    bench = sequence(
        0.044, 50 * MS, lambda number, level: (30 * MS if number == 2 else 0, level))
    assert bench.status.replanned >= 1
    assert bench.left(1.3, 0.2) < 0.1


# Ways in which commands are late. A move has two levels or more, so these are among the first.
KINDS = ('single', 'burst', 'lost', 'onset', 'persistent', 'jitter')


def _delays(kind, largest, seed):
    """Return the lateness of the hardware, at most a number of ns."""
    chance = random.Random(seed)
    first, late = chance.randrange(7), round(chance.uniform(0.05, 1.0) * largest)
    numbers = {
        'single': range(first, first + 1), 'burst': range(first, first + 2),
        'onset': range(first, 1000), 'persistent': range(1000), 'lost': range(0)}
    if kind == 'jitter':
        return lambda number, level: (round(chance.uniform(0, late)), level)
    # Where one is lost, the level that was in force goes on.
    levels = [0.0]

    def write(number, level):
        levels.append(level)
        lost = kind == 'lost' and number == first
        return late * (number in numbers[kind]), levels[-2] if lost else level
    return write


def _case(kind, seed):
    """Return time scale in s, lead time in ms, shaper, and lateness of the hardware."""
    chance = random.Random(f'{kind} {seed}')
    unit = chance.choice((0.0044, 0.02, 0.044, 0.2))
    return unit, chance.choice((5, 20, 50, 100)), chance.choice((
        'two_step', 'robust', 'minimum_time', 'smooth')), round(
            chance.choice((0.2, 2.0)) * unit * 1e9)


def _policies(kind, seed, monkeypatch, case=None):
    """Return the errors of a case with no replanning, the decision, and with replanning always."""
    unit, lead, shaper, largest = case or _case(kind, seed)
    left = {}
    for policy in ('nothing', 'decide', 'always'):
        with monkeypatch.context() as patch:
            if policy == 'always':
                patch.setattr('hmsa_ros.runtime.deviations.expected', lambda *_: np.ones(1))
                patch.setattr(
                    'hmsa_ros.runtime.deviations.better_than_keeping', lambda *_, **__: True)
                patch.setattr('hmsa.planning.lateness.Lateness.expected', 0)
                patch.setattr('hmsa.planning.lateness.Lateness.unsure', False)
            left[policy] = sequence(
                unit, lead * MS, _delays(kind, largest, seed), shaper=shaper,
                settings=replace(QUIET, replan_late=policy != 'nothing')).mean()
    return left


@pytest.mark.parametrize('kind', KINDS[:-1])
def test_a_plan_is_made_anew_where_that_helps(kind, monkeypatch):
    for seed in range(2):
        left = _policies(kind, seed, monkeypatch)
        assert left['decide'] <= min(left['nothing'], left['always']) + 0.5


def test_jitter_is_not_made_worse(monkeypatch):
    case = 0.0044, 50, 'two_step', 5 * MS
    left = [_policies('jitter', x, monkeypatch, case) for x in range(3)]
    nothing, decide, always = (np.mean([x[key] for x in left]) for key in left[0])
    assert decide <= nothing + 0.5
    assert decide < always


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_deciding_is_as_good_as_doing_nothing_and_as_always_replanning(monkeypatch):
    rows = {kind: [_policies(kind, seed, monkeypatch) for seed in range(15)] for kind in KINDS}
    worse = []
    for kind, cases in rows.items():
        median = {x: float(np.median([case[x] for case in cases])) for x in cases[0]}
        print(f'{kind:10}', {key: round(value, 2) for key, value in median.items()})
        assert median['decide'] <= min(median['nothing'], median['always']) + 0.5
        worse += [
            (kind, seed) for seed, x in enumerate(cases) if x['decide'] > x['nothing'] + 0.5]
    assert len(worse) <= 1, worse


@pytest.mark.parametrize(('after', 'unsure', 'taken'), [
    (0.9, False, True), (1.1, False, False), (1.1, True, True), (2.1, True, False)])
def test_a_new_plan_that_would_miss_by_a_step_is_left(after, unsure, taken):
    before, after = np.full(4, 5.0), np.full(4, after)
    assert better_than_keeping(before, after, news=True, unsure=unsure) is taken


# -- lateness by its cost -----------------------------------------------------------------------


def test_levels_of_an_excitation_are_sent_as_requested_however_late_they_are():
    chance = random.Random(1)
    bench = Bench(0.044, 50 * MS, write=lambda number, level: (
        round(chance.uniform(0.1, 0.4) * MS), level))
    levels = [(0.02 + 0.01 * (i % 3), i * 60 * MS) for i in range(42)]
    assert bench.go(raw=True, spans=levels).severity is Severity.OK
    bench.run(bench.span + 42 * 60 * MS)
    # A shaped move takes the place of the last one.
    assert [x.flux_density for x in bench.sent[:41]] == [x for x, _ in levels[:41]]
    assert bench.status.replanned == 0
    assert 'of the step of residual vibration' in bench.runtime.report()[1]
    assert bench.runtime.report()[2]['late'] >= 42


# -- saturation and rounding --------------------------------------------------------------------


def test_amplifier_that_saturates_is_named_and_never_asked_for_more():
    most = 0.05
    bench = Bench(0.044, 50 * MS, write=lambda number, level: (0, min(level, most)))
    bench.go((1.2, 1.3))
    bench.run(bench.lead + 3 * bench.span)
    first = max(x.flux_density for x in bench.sent)
    saturated = [x.verdict for x in bench.outputs if isinstance(x, StatusChanged)
                 and x.verdict.code == 'saturated']
    assert saturated
    for text in ('0.05 T took effect', f'{first:.4g} T was commanded', 'flux_density_max'):
        assert text in saturated[0].message
    known = next(i for i, x in enumerate(bench.sent) if x.flux_density > most)
    later = [x.flux_density for x in bench.sent[known + 2:]]
    assert later
    assert max(later) <= most
    # A shaped end as near as it gets, and what is reachable is reached exactly.
    bench.go((1.1,))
    bench.run(bench.lead + bench.span)
    assert bench.left(1.1, 0.1) < 1e-3
    assert bench.group.planners['a'].options.flux_density_max == LIMIT


def test_levels_that_hardware_rounds_are_the_commanded_ones():
    step = 2.0 * LIMIT / 2 ** 16
    bench = sequence(
        0.044, 50 * MS, lambda number, level: (0, round(level / step) * step))
    assert not bench.notes()
    assert bench.status.replanned == 0
    assert bench.runtime.report()[2]['late'] == 0
    predicted = bench.group.planners['a'].state(bench.now)
    assert predicted.load * bench.block.flux_density_unit == bench.applied[-1][1]


# -- a plant that lags --------------------------------------------------------------------------


def test_reports_that_come_late_are_no_loss():
    bench = Bench(0.044, 50 * MS, Settings(takeover_timeout=0))
    bench.lag = 2000 * MS
    bench.go()
    bench.run(bench.lead + 4 * bench.span)
    bench.run(4000 * MS)
    # The next levels end at the one that is in force.
    bench.go((1.1, 1.3))
    bench.run(bench.lead + 2 * bench.span + 4000 * MS)
    assert bench.status.replanned == 0
    assert len({(x.stamp, x.flux_density) for x in bench.sent if x.stamp in {
        y for y, _ in bench.applied}}) == 12
    assert bench.left(1.3, 0.2) < 1e-3


@pytest.mark.parametrize(('part', 'percent'), [(0.01, 4.3), (0.05, 21), (1 / 6, 67), (0.25, 95)])
def test_one_late_level_leaves_what_the_guide_says_and_levels_that_are_all_late_nothing(
        part, percent):
    block = paper_actuator()
    planner = Planner(block, Options(flux_density_min=-LIMIT, flux_density_max=LIMIT))
    planner.setpoint(1.2, START)
    levels = planner.due(START + 1000 * MS)
    period = 2.0 * math.pi / planner.model.frequency(1.2) * block.time_unit * 1e9

    def left(*late: int) -> float:
        """Return the vibration in % of the step after some of the levels were late."""
        simulation = ActuatorSimulation(block, time=START)
        for i, x in enumerate(levels):
            delay = round(part * period) if i in late else 0
            simulation.command(x.stamp + delay, x.flux_density)
        begin = levels[-1].stamp + round(part * period)
        stretches = []
        for k in range(200):
            simulation.advance(begin + round(k / 100 * period))
            stretches.append(simulation.stretch)
        return np.ptp(stretches) / 0.2 * 100

    assert [left(0), left(1)] == pytest.approx([percent, percent], rel=0.02)
    assert left(0, 1) < 1e-4
