"""Paths with velocities, followed, judged by SciPy's integration of the equation of motion."""

from dataclasses import replace
import json
import math
import re

from at_work import AtWork, planner
from creep_oracle import elastic, follow
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from hmsa import Actuator
from hmsa.cli import main
from hmsa.model.creep import Creep
from hmsa.model.parameters import paper_actuator
from hmsa.model.status import Code, RefusedError
from hmsa.planning.planner import Options, Planner
from hmsa_ros.runtime.records import Settings, Severity, Trajectory

SECOND = 1_000_000_000
# Units of time (s) and load (T) of the paper's block.
TIME, LOAD = 0.01 * math.sqrt(1900.0 / 1e4), 4e-7 * math.pi * 1e4 / 0.1
CREEP = ((0.1, 0.02),)
FOLLOWED = 1e-6
NAN = math.nan


def moved(levels, times, start=1.0, slew=math.inf, lag=0.0, creep=()):
    """Return stretches at times (s) under levels (s, T), with ramps and lag, by SciPy."""
    held = elastic(start)[0]
    return follow(
        [(t / TIME, x / LOAD) for t, x in levels], times / TIME,
        Creep(tuple(x for x, _ in creep), tuple(x / TIME for _, x in creep)), slew * TIME / LOAD,
        lag / TIME, start=(start, 0.0), output=held)[:, 0]


def dense(duration=0.1, count=41, goal=1.4, *, accelerations=False):
    """Return times in s and points of a smooth path as sent by MoveIt, and its knots."""
    s = np.linspace(0.0, 1.0, count)
    rows = np.array([
        1.0 + (goal - 1.0) * (10.0 * s ** 3 - 15.0 * s ** 4 + 6.0 * s ** 5),
        (goal - 1.0) / duration * (30.0 * s ** 2 - 60.0 * s ** 3 + 30.0 * s ** 4),
        (goal - 1.0) / duration ** 2 * (60.0 * s - 180.0 * s ** 2 + 120.0 * s ** 3)])
    if not accelerations:
        rows[2] = NAN
    times = np.round(duration * s * SECOND).astype(int).tolist()
    return list(zip(map(tuple, rows.T.tolist()), times, strict=True))


def drafted(points, stamp=None, actuator=None, planner=None, **options):
    """Return the draft of a path that begins at 1 s, and its planner."""
    planner = planner or Planner(actuator or paper_actuator(), Options(**{
        'flux_density_min': -0.5, 'flux_density_max': 0.5, 'lead_time': 0, **options}))
    return planner.draft_path(points, stamp, SECOND), planner


def sent(draft):
    """Return the levels (s, T) of a draft, from its begin on."""
    return [((x.stamp - draft.begin) / SECOND, x.flux_density) for x in draft.levels]


def hermite(points):
    """Return the cubic through points, as in a joint_trajectory_controller."""
    return CubicHermiteSpline(
        [t / SECOND for _, t in points], [x[0] for x, _ in points], [x[1] for x, _ in points])


def off(draft, path, end, goal, **coil):
    """Return the largest deviations of SciPy's motion from a path, and from its goal later."""
    times = np.linspace(0.0, end + 0.05, 4001)
    away = np.abs(moved(sent(draft), times, **coil) - np.where(
        times < end, path(np.minimum(times, end)), goal))
    return away[times <= end].max(), away[times > end + 1e-3].max()


@pytest.mark.parametrize(('options', 'coil'), [
    ({}, {}),
    ({'slew_limit': 30.0}, {'slew': 30.0}),
    ({'coil_time_constant': 1e-3}, {'lag': 1e-3}),
    ({'slew_limit': 30.0, 'coil_time_constant': 1e-3}, {'slew': 30.0, 'lag': 1e-3}),
    ({'period': 100_000}, {}),
    ({'slew_limit': 30.0, 'creep_tolerance': 1e-6}, {'slew': 30.0, 'creep': CREEP}),
], ids=['steps', 'ramps', 'lag', 'ramps and lag', 'grid', 'creep'])
def test_a_dense_path_is_followed_to_a_millionth_of_its_range(options, coil):
    block = paper_actuator()
    if 'creep' in coil:
        block = replace(block, creep=Creep(*map(tuple, zip(*CREEP, strict=True))))
    points = dense()
    draft, _ = drafted(points, actuator=block, **options)
    segment, = draft.segments
    assert (segment.code, segment.reason, segment.warns) == (Code.PATH, '', False)
    along, after = off(draft, hermite(points), 0.1, 1.4, **coil)
    assert along < FOLLOWED * 0.4
    assert after < FOLLOWED * 0.4
    if 'period' in options:
        assert all((x.stamp - draft.begin) % options['period'] == 0 for x in draft.levels)


def test_accelerations_make_it_a_spline_of_degree_five():
    points = dense(count=4, accelerations=True)
    draft, _ = drafted(points)
    s = np.linspace(0.0, 0.1, 500)
    u = s / 0.1
    wanted = 1.0 + 0.4 * (10.0 * u ** 3 - 15.0 * u ** 4 + 6.0 * u ** 5)
    assert np.abs(moved(sent(draft), s) - wanted).max() < FOLLOWED * 0.4
    # With the cubic through four points it would be another path.
    assert np.abs(hermite(points)(s) - wanted).max() > 1e-3


@pytest.mark.parametrize(('options', 'coil', 'words'), [
    ({'flux_density_min': 0.0, 'flux_density_max': 0.123}, {}, 'flux densities of 0 T to 0.123 T'),
    ({'slew_limit': 20.0}, {'slew': 20.0}, 'ramps of 20 T/s'),
    ({'period': 2_000_000}, {}, 'a command period of 0.002 s')])
def test_the_verdict_names_the_largest_deviation_where_a_limit_binds(options, coil, words):
    points = dense(duration=0.005)
    draft, _ = drafted(points, **options)
    segment = draft.segments[0]
    assert segment.warns
    assert words in segment.reason
    named = float(segment.reason.split('up to ')[1].split()[0])
    arrival = (draft.segments[0].arrival - draft.begin) / SECOND
    times = np.linspace(0.0, 0.1, 8001)
    found = moved(sent(draft), times, **coil)
    away = np.abs(found - np.where(times < 0.005, hermite(points)(np.minimum(times, 0.005)), 1.4))
    assert named == pytest.approx(away.max(), rel=0.02)
    assert named > 10.0 * FOLLOWED * 0.4
    assert np.abs(found[times > arrival] - 1.4).max() < 1e-7


def test_a_path_that_began_is_joined_where_it_is():
    points = dense()
    draft, planner = drafted(points)
    planner.take(draft, SECOND)
    later = SECOND + SECOND // 25
    again = planner.draft_path(points, SECOND, later)
    assert again.begin == later
    times = np.linspace(0.0, 0.15, 3001)
    levels = [x for x in sent(draft) if x[0] < 0.04] + [(t + 0.04, x) for t, x in sent(again)]
    wanted = np.where(times < 0.1, hermite(points)(np.minimum(times, 0.1)), 1.4)
    # Where a staircase begins anew, it ripples a little more.
    assert np.abs(moved(levels, times) - wanted).max() < 5.0 * FOLLOWED * 0.4


def test_from_beside_the_path_the_actuator_goes_to_it_within_a_period():
    points = dense(goal=1.3)
    draft, planner = drafted([((1.0, 0.0, NAN), 0), ((1.02, 0.0, NAN), SECOND // 50)])
    planner.take(draft, SECOND)
    draft = planner.draft_path(points, None, 2 * SECOND)
    assert not any(x.warns for x in draft.segments)
    times = np.linspace(0.0, 0.15, 3001)
    away = np.abs(moved(sent(draft), times, start=1.02) - np.where(
        times < 0.1, hermite(points)(np.minimum(times, 0.1)), 1.3))
    assert away[times > 0.015].max() < FOLLOWED * 0.3


@pytest.mark.parametrize('make', [
    lambda planner, now: planner.draft_stop(now),
    lambda planner, now: planner.draft_setpoint(1.1, now),
    lambda planner, now: planner.draft_path(dense(goal=1.2), None, now)],
    ids=['stop', 'setpoint', 'path'])
def test_what_follows_in_the_middle_of_a_path_ends_at_rest(make):
    draft, planner = drafted(dense())
    planner.take(draft, SECOND)
    after = make(planner, SECOND + SECOND // 25)
    levels = [x for x in sent(draft) if x[0] < 0.04] + [(t + 0.04, x) for t, x in sent(after)]
    segment = after.segments[-1]
    arrival = (segment.arrival - SECOND) / SECOND
    times = arrival + np.linspace(1e-6, 0.05, 300)
    assert moved(levels, times) == pytest.approx(segment.stretch, abs=1e-8)


P = ((1.0, 0.0, NAN), 0)


@pytest.mark.parametrize(('points', 'code', 'words'), [
    ([], Code.BAD_INPUT, 'no points'), ([P], Code.SPELL_TOO_SHORT, 'time_from_start 0'),
    ([P, ((1.1, 0.3, NAN), SECOND)], Code.BAD_INPUT, 'the last point has velocity 0.3'),
    ([P, ((1.1, NAN, NAN), SECOND)], Code.BAD_INPUT, 'velocity nan'),
    ([P, ((1.1, 0.0, 0.0), SECOND)], Code.BAD_INPUT, 'in all points or in none'),
    ([P, ((1.1, 0.0, NAN), 0)], Code.NOT_INCREASING, 'time_from_start of point 1'),
    ([((1.0, 0.0, NAN), -1)], Code.NOT_INCREASING, 'at least 0 s'),
    ([P, ((math.inf, 0.0, NAN), SECOND)], Code.BAD_INPUT, 'stretch is inf'),
    ([P, ((3.0, 0.0, NAN), SECOND)], Code.OUT_OF_RANGE, 'stretch is 3'),
    ([P, ((2.0, 90.0, NAN), SECOND // 2), ((1.0, 0.0, NAN), SECOND)], Code.OUT_OF_RANGE,
     'the path goes to stretch'),
    ([P, ((1.6, 0.0, NAN), SECOND)], Code.FLUX_LIMIT, 'needs a flux density'),
    ([P, ((1.1, 0.0, NAN), 10**6 * SECOND)], Code.TOO_LONG, 'expected at most 200000')])
def test_what_is_no_path_to_rest_is_refused(points, code, words):
    with pytest.raises(RefusedError, match=words) as refused:
        drafted(points, flux_density_max=0.15)
    assert refused.value.code is code


def test_a_planner_follows_velocities_only_in_mode_path():
    points = dense()

    def rests():
        raise RefusedError(Code.BAD_INPUT, 'point 1 has velocities')
        yield

    request = Trajectory(('a',), rests(), len(points), path=[((x,), t) for x, t in points])
    for mode, severity in (('rest', Severity.ERROR), ('path', Severity.OK)):
        work = AtWork({'a': planner()}, Settings(trajectory_mode=mode, takeover_timeout=0), SECOND)
        assert work.runtime.request(request).severity in (severity, Severity.OK)
        while work.runtime.planning:
            work.tick()
        assert len(work.planner.plan.segments) == (mode == 'path')


def test_a_path_begins_soon_though_planning_takes_time():
    def clock():
        work.now += 20_000_000
        return work.now

    points = dense(duration=0.3, count=301)
    work = AtWork(
        {'a': planner(lead_time=5_000_000)},
        Settings(trajectory_mode='path', takeover_timeout=0), SECOND, clock=clock,
        steady=lambda: 0)
    work.runtime.request(Trajectory(
        ('a',), [], len(points), path=[((x,), t) for x, t in points]))
    for _ in range(1000):
        work.tick()
    assert work.planner.plan.segments[0].begin < 5 * SECOND


def test_arrays_and_files_of_a_path_are_followed_too(tmp_path, capsys, refusal):
    times = np.linspace(0.0, 0.2, 21)
    stretches = 1.1 + 0.1 * np.sin(2.0 * np.pi * (times / 0.2) ** 2 * (3.0 - 2.0 * times / 0.2))
    block = Actuator()
    plan = block.follow(times, stretches)
    here = moved(plan.levels.tolist(), times, start=1.1)
    assert here == pytest.approx(stretches, abs=FOLLOWED * 0.2)
    assert plan.simulate().report()['verdict'] == ['arrived']
    report = plan.report()
    assert report['duration'] == [pytest.approx(0.2)]
    assert report['peak field'] == [np.abs(plan.flux_densities).max()]
    block.to_yaml(tmp_path / 'block.yaml')
    rows = '\n'.join(f'{x!r},{y!r}' for x, y in zip(
        times.tolist(), stretches.tolist(), strict=True))
    (tmp_path / 'path.csv').write_text(f'time,stretch\n{rows}\n')
    assert main(['plan', '--path', str(tmp_path / 'path.csv'), '--params-file',
                 str(tmp_path / 'block.yaml'), '--out', str(tmp_path / 'levels.csv')]) == 0
    written = np.loadtxt(tmp_path / 'levels.csv', delimiter=',', skiprows=1)
    assert written == pytest.approx(plan.levels, abs=1e-12)
    head, _, row, *rest = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ['minimum', 'stretch', 'maximum']
    assert '∞' not in row
    assert any(x.split()[:2] == ['deviation', 'maximum'] for x in rest)
    assert main(['plan', '--path', str(tmp_path / 'path.csv'), '--params-file',
                 str(tmp_path / 'block.yaml'), '--json']) == 0
    found = json.loads(capsys.readouterr().out)['path']
    assert (found['duration'], found['levels']) == (pytest.approx(0.2), len(plan.levels))
    fine = np.linspace(0.0, 0.2, 20001)
    course = 1.1 + 0.1 * np.sin(2.0 * np.pi * (fine / 0.2) ** 2 * (3.0 - 2.0 * fine / 0.2))
    assert (found['low'], found['high']) == (
        pytest.approx(course.min(), abs=1e-4), pytest.approx(course.max(), abs=1e-4))
    assert found['peak_rate'] == pytest.approx(np.abs(np.gradient(course, fine)).max(), rel=2e-3)
    assert found['peak_flux_density_rate'] == report['peak field rate'][0]
    assert found['peak_flux_density'] == np.abs(plan.flux_densities).max()
    assert 0.0 < found['deviation'] < FOLLOWED * 0.2
    weak = Actuator(flux_density_limits=0.9 * found['peak_flux_density'])
    weak.to_yaml(tmp_path / 'weak.yaml')
    assert main(['plan', '--path', str(tmp_path / 'path.csv'), '--params-file',
                 str(tmp_path / 'weak.yaml')]) == 0
    _, _, row, *rest = capsys.readouterr().out.splitlines()
    leaves = float(re.search(r'leaves the path by up to (\S+)', ' '.join(rest))[1])
    assert float(row.split()[-1]) == pytest.approx(leaves, rel=0.05)
    assert '--path CSV with --params-file' in refusal('plan --path', tmp_path / 'path.csv')


def test_times_in_ms_are_named_as_the_reason_for_too_many_levels(tmp_path, capsys):
    times = np.linspace(0.0, 800.0, 81)
    stretches = 1.0 + 0.1 * np.sin(np.pi * times / 800.0) ** 2
    reason = r'levels: .*points are 10 s, 894 natural periods apart: check that its times are in s'
    with pytest.raises(RefusedError, match=reason):
        Actuator().follow(times, stretches)
    Actuator().to_yaml(tmp_path / 'block.yaml')
    for unit, status in (('', 2), (' [ms]', 0)):
        (tmp_path / 'path.csv').write_text(f'time{unit},stretch\n' + ''.join(
            f'{x:g},{y!r}\n' for x, y in zip(times, stretches.tolist(), strict=True)))
        assert main(['plan', '--path', str(tmp_path / 'path.csv'), '--params-file',
                     str(tmp_path / 'block.yaml')]) == status
        err = capsys.readouterr().err
        assert ('write "time [ms]" in the header of the CSV' in err) is (status == 2)
    # A path that is too long for another reason is told that one.
    dense = np.arange(0.0, 1000.0, 0.005)
    with pytest.raises(RefusedError, match='at most 200000; send it in parts'):
        Actuator().follow(dense, 1.0 + 0.1 * np.sin(np.pi * dense / dense[-1]) ** 2)
