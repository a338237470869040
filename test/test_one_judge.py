"""Status, outcomes and the samples of a record give the same findings for the same motion."""

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
import math
from pathlib import Path
import random

from at_work import AtWork, MS, planner, START
import numpy as np
import pytest

from hmsa.interfaces.diagnostics import newest, Outcome
from hmsa.judge.records import SensorModel
from hmsa.model.actuators import Setup
from hmsa.model.parameters import paper_actuator
from hmsa.model.sensor import SensorErrors
from hmsa.report.evaluation import findings_of
from hmsa.runs.record import LearntSensor, RecordedLevel, Run
from hmsa_ros.device.simulated import SimulatedDevice, SimulatedJoint
from hmsa_ros.runtime.records import EstimateChanged, Send, Settings, StatusChanged, Trajectory

# Experiments in which the planner does nothing for some time.
STALLED = (2, 46, 124, 299)


class Drawn(AtWork):
    """A random experiment: a planner and a simulated device in one loop of 1 ms."""

    def __init__(self, seed: int) -> None:
        draw = random.Random(seed)
        block = paper_actuator()
        real = replace(block, shear_modulus=block.shear_modulus * draw.choice(
            [1.0, 1.0, 1.005, 1.02, 1.1]))
        rate = draw.choice([100, 500, 1000])
        more = random.Random(f'{seed} more')
        # How samples come: as they are, in no order, with some lost, or from a clock ahead.
        self.way = more.choice(['', '', 'unordered', 'lost', 'ahead'])
        self.chance = more
        self.device = SimulatedDevice(
            [SimulatedJoint(Setup(real, real.rest), errors=SensorErrors(
                stretch_noise=draw.choice([0.0, 1e-4, 1e-3, 3e-3])))],
            period=1000 * MS // rate, time=START, seed=seed)
        super().__init__(
            {'a': planner(block, lead_time=50 * MS)},
            Settings(takeover_timeout=0, feedback=more.choice(['off', 'off', 'adapt'])))
        hold = draw.choice([20, 60, 100, 200]) * MS
        self.late_for = draw.choice([20, 100, 400]) * MS
        self.points = [((round(draw.uniform(1.02, 1.4), 3),), hold * (i + 1))
                       for i in range(draw.randint(1, 5))]
        # For some time the way to the device takes longer than lead_time.
        self.late = draw.choice([0, 0, draw.randint(1, 120)]) * MS
        self.late_from = START + draw.randint(0, hold * len(self.points) // MS) * MS
        # For some time the planner does nothing, nor does it take what comes meanwhile, perhaps.
        stalls = random.Random(f'{seed} stalls')
        self.stall = stalls.choice([0, 0, stalls.randint(20, 600)]) * MS
        self.stall_from = START + stalls.randint(1, hold * len(self.points) // MS) * MS
        self.deaf = stalls.random() < 0.5 and self.way != 'ahead'
        self.online: dict[int, str] = {}
        self.waiting: list[tuple[int, float]] = []
        self.record = Run(
            'run', 'a', Path('run'), *([np.zeros(1, dtype=np.int64)] * 2), *([np.zeros(1)] * 3),
            plant=block, planner=block, parameters_known=True)

    def carry_out(self) -> Run:
        """Carry it out, and return the run as a recorder would store it."""
        self.runtime.request(Trajectory(('a',), self.points, len(self.points), name='x'))
        commands, outcomes, samples, sensors = [], [], [], []
        under_way: list[tuple[int, Send]] = []
        changed, read = [], []
        end = START + self.points[-1][1] + 1500 * MS
        watching = False
        while self.now < end or watching:
            stalled = self.stall_from <= self.now < self.stall_from + self.stall
            for x in [] if stalled else self.runtime.tick(self.now):
                if isinstance(x, Send):
                    commands.append(RecordedLevel(x.stamp, x.flux_density, self.now))
                    late = self.late_from <= self.now < self.late_from + self.late_for
                    under_way.append((self.now + self.late * late, x))
                elif isinstance(x, Outcome):
                    outcomes.append(x)
                elif isinstance(x, EstimateChanged):
                    sensors.append(LearntSensor(self.now, SensorModel.of(
                        {key: str(value) for key, value in x.values.items()})))
                elif isinstance(x, StatusChanged):
                    watching = x.watching
                    # Of several in one tick the newest is told, and the worst of all.
                    self.online |= {
                        y.setpoint.number: str(y.verdict) for y in (
                            *x.findings.values(), *filter(None, [x.worst]))}
            for x in [x for x in under_way if x[0] <= self.now]:
                under_way.remove(x)
                self.device.receive(0, x[1].stamp, x[1].flux_density)
            self.now += MS
            self.device.advance(self.now)
            changed += self.device.changes()
            shown = [(*x, self.now) for x in self.shown()]
            samples += [(stamp, at, value) for stamp, value, at in shown]
            read += shown
            if stalled and self.deaf:
                continue
            for x in changed:
                self.runtime.applied('a', x.stamp, x.level)
            for stamp, value, _ in read:
                self.show(stamp, value)
            changed, read = [], []
        time, logged, stretch = map(np.array, zip(*sorted(samples), strict=True))
        unknown = np.full(len(time), math.nan)
        return replace(
            self.record, time=time, logged=logged, stretch=stretch, rate=unknown,
            flux_density=unknown, commands=tuple(commands), outcomes=tuple(newest(outcomes)),
            sensors=tuple(sensors))

    def shown(self) -> list[tuple[int, float]]:
        """Return the samples that arrive now."""
        self.waiting += [(x.time, x.stretch[0]) for x in self.device.samples()]
        if self.way == 'unordered' and len(self.waiting) < 7:
            return []
        found, self.waiting = self.waiting, []
        if self.way == 'unordered':
            self.chance.shuffle(found)
        elif self.way == 'lost':
            found = [x for x in found if self.chance.random() < 0.6]
        elif self.way == 'ahead':
            found = [(stamp + 300 * MS, x) for stamp, x in found]
        return found


@lru_cache(maxsize=8)
def carried_out(seed: int) -> tuple[Drawn, Run]:
    """Return an experiment, and the run as a recorder would store it."""
    drawn = Drawn(seed)
    return drawn, drawn.carry_out()


def said(seeds: Iterable[int]) -> set[str]:
    """Compare the findings of status, outcomes and samples; return all verdicts."""
    seen = set()
    for seed in seeds:
        drawn, run = carried_out(seed)
        told = {x.setpoint.number: str(x.verdict) for x in findings_of(run)}
        assert told == drawn.online, seed
        # A setpoint that was missed has no samples of its own.
        blind = replace(run, outcomes=tuple(
            x if x.missed else replace(x, finding=None) for x in run.outcomes))
        if drawn.way != 'ahead':
            assert {x.setpoint.number: str(x.verdict) for x in findings_of(blind)} == told, seed
        seen |= set(told.values())
    return seen


def test_status_outcomes_and_samples_have_the_same_verdicts():
    assert said([0, 3, *STALLED]) >= {
        'arrived', 'off_target', 'undecided', 'late', 'missed'}


@pytest.mark.slow
@pytest.mark.parametrize('part', range(2))
def test_status_outcomes_and_samples_have_the_same_verdicts_of_many_runs(part):
    first = 12 + 37 * part
    assert said(range(first, first + 37)) >= {'arrived', 'off_target', 'undecided', 'missed'}
