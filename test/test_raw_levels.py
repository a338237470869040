"""Levels sent unchanged: checked against limits, executed exactly, ended at rest."""

import csv
import json
import math

from hypothesis import given
from hypothesis import strategies as st
from identification_oracle import BLOCK, level_of, simulate
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest

from hmsa.identification.excitation import Bounds, excite
from hmsa.identification.measurement import read_levels
from hmsa.model.status import Code, RefusedError
from hmsa.planning import history
from hmsa.planning.history import Deviation
from hmsa.planning.planner import Options, Planner
from hmsa.planning.timeline import PlannedLevel

SECOND = 1_000_000_000
RUN_SECONDS = 300.0


def planned(levels, **options):
    """Return the plan of levels (s, T) sent at 1 s, and the planner."""
    planner = Planner(BLOCK, Options(**{'flux_density_min': -0.5, 'flux_density_max': 0.5,
                                        **options}))
    points = [(y, round(x * SECOND)) for x, y in levels]
    return planner.take(planner.draft_levels(points, None, SECOND), SECOND)


def followed(plan, end=0.3):
    """Return SciPy's stretch from the first level on."""
    levels = [x for x in plan.levels if x.stamp > 0]
    times = (np.array([x.stamp for x in levels]) - levels[0].stamp) / SECOND
    fields = np.array([x.flux_density for x in levels])
    samples = np.linspace(0.0, times[-1] + end, 4000)
    # A while without field before the first.
    return samples - times[-1] - 0.02, simulate(
        samples, np.append(0.0, times + 0.02), np.append(0.0, fields))


@pytest.mark.slow
def test_what_excite_designs_is_carried_out_to_the_letter():
    best = excite(BLOCK, Bounds(-0.1, 0.2), duration=0.5).best
    plan = planned(zip(best.level_times, best.levels, strict=True), flux_density_max=0.2)
    sent = [x for x in plan.levels if x.stamp > 0]
    assert [x.flux_density for x in sent] == best.levels.tolist()
    assert [x.stamp - sent[0].stamp for x in sent] == [
        round(x * SECOND) for x in best.level_times]
    segment, = plan.segments
    assert segment.arrival == sent[-1].stamp
    after, stretch = followed(plan)
    assert stretch[after > 0.0] == pytest.approx(1.0, abs=5e-4)


def test_levels_that_ring_get_a_move_to_rest_in_place_of_the_last():
    levels = [(0.0, 0.0), (0.01, level_of(1.3)), (0.02, level_of(1.1))]
    plan = planned(levels)
    sent = [x for x in plan.levels if x.stamp > 0]
    assert [x.flux_density for x in sent[:2]] == [y for _, y in levels[:2]]
    after, stretch = followed(plan)
    arrival = (plan.segments[0].arrival - sent[-1].stamp) / SECOND
    assert stretch[after > arrival + 1e-6] == pytest.approx(1.1, abs=1e-5)


def test_ramps_of_the_amplifier_are_part_of_the_prediction():
    plan = planned([(0.0, 0.0), (0.01, level_of(1.3)), (0.02, 0.0)], slew_limit=5.0)
    times = np.array([x.stamp for x in plan.levels if x.stamp > 0]) / SECOND
    assert np.all(np.diff(times) > 0.0)
    assert plan.levels[-1].at(plan.segments[0].arrival + SECOND // 10).stretch == pytest.approx(
        1.0, abs=1e-6)


def test_reports_of_levels_as_planned_leave_the_plan_as_it_is():
    planner = Planner(BLOCK, Options(lead_time=SECOND // 10))
    points = [(level_of(1.1 + 0.1 * (i % 2)), i * SECOND // 100) for i in range(50)]
    plan = planner.take(planner.draft_levels(points, None, SECOND), SECOND)
    for level in planner.due(SECOND + SECOND // 20):
        deviation = planner.applied(level.stamp, level.flux_density, 0)
        assert deviation == Deviation()
        assert planner.plan is plan
        assert planner.unknown(level.stamp)[0] is level
    assert not planner.awaiting


@pytest.mark.parametrize('pieces', [False, True])
def test_reports_of_many_late_levels_cost_little_and_leave_the_prediction_right(
        pieces, monkeypatch):
    if pieces:
        monkeypatch.setattr(history, '_MANY', 16)
        monkeypatch.setattr(history, '_PIECE', 7)
    late, planner = SECOND // 10, Planner(BLOCK, Options(lead_time=SECOND // 20))
    points = [(level_of(1.1 + 0.01 * (i % 3)), i * SECOND // 1000) for i in range(300)]
    planner.take(planner.draft_levels(points, None, SECOND), SECOND)
    sent = planner.due(2 * SECOND)
    predictions = []
    after = PlannedLevel.after
    monkeypatch.setattr(
        PlannedLevel, 'after', lambda self, level: predictions.append(self) or after(self, level))
    for level in sent[:100]:
        planner.applied(level.stamp + late, level.flux_density, 0)
    assert len(predictions) <= 250
    # The others have not been reported yet: they take effect in time, but in order.
    time = sent[-1].stamp + SECOND // 50
    stamps = [x.stamp + late for x in sent[:100]]
    stamps += [max(x.stamp, stamps[-1]) for x in sent[100:]]
    times = np.array([time, *stamps]) / SECOND - 1.0
    levels = np.array([x.flux_density for x in sent])
    expected = simulate(
        np.array([0.0, times[0]]), np.append(0.0, times[1:]), np.append(0.0, levels))[-1]
    assert planner.state(time).stretch == pytest.approx(expected, abs=1e-6)


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 5), st.integers(0, 9)), max_size=9))
def test_a_long_plan_is_edited_as_a_short_one(edits):
    short, pieces = tuple(range(60)), history._Pieces(history._cut(range(60)))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(history, '_PIECE', 4)
        for number, (place, removed, count) in enumerate(edits):
            start, end = (min(x, len(short)) for x in (place, place + removed))
            new = (100 * number,) * count
            short = (*short[:start], *new, *short[end:])
            pieces = pieces.edited(start, end, new)
    assert (*pieces,) == short
    assert len(pieces) == len(short)
    assert [pieces[i] for i in range(-len(short), len(short))] == [*short, *short]
    for start in range(len(short) + 1):
        assert pieces[start:start + 7] == short[start:start + 7]
        assert pieces[-start:] == short[-start:]
        assert pieces[start:] == short[start:]


@pytest.mark.parametrize(('levels', 'options', 'code', 'words'), [
    ([(0.0, 0.3)], {'flux_density_max': 0.2}, Code.FLUX_LIMIT, 'level 0 is 0.3 T'),
    ([(0.0, -0.6)], {}, Code.FLUX_LIMIT, 'expected -0.5 to 0.5 T'),
    ([(0.0, math.nan)], {}, Code.BAD_INPUT, 'level 0 is nan T'),
    ([(0.0, 0.0), (0.0, 0.1)], {}, Code.NOT_INCREASING, 'time_from_start of level 1'),
    ([(0.001, 0.0), (0.002, 0.1), (0.003, 0.0)], {'period': SECOND // 100}, Code.NOT_INCREASING,
     'within one command period'),
    ([(0.0, 50.0)], {'flux_density_max': 100.0}, Code.OUT_OF_RANGE, 'takes the stretch to'),
    ([], {}, Code.BAD_INPUT, 'no points')])
def test_levels_that_break_a_limit_are_refused(levels, options, code, words):
    with pytest.raises(RefusedError, match=words) as raised:
        planned(levels, **options)
    assert raised.value.code is code


@pytest.mark.parametrize(('words', 'message'), [
    ('', 'neither setpoints nor --levels'), ('1.1:1 --levels x.csv', 'both setpoints'),
    ('--levels x.csv', 'x.csv cannot be read')])
@pytest.mark.parametrize('name', ['send', 'run'])
def test_bad_arguments_end_with_2_and_a_sentence(
        tmp_path, monkeypatch, refusal, name, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(f'{name} {words}')


def test_a_tolerance_for_levels_is_refused(refusal):
    assert '--tolerance is given with --levels' in refusal('run --levels x.csv --tolerance 0.1')


@pytest.mark.slow
@pytest.mark.ros
def test_a_run_of_levels_has_them_in_force_and_ends_at_rest(start, tmp_path):
    file, out = tmp_path / 'levels.csv', tmp_path / 'out'
    designed = excite(BLOCK, duration=0.5).best
    with file.open('w', newline='', encoding='utf-8') as text:
        writer = csv.writer(text)
        writer.writerow(['time', 'flux_density'])
        writer.writerows(zip(designed.level_times, designed.levels, strict=True))
    # Two seconds ahead on the wall, for a busy machine.
    own = tmp_path / 'own.yaml'
    own.write_text(
        '/**:\n  ros__parameters:\n    actuator.shear_modulus: 10000.0\n'
        '/**/planner:\n  ros__parameters:\n    lead_time: 0.35\n')
    run = start.hmsa('run', '--levels', str(file), '--simulate', '--report', '--out', str(out),
                     '--json', '--params-file', str(own))
    assert run.wait(RUN_SECONDS) == 0, run.output
    result = json.loads(run.stdout)
    assert result['verdict'] == 'arrived'
    assert '<html' in (out / 'report.html').read_text()
    applied, samples = [], []
    with next((out / 'run').glob('*.mcap')).open('rb') as bag:
        reader = make_reader(bag, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            if not channel.topic.endswith(('flux_density_applied', 'joint_states')):
                continue
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            if channel.topic.endswith('applied'):
                applied.append((stamp, message.magnetic_field.z))
            else:
                samples.append((stamp, message.position[0]))
    times, levels = read_levels(file)
    changes = np.array(sorted(set(applied)))[-(len(levels) - 1):]
    # The first level is the one in force before: no change.
    assert levels[0] == 0.0
    assert changes[:, 1] == pytest.approx(levels[1:], abs=0.0)
    assert changes[:, 0] - changes[0, 0] == pytest.approx(times[1:] - times[1], abs=2e-9)
    stamps, stretch = np.array(samples).T
    assert np.max(stretch) > 1.3
    held = stretch[stamps > changes[-1, 0]]
    assert len(held) > 100
    assert held == pytest.approx(1.0, abs=1e-3)
    table = result['levels']
    assert sum(x['times'] for x in table) >= len(levels)
    largest = max(table[:-1], key=lambda x: x['greatest'])
    assert largest['greatest'] == pytest.approx(np.max(stretch), abs=1e-12)
    assert (table[-1]['flux_density'], table[-1]['mean']) == (
        0.0, pytest.approx(np.mean(held), abs=1e-6))
    assert level_of(largest['rest']) == pytest.approx(largest['flux_density'], rel=1e-9)
