"""Waves whose amplitude and mean are maintained by feedback, on a plant integrated by SciPy."""

from dataclasses import replace
import math

from at_work import AtWork, MS, planner
from bench_oracle import Plant
from creep_oracle import C1
import numpy as np
import pytest
from test_path import TIME

from hmsa import Actuator
from hmsa.api.paths import smooth_points, wave_of, wave_path, wave_points
from hmsa.model.parameters import paper_actuator
from hmsa_ros.runtime.records import Settings, Stop, Trajectory

pytestmark = pytest.mark.thorough

SECOND = 1_000_000_000
AMPLITUDE, LEAD = 0.1, 20 * MS
NATURAL = math.sqrt(18.0 / (1.0 + C1)) / (2.0 * math.pi * TIME)


def varied(g=1.0, damping=1.0, remanence=1.0):
    """Return the paper's block with other parameters, by factors."""
    block = paper_actuator()
    return replace(
        block, shear_modulus=g * block.shear_modulus, remanence=remanence * block.remanence,
        damping_coefficient=damping * block.damping_coefficient)


class Run(AtWork):
    """A wave sent as a path, and its result."""

    def __init__(self, plant, share, *, shape='sine', cycles=10, noise=1e-4, feedback='adapt'):
        self.plant, self.noise = plant, noise
        self.frequency = share * NATURAL
        rows = smooth_points(*wave_points(wave_path(
            Actuator(), wave_of(Actuator(), shape, AMPLITUDE, None), (self.frequency,) * 2,
            cycles), TIME).T)
        self.times, self.wanted = rows[:, 0], rows[:, 1]
        super().__init__(
            {'a': planner(lead_time=LEAD, path_tolerance=1e-4)},
            Settings(takeover_timeout=0, heartbeat_period=0, feedback=feedback), SECOND,
            one_clock=lambda: True)
        self.sent, self.truth = [], []
        self._random = np.random.default_rng(1)
        path = [((tuple(x),), round(t * SECOND)) for t, *x in rows.tolist()]
        self.runtime.request(Trajectory(
            ('a',), path, len(path), path=path, follows=True))
        self.begin = self.planner.plan.segments[0].since

    def go(self, seconds):
        """Advance to a time in s from the begin of the wave."""
        while self.now < self.begin + seconds * SECOND:
            for x in self.tick():
                assert x.stamp >= self.now
                self.sent.append((x.stamp, x.flux_density))
                self.plant.command(*self.sent[-1])
            self.now += MS
            stretch, changes = self.plant.advance(self.now)
            self.truth.append((self.now, stretch))
            for stamp, level in changes:
                self.runtime.applied('a', stamp, level)
            self.show(self.now, stretch + self.noise * self._random.normal())
        return self

    @property
    def off(self):
        """Return times in s and deviations from the wave, as fractions of the amplitude."""
        times, stretch = np.array(self.truth).T
        times = (times - self.begin) / SECOND
        return times, (stretch - np.interp(times, self.times, self.wanted)) / AMPLITUDE

    def kept(self, first, last):
        """Return relative errors of amplitude and mean between two cycles."""
        times, stretch = np.array(self.truth).T
        turns = (times - self.begin) / SECOND * self.frequency
        inside = (turns >= first) & (turns < last)
        angle = 2.0 * math.pi * np.outer(turns[inside], np.arange(1, 6))
        found = np.linalg.lstsq(np.column_stack([
            np.ones(len(angle)), np.sin(angle), np.cos(angle)]), stretch[inside], rcond=None)[0]
        return math.hypot(found[1], found[6]) / AMPLITUDE - 1.0, (found[0] - 1.0) / AMPLITUDE


@pytest.mark.parametrize(('share', 'shape', 'cycles', 'others', 'creep'), [
    pytest.param(0.33, 'sine', 10, {'g': 0.9}, 0.0, id='a third', marks=pytest.mark.slow),
    pytest.param(0.33, 'sine', 10, {'g': 0.9}, 0.04, id='creep'),
    pytest.param(
        0.12, 'triangle', 4, {'g': 1.1, 'remanence': 0.95}, 0.0, id='triangle',
        marks=pytest.mark.slow),
    pytest.param(
        0.9, 'sine', 24, {'g': 1.1, 'damping': 1.4, 'remanence': 0.95}, 0.0, id='resonance',
        marks=pytest.mark.slow)])
def test_amplitude_and_mean_come_back_and_the_wave_ends_at_rest(
        share, shape, cycles, others, creep):
    closed, without = (
        Run(Plant(varied(**others), ratio=creep, tau=0.05), share, shape=shape, cycles=cycles,
            feedback=x)
        for x in ('adapt', 'off'))
    end = closed.times[-1]
    ends = []
    for run in (closed, without):
        run.go(end + 0.05)
        times, off = run.off
        ends.append(np.ptp(off[times > end + 0.005]))
    assert closed.codes().count('corrected') < 8
    last = round(end * closed.frequency) - math.ceil(max(1.0, 2.0 * share))
    if shape == 'sine':
        assert abs(without.kept(last - 2, last)[0]) > 0.05
        assert np.abs(closed.kept(last - 2, last)).max() < 3e-3
    times, off = closed.off
    late = (times > (last - 2) / closed.frequency) & (times < end)
    assert np.abs(off[late]).max() < 5e-3
    # Neither on the way, where plans meet, nor after it there is more than without.
    assert np.abs(off).max() < np.abs(without.off[1]).max() + 2e-3
    assert ends[0] < max(2e-3, 0.1 * ends[1])
    # What has been handed out is not taken back.
    stamps = [x for x, _ in closed.sent]
    assert stamps == sorted(set(stamps))


def test_what_changes_on_the_way_is_corrected_and_a_stop_comes_to_rest():
    run = Run(Plant(varied()), 0.33, cycles=16, noise=1e-3)
    run.go(4.0 / run.frequency)
    run.plant.block, run.plant.solution = varied(g=0.93), None
    run.go(10.0 / run.frequency)
    assert abs(run.kept(5, 6)[0]) > 0.03
    run.go(15.0 / run.frequency)
    assert np.abs(run.kept(13, 15)).max() < 3e-3
    run.runtime.request(Stop())
    arrival = run.planner.plan.segments[-1].arrival
    run.go((arrival - run.begin) / SECOND + 0.05)
    assert np.ptp([x for t, x in run.truth if t > arrival + 2 * MS]) < 0.015 * AMPLITUDE


@pytest.mark.parametrize(('share', 'cycles'), [
    (0.33, 5), pytest.param(0.9, 16, marks=pytest.mark.slow)])
def test_a_wave_of_an_actuator_that_is_as_known_is_left_as_it_is(share, cycles):
    runs = [Run(Plant(varied()), share, cycles=cycles, noise=3e-3, feedback=x)
            for x in ('adapt', 'off')]
    sent = [run.go(run.times[-1]).sent for run in runs]
    assert sent[0] == sent[1]
