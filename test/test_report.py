"""The report: results against the contents of the bag, in a self-contained page."""

import csv
from dataclasses import asdict, replace
from functools import cache
from html.parser import HTMLParser
import json
import math
import re
from shutil import copytree
import subprocess
import sys
from types import MappingProxyType

from beam_oracle import silicone
from extras import needs
import numpy as np
import pytest
from scipy.io import loadmat
from test_package_imports import BLOCKED, ROS

import hmsa
from hmsa.bag.definitions import message_definition
from hmsa.bag.writer import BagTopic, BagWriter
from hmsa.cli import main
from hmsa.errors import BadInputError
from hmsa.identification.measurement import recording_of
from hmsa.interfaces.actuator import parameters_of
from hmsa.interfaces.diagnostics import Outcome
from hmsa.interfaces.parameters import ACTUATOR_FIELDS
from hmsa.judge.records import Tolerances
from hmsa.model.creep import Creep
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import ActuatorSimulation, residual_vibration, simulate
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.planning.planner import Options, Planner
from hmsa.report.charts import MOST_PANELS
from hmsa.report.comparison import Part
from hmsa.report.evaluation import (
    evaluate,
    findings_of,
    judged_from,
    level_results,
    plan_points,
)
from hmsa.report.figures import BUCKETS, decimate
from hmsa.report.page import page
from hmsa.report.picture import draw
from hmsa.runs.bags import read_run, read_runs
from hmsa.runs.record import described, in_force, RecordedLevel, without_repeats
from hmsa.runs.topics import APPLIED, COMMAND, JOINT_STATES, OUTCOMES, PLAN, STATUS, TYPES
from hmsa.runs.verify import verify
from hmsa.table import percent

rosbag2, typesys = needs('rosbags.rosbag2'), needs('rosbags.typesys')
STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
# Of bags that are written with such a count; no recorder has lost any.
pytestmark = pytest.mark.filterwarnings(
    'ignore:.*its recorder lost 2 of /flux_density_:hmsa.errors.MissingWarning')
ACTUATOR = paper_actuator()
UNIT = ACTUATOR.time_unit
SEQUENCE = ((1.1, 10.0), (1.2, 10.0), (1.4, 10.0))
START = 2 * NANOSECONDS
PERIOD = 100_000
LEAD = 5_000_000
REACHED = [1.1, 1.2, 1.4]
# Of a clock of another kind.
AHEAD = 1_700_000_000 * NANOSECONDS
# What the integration leaves of a motion that has come to rest, as a share of the step.
ROUNDING = 1e-6
SAME = 1e-9
# Of the page of a short run, in bytes.
LARGEST_PAGE = 1_000_000


def stamp(time):
    return STORE.types['builtin_interfaces/msg/Time'](
        sec=time // NANOSECONDS, nanosec=time % NANOSECONDS)


def header(time):
    return STORE.types['std_msgs/msg/Header'](stamp=stamp(time), frame_id='coil')


def joint_state(time, stretch, rate, flux_density, names=('actuator',)):
    return STORE.types[TYPES[JOINT_STATES]](
        header=header(time), name=list(names), position=np.atleast_1d(stretch).astype(float),
        velocity=np.atleast_1d(rate).astype(float),
        effort=np.atleast_1d(flux_density).astype(float))


def command(time, value, x=0.0):
    return STORE.types[TYPES[COMMAND]](
        header=header(time),
        magnetic_field=STORE.types['geometry_msgs/msg/Vector3'](x=x, y=0.0, z=value),
        magnetic_field_covariance=np.zeros(9))


# Not along the coil.
NO_COMMAND = START, '/flux_density_command', TYPES[COMMAND], command(START, 1.0, 5.0)


def trajectory(time, points):
    """Return a trajectory of (time from start, position[, velocity, effort])."""
    return STORE.types[TYPES[PLAN]](
        header=header(time), joint_names=['actuator'], points=[
            STORE.types['trajectory_msgs/msg/JointTrajectoryPoint'](
                positions=np.array(values[:1], dtype=float),
                velocities=np.array(values[1:2], dtype=float), accelerations=np.zeros(0),
                effort=np.array(values[2:], dtype=float),
                time_from_start=STORE.types['builtin_interfaces/msg/Duration'](
                    sec=after // NANOSECONDS, nanosec=after % NANOSECONDS))
            for after, *values in points])


def diagnostic(level, message, values, joint='actuator'):
    value = STORE.types['diagnostic_msgs/msg/KeyValue']
    return STORE.types[TYPES[STATUS]](
        level=level, name='planner', message=message, hardware_id=joint,
        values=[value(key=x, value=y) for x, y in values.items()])


def status(level, code, message, **more):
    return diagnostic(level, message, {'code': code, **more})


def outcomes(plan, actuator, *, space='', **more):
    """Return the outcomes of the setpoints of a plan, which leave the judging to the samples."""
    messages, start, count = [], plan.levels[0].stretch, len(plan.segments)
    for number, x in enumerate(plan.segments, 1):
        setpoint = described(actuator, x.stretch, start, x.since, x.until)
        told = Outcome(
            setpoint=replace(
                setpoint, number=number, count=count, arrival=x.arrival, held=number == count),
            plan=1, joint='actuator', moves=((x.begin, x.arrival),),
            decided=x.arrival or x.until, **more)
        messages.append((
            told.decided, f'{space}/{OUTCOMES}', TYPES[OUTCOMES],
            diagnostic(0, told.message, told.to_texts())))
        start = x.stretch
    return messages


def parameters(**nodes):
    """Return the recorded parameters of the nodes' actuators."""
    return {
        f'{node}.{name}': json.dumps(value) for node, actuator in nodes.items()
        for name, value in {
            'use_sim_time': False,
            **{f'actuator.{x}': getattr(actuator, x) for x in ACTUATOR_FIELDS}}.items()}


KNOWN = parameters(planner=ACTUATOR, plant=ACTUATOR)


@cache
def of_the_paper():
    """Return the messages of the paper's sequence, which must not be modified."""
    return tuple(fresh())


def simulated(*sequence, **options):
    """Return the messages of a run."""
    return fresh(*sequence, **options) if sequence or options else [*of_the_paper()]


def fresh(
        sequence=SEQUENCE, *, space='', actuator=ACTUATOR, plant=None, period=PERIOD,
        shaper='two_step', slew=0.0, lag=0.0, noise=0.0, extra=0.0, creep=None, path=()):
    """Return the messages of a run: (log time, topic, type, message); a path if one is given."""
    planner = Planner(replace(actuator, creep=creep or Creep()), Options(
        shaper=shaper, lead_time=LEAD, slew_limit=slew or math.inf, coil_time_constant=lag,
        flux_density_min=-0.5,
        flux_density_max=0.5))
    simulation = ActuatorSimulation(
        plant or actuator, time=START, slew_limit=slew or math.inf,
        coil_time_constant=lag, creep=creep)
    ends = np.cumsum([
        round(span * actuator.time_unit * NANOSECONDS) for _, span in sequence]).tolist()
    points = [(x, end) for (x, _), end in zip(sequence, ends, strict=True)]
    asked = [(end, x) for x, end in points]
    if path:
        ends, asked = [path[-1][1]], [(end, x, rate) for (x, rate, _), end in path]
        plan = planner.take(planner.draft_path(path, None, START), START)
    else:
        plan = planner.request(points, None, START)
    levels = [x for x in plan.levels if x.stamp >= 0]
    random = np.random.default_rng(1)
    messages = [
        (START, f'{space}/planner/joint_trajectory', TYPES[PLAN],
         trajectory(0, asked)),
        (START, f'{space}/planner/plan', TYPES[PLAN], trajectory(levels[0].stamp, [
            (x.stamp - levels[0].stamp, x.stretch, x.rate, x.flux_density) for x in levels])),
        (START, f'{space}/planner/status', TYPES[STATUS],
         status(0, 'accepted', 'accepted', request='coil'))]
    for level in levels:
        messages.append((
            level.stamp - LEAD, f'{space}/flux_density_command', TYPES[COMMAND],
            command(level.stamp, level.flux_density)))
        simulation.command(level.stamp, level.flux_density)
    last = START + LEAD + ends[-1] + round(extra * NANOSECONDS)
    for time in range(START, last + period, period):
        simulation.advance(time)
        stretch = simulation.stretch + noise * random.standard_normal()
        messages.append((time, f'{space}/joint_states', TYPES[JOINT_STATES], joint_state(
            time, stretch, simulation.rate, simulation.flux_density)))
    return messages + outcomes(plan, actuator, space=space)


def payload(message, kind):
    """Return a message in its stored form; bytes are stored unchanged."""
    return message if isinstance(message, bytes) else bytes(STORE.serialize_cdr(message, kind))


def write(
        folder, messages, *, chunk_size=2**20, definitions=(), published=MappingProxyType({}),
        **custom_data):
    """
    Write a bag as this package's recorder does, except for definitions of some types.

    Messages are published when they are recorded, or at other given times.
    """
    with BagWriter(folder, custom_data=custom_data, chunk_size=chunk_size) as writer:
        numbers = {}
        for _, topic, kind, _ in messages:
            if topic not in numbers:
                encoding, text = message_definition(kind)
                text = dict(definitions).get(kind, text)
                numbers[topic] = writer.add_topic(BagTopic(topic, kind, text, encoding))
        writer.write(
            (numbers[topic], time, published.get(time, time), i, payload(message, kind))
            for i, (time, topic, kind, message) in enumerate(
                sorted(messages, key=lambda x: x[0])))
    return folder


def without(messages, *roles):
    return [x for x in messages if not x[1].endswith(roles)]


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return the bag of the paper's sequence."""
    lost = {'/joint_states': 0, '/flux_density_command': 2}
    return write(
        tmp_path_factory.mktemp('report') / 'run', simulated(), **KNOWN, lost=json.dumps(lost))


@pytest.fixture(scope='module')
def short(tmp_path_factory):
    """Return the bag of the first move alone."""
    return write(tmp_path_factory.mktemp('short') / 'bag', simulated(((1.1, 10.0),)), **KNOWN)


def parts_of(*bags, **options):
    runs = [run for bag in bags for run in read_runs(bag, **options)]
    return [Part.of(run) for run in runs]


def one(folder, messages, **custom_data):
    """Write a bag, and return its evaluated run."""
    part, = parts_of(write(folder, messages, **custom_data))
    return part


@pytest.fixture
def part_of(tmp_path):
    """Return a function that evaluates messages, by default of a block with known parameters."""
    return lambda messages, **custom_data: one(
        tmp_path / 'bag', messages, **custom_data or KNOWN)


@pytest.fixture(scope='module')
def paper(bag):
    """Return the evaluated run of the paper's sequence."""
    return parts_of(bag)[0]


@pytest.fixture(scope='module')
def stiffer(tmp_path_factory):
    """Return the bag of a block that is 10 % stiffer than planned for."""
    plant = replace(ACTUATOR, shear_modulus=1.1 * ACTUATOR.shear_modulus)
    return write(tmp_path_factory.mktemp('report') / 'stiffer', simulated(plant=plant),
                 **parameters(planner=ACTUATOR, plant=plant))


def resampled(messages, change):
    """Return messages with other samples: of time and sample to what `joint_state` takes."""
    return [x if x[1] != '/joint_states' else (*x[:3], joint_state(*change(x[0], x[3])))
            for x in messages]


def targets(part):
    return [x.stretch for x in part.evaluation.results]


def words_of(*parts):
    return ' '.join(Page(page(parts)).words)


def test_a_path_is_one_setpoint_which_is_judged_from_its_end_on(part_of):
    end = 40_000_000
    path = [((1.0 + 0.2 * x * x * (3.0 - 2.0 * x), 1.2 * x * (1.0 - x) / 0.04, math.nan),
             round(x * end)) for x in np.linspace(0.0, 1.0, 9).tolist()]
    finding, = part_of(simulated(path=path, extra=0.1)).evaluation.findings
    assert (str(finding.verdict), finding.setpoint.target) == ('arrived', 1.2)
    assert finding.setpoint.arrival == START + LEAD + end


@pytest.mark.parametrize(('moved', 'settled', 'arrived', 'from_new'), [
    (None, 0.09, True, False),
    # Arrived as requested, before the plan was corrected; then only as corrected, or not.
    (0.1, 0.001, True, False), (0.1, 0.09, True, True), (0.1, math.inf, False, True),
    # A corrected plan that is faster.
    (-1e-4, 0.001, True, False)])
def test_a_corrected_setpoint_is_judged_from_the_plan_that_was_followed(
        paper, moved, settled, arrived, from_new):
    finding = paper.evaluation.findings[0]
    asked = finding.setpoint
    at = None if moved is None else asked.arrival + round(moved * 1e9)
    finding = replace(
        finding, setpoint=replace(asked, moved=at),
        verdict=Code.ARRIVED if arrived else Code.VIBRATING)
    begin = at if from_new else asked.arrival
    assert judged_from(finding, settled) == (begin - asked.begins) / NANOSECONDS


class Page(HTMLParser):
    """The elements of a page."""

    def __init__(self, text):
        super().__init__()
        self.text = text
        self.tags, self.tables, self.scripts, self.ids, self.words = [], {}, [], [], []
        self._stack, self._row = [], None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs))
        self._stack.append(tag)
        if 'id' in attrs:
            self.ids.append(attrs['id'])
        if tag == 'table':
            self.tables[attrs['id']] = []
            self._row = self.tables[attrs['id']]
        elif tag == 'tr':
            self._row.append([])
        elif tag in ('td', 'th'):
            self._row[-1].append([attrs.get('data-value'), ''])
        elif tag == 'script':
            self.scripts.append([attrs, ''])

    def handle_endtag(self, tag):
        if tag in self._stack:
            while self._stack.pop() != tag:
                pass

    def handle_data(self, data):
        if self._stack and self._stack[-1] in ('td', 'th'):
            self._row[-1][-1][1] += data
        elif self._stack and self._stack[-1] == 'script':
            self.scripts[-1][1] += data
        elif self._stack and self._stack[-1] != 'style':
            self.words.append(data)

    def table(self, key):
        """Return a table's rows as dicts of (full value or None, text shown)."""
        header, *rows = self.tables[key]
        return [dict(zip([x for _, x in header], map(tuple, row), strict=True)) for row in rows]

    def value(self, key, row, column):
        return float(self.table(key)[row][column][0])

    @property
    def figures(self):
        data, = (x for attrs, x in self.scripts if attrs.get('id') == 'report-data')
        return {x['key']: x for x in json.loads(data)}

    def curve(self, figure, name):
        found, = (x for panel in self.figures[figure]['panels'] for x in panel['curves']
                  if x['name'] == name)
        return found


@pytest.fixture(scope='module')
def report(paper):
    """Return the page of the paper's sequence."""
    return Page(page([paper]))


# What is read and measured -------------------------------------------------------------------

def test_samples_and_commands_are_read_as_another_reader_reads_them(paper):
    run, messages = paper.run, simulated()
    samples = [x for _, topic, _, x in messages if topic == '/joint_states']
    assert run.stretch.tolist() == [x.position[0] for x in samples]
    assert run.rate.tolist() == [x.velocity[0] for x in samples]
    assert run.flux_density.tolist() == [x.effort[0] for x in samples]
    assert np.all(np.diff(run.time) == PERIOD)
    assert run.time[0] == START
    commands = [x for _, topic, _, x in messages if topic == '/flux_density_command']
    assert [x.flux_density for x in run.commands] == [x.magnetic_field.z for x in commands]
    assert [x.stamp - x.sent for x in run.commands] == [LEAD] * 6
    assert run.parameters_known
    assert [x.partition(':')[0] for x in run.notes] == [
        'The recorder lost 2 of /flux_density_command']


def test_setpoints_are_found_and_measured_as_the_demo_measures_them(paper):
    part, result = paper, paper.evaluation.results
    assert targets(part) == REACHED
    # Known values of the paper's first and third move.
    assert result[0].tau_p == pytest.approx(1.315749737, abs=1e-6)
    assert result[2].b_p ** 2 == pytest.approx(0.778278436, abs=1e-6)
    assert result[0].b_1 ** 2 == pytest.approx(0.275104307, abs=1e-6)
    assert [x.begin for x in result] == pytest.approx([0.0, 10 * UNIT, 20 * UNIT], abs=2e-9)
    assert result[-1].end == pytest.approx(30 * UNIT, abs=5e-9)
    previous = 1.0
    for x in result:
        # By definition, without what the report is made of.
        time = (part.run.time - part.run.commands[0].stamp) / NANOSECONDS
        assert x.residual == residual_vibration(
            time, part.run.stretch, arrival=x.rests, end=x.end, step=x.stretch - previous)
        assert x.residual < ROUNDING
        assert 1.0 < x.residual_unshaped < 1.5
        previous = x.stretch


@pytest.mark.parametrize('shaper', ['robust', 'minimax', 'minimum_time', 'smooth', 'zv', 'step'])
def test_setpoints_are_found_whatever_the_shaper(part_of, shaper):
    part = part_of(simulated(shaper=shaper))
    assert targets(part) == REACHED
    residual = max(x.residual for x in part.evaluation.results)
    if shaper in ('robust', 'minimum_time', 'smooth'):
        assert residual < ROUNDING
    else:
        assert residual > 1e-3
    if shaper == 'minimax':
        assert residual < 0.02


def test_plain_steps_and_predictions_are_those_of_a_creeping_block_and_its_ramps(part_of):
    creep = Creep((0.1, 0.05), (2.0 * UNIT, 0.1))
    told = {f'{node}.viscoelastic.{name}': json.dumps(list(values)) for node in (
        'planner', 'plant') for name, values in (('ratio', creep.ratios), ('time', creep.times))}
    part = part_of(simulated(creep=creep), **KNOWN, **told)
    found, run = part.evaluation, part.run
    known = np.isfinite(found.planned.at(found.time).stretch)
    assert np.max(np.abs(found.planned.at(found.time).stretch - run.stretch)[known]) < 1e-6
    # The example block's steps, by the plant itself.
    steps = ActuatorSimulation(ACTUATOR, time=found.zero, creep=creep)
    for move in found.moves:
        steps.command(move.begin, move.flux_densities[-1])
    worst = 0.0
    plain = found.plain.at(found.time).stretch
    for time, stretch in zip(run.time.tolist(), plain.tolist(), strict=True):
        if time > found.zero:
            steps.advance(time)
            worst = max(worst, abs(steps.stretch - stretch))
    assert worst < 1e-6


def test_the_page_of_a_beam_speaks_of_its_deflection(part_of):
    beam = silicone()
    told = {f'{node}.{name}': json.dumps(value) for node in ('planner', 'plant')
            for name, value in {'use_sim_time': False, **parameters_of(beam)}.items()}
    part = part_of(simulated(
        [(0.3, 25.0), (-0.2, 25.0)], actuator=beam, period=5_000_000), **told)
    assert targets(part) == [0.3, -0.2]
    assert max(x.residual for x in part.evaluation.results) < 1e-6
    shown, _, _ = page([part]).partition('All parameters that were recorded')
    shown = re.sub(r'<script.*?</script>|/stretch', '', shown, flags=re.DOTALL)
    for words in ('the deflection (simulated)', 'target u [1]', 'least deflection',
                  'critical zeta about deflection 0'):
        assert words in shown
    assert not re.search('stretch|J_lim|chain limit', shown)


def test_without_outcomes_setpoints_are_told_by_the_levels_that_last(part_of, paper):
    part = part_of(without(simulated(), 'joint_trajectory', 'status', 'plan', 'outcomes'))
    assert targets(part) == pytest.approx(REACHED, abs=SAME)
    assert [x.arrival for x in part.evaluation.results] == [
        x.arrival for x in paper.evaluation.results]
    assert any('recorded without outcomes' in x for x in part.run.notes)
    assert part.evaluation.plan == ()
    assert 'plan-section' not in Page(page([part])).ids


def test_unknown_parameters_are_said_to_be_unknown_and_outcomes_still_tell_the_setpoints(
        tmp_path):
    other = paper_actuator(NondimensionalParameters(zeta=0.1, j_lim=8.0))
    part = one(tmp_path / 'bag', simulated())
    assert not part.run.parameters_known
    assert 'unknown' in words_of(part)
    assert any('--params' in x for x in part.run.notes)
    run = replace(part.run, planner=other, plant=other)
    # By an equilibrium of the wrong block no level holds what was asked for.
    assert [x.stretch for x in evaluate(run).results] == REACHED


def test_plain_steps_are_simulated_with_the_plant_that_was_recorded(stiffer):
    part, = parts_of(stiffer)
    found, plant = part.evaluation, part.run.plant
    assert max(x.residual for x in found.results) > 0.01
    assert any('different parameters' in x for x in part.run.notes)
    time = found.time[found.time >= 0.0]
    loads = [x.flux_density / plant.flux_density_unit for x in part.run.commands[1::2]]
    stretch, _ = simulate(
        [x.begin / plant.time_unit for x in found.results], loads, time / plant.time_unit,
        plant.nondimensional)
    assert np.max(np.abs(found.plain.at(time).stretch - stretch)) < SAME


def test_plain_steps_are_measured_between_samples_that_are_too_few(tmp_path):
    small = replace(
        ACTUATOR, half_length=1.0e-2 / 9.35, half_thickness=1.0e-2 / 9.35,
        damping_coefficient=1e-3)
    finely, coarsely = (
        one(tmp_path / f'{period}', simulated(
            ((1.4, 100.0),), actuator=small, period=period), **parameters(
                planner=small, plant=small)) for period in (10_000, 1_000_000))
    assert 1.0 / coarsely.run.plant.period == pytest.approx(836.0, rel=0.01)
    expected, = (x.residual_unshaped for x in finely.evaluation.results)
    found, = (x.residual_unshaped for x in coarsely.evaluation.results)
    assert expected > 1.5
    assert found == pytest.approx(expected, rel=5e-3)
    words = words_of(coarsely)
    assert '1.2 samples a period of the actuator' in words
    assert 'raise publish_rate' in words
    assert 'samples a period' not in words_of(finely)


def test_a_block_that_did_not_move_has_no_residual(part_of):
    part = part_of(resampled(simulated(), lambda time, _: (time, 1.0, 0.0, 0.0)))
    assert [(x.moved, math.isnan(x.residual)) for x in part.evaluation.results] == [
        (False, True)] * 3
    report = Page(page([part]))
    words = ' '.join(report.words)
    assert 'did not move largest residual' in ' '.join(words.split())
    assert 'residual 0 %' not in words
    assert [x['residual [%]'][1] for x in report.table('setpoint-table')] == ['did not move'] * 3


@pytest.mark.parametrize(('slew', 'lag'), [(0.0, 0.0), (20.0, 0.0), (0.0, 5e-4), (60.0, 5e-4)])
def test_the_plan_predicts_a_plant_that_is_as_planned(part_of, slew, lag):
    known = {f'{node}.{name}': str(value) for node in ('planner', 'plant') for name, value in (
        ('slew_limit', slew), ('coil_time_constant', lag)) if value}
    part = part_of(simulated(slew=slew, lag=lag), **KNOWN, **known)
    difference = part.run.stretch - part.evaluation.planned.at(part.evaluation.time).stretch
    assert np.count_nonzero(np.isfinite(difference)) > 1000
    assert np.nanmax(np.abs(difference)) < SAME
    points = plan_points(part.run, part.evaluation)
    assert [x.planned for x in points] == [x.commanded for x in points]
    assert max(x.deviation for x in points) < SAME
    assert max(x.residual for x in part.evaluation.results) < ROUNDING


def test_a_later_command_supersedes_those_stamped_at_or_after_it():
    first = [RecordedLevel(10, 1.0, 0), RecordedLevel(20, 2.0, 0), RecordedLevel(30, 3.0, 0)]
    assert [(x.stamp, x.flux_density) for x in in_force(
        [*([x] for x in first), [RecordedLevel(20, 4.0, 5)]])] == [(10, 1.0), (20, 4.0)]
    assert [x.stamp for x in in_force([
        first, [RecordedLevel(25, 4.0, 5), RecordedLevel(40, 5.0, 5)]])] == [10, 20, 25, 40]


def test_timing_tells_lead_lateness_delay_and_gaps(part_of):
    changed = []
    for i, (time, topic, kind, message) in enumerate(simulated()):
        late = 3_000_000 if topic == '/joint_states' else 0
        if topic == '/flux_density_command' and i == 4:
            late = LEAD + 2_000_000
        if topic != '/joint_states' or not 500 <= i < 510:
            changed.append((time + late, topic, kind, message))
    part = part_of(changed)
    assert part.timing.late == 1
    assert sorted(part.timing.lead) == pytest.approx([-0.002] + [0.005] * 5)
    assert part.timing.delay == pytest.approx(np.full(len(part.run.time), 0.003))
    assert part.timing.missing == 10
    report = Page(page([part]))
    row, = (x for x in report.table('timing-table') if x['quantity'][1] == 'command lead')
    assert float(row['least [ms]'][0]) == pytest.approx(-2.0)
    assert '6 (1 late)' in ' '.join(report.words)


def test_a_recorder_on_another_clock_leaves_lead_and_delay_open(part_of):
    part = part_of([(time + AHEAD, *rest) for time, *rest in simulated()])
    assert len(part.timing.lead) == len(part.timing.delay) == 0
    assert targets(part) == REACHED
    assert 'clock of the recorder differs' in words_of(part)


def test_commands_on_another_clock_than_the_samples_hold_up_no_report(part_of):
    part = part_of(resampled(simulated(), lambda time, x: (
        time + AHEAD, x.position, x.velocity, x.effort)))
    assert not np.isfinite(part.evaluation.plain.stretch).any()
    assert not np.isfinite(part.evaluation.planned.stretch).any()
    page([part])


def applied(messages, late=0, space=''):
    """Return a plant's reports on commands: the initial level and each change."""
    topic, kind = f'{space}/{APPLIED}', TYPES[APPLIED]
    return [(START, topic, kind, command(START, 0.0))] + [
        (time + LEAD, topic, kind, command(time + LEAD + late, x.magnetic_field.z))
        for time, where, _, x in messages if where == f'{space}/{COMMAND}']


def test_commands_that_are_repeated_change_nothing_but_their_number(part_of, paper):
    messages = simulated()
    commands = [x for x in messages if x[1].endswith(COMMAND)]
    repeats = []
    for time in range(START + 1_000_000, START + 120_000_000, 10_000_000):
        due = [x for x in commands if x[0] <= time]
        if due:
            repeats.append((time, *due[-1][1:3], command(
                time + LEAD, due[-1][3].magnetic_field.z)))
    assert len(repeats) > 8
    part = part_of(messages + repeats)
    # As text: NaN, where nothing is predicted, is not equal to itself.
    assert str(part.evaluation.levels) == str(paper.evaluation.levels)
    assert part.evaluation.results == paper.evaluation.results
    assert part.timing.repeats == len(repeats)
    assert np.array_equal(part.timing.lead, paper.timing.lead)
    report = Page(page([part]))
    assert len(set(report.curve('response', 'command')['y'])) == 7
    assert f'{len(repeats)} repeated commands not shown' in ' '.join(report.words)


def test_what_replaces_later_levels_is_no_repeat():
    first = [RecordedLevel(10, 1.0, 0), RecordedLevel(20, 2.0, 0)]
    same, other = RecordedLevel(15, 1.0, 5), RecordedLevel(12, 1.0, 6)
    assert without_repeats([*first, same]) == ((*first, same), 0)
    assert [x.stamp for x in in_force((x,) for x in without_repeats([*first, same])[0])] == [
        10, 15]
    assert without_repeats([first[0], other, first[1]]) == (tuple(first), 1)
    assert without_repeats([]) == ((), 0)


@pytest.mark.parametrize('late', [0, 3_000_000])
def test_lateness_is_told_by_what_took_effect(part_of, late):
    messages = simulated()
    part = part_of(messages + applied(messages, late))
    assert part.timing.lateness == pytest.approx([late / NANOSECONDS] * 6)
    assert part.timing.late == (6 if late else 0)
    assert part.timing.unapplied == 0
    report = Page(page([part]))
    row, = (x for x in report.table('timing-table')
            if x['quantity'][1] == 'lateness of the command')
    assert float(row['largest [ms]'][0]) == pytest.approx(late / 1e6)
    assert f'Lateness of the command: {late // 1_000_000} ms throughout.' in report.words
    assert f'6 ({6 if late else 0} late)' in ' '.join(report.words)


def test_a_change_that_never_took_effect_is_told(part_of):
    messages = simulated()
    told = applied(messages)
    del told[3]
    part = part_of(messages + told)
    assert part.timing.unapplied == 1
    assert np.isnan(part.timing.lateness).tolist() == [False] * 2 + [True] + [False] * 3
    assert '1 changes of level did not take effect' in words_of(part)


def test_a_recording_that_begins_while_the_field_is_on_is_verified(tmp_path):
    messages = simulated(period=500_000)
    begin = START + LEAD + round(15.0 * UNIT * NANOSECONDS)
    # Who subscribes late is told what has taken effect so far, from time 0 on.
    applied = [(0, 0.0), *((x.header.stamp.sec * NANOSECONDS + x.header.stamp.nanosec,
                            x.magnetic_field.z) for _, topic, _, x in messages
                           if topic.endswith('command'))]
    late = [x for x in messages if x[0] >= begin] + [
        (max(at, begin), '/flux_density_applied', TYPES[APPLIED], command(at, value))
        for at, value in applied]
    found, = verify(write(tmp_path / 'bag', late, **KNOWN))
    assert found.largest_difference < SAME
    assert found.unapplied_count == 0
    assert level_results(read_runs(tmp_path / 'bag')[0])[0].duration < 1.0


def test_levels_that_the_recorder_lost_are_those_of_the_commands(part_of):
    messages = simulated()
    reported = applied(messages, 0)
    del reported[3:5]
    part = part_of(
        messages + reported, lost=json.dumps({'/flux_density_applied': 2}), **KNOWN)
    assert [(x.stamp, x.flux_density) for x in part.run.levels] == [
        (x.stamp, x.flux_density) for x in part.run.commands]
    assert 'lost 2 of /flux_density_applied' in ' '.join(part.run.notes)
    recording, _, _ = recording_of(part.run)
    assert len(recording.levels) == len(part.run.commands) + 1


def test_the_field_of_a_driver_that_measures_none_is_what_it_applied(tmp_path):
    messages = simulated()
    part = one(tmp_path / 'bag', resampled(
        messages, lambda time, x: (time, x.position, x.velocity, [])) + applied(
            messages, 2_000_000))
    curve = Page(page([part])).curve('response', 'field in force')
    assert len(curve['y']) == 8
    assert curve['x'][1] == pytest.approx(2.0)


def of_several_joints(names, plants):
    """Return a run of several joints, with a topic for each and one for all states."""
    runs = [simulated(plant=x) for x in plants]
    messages = []
    for name, run in zip(names, runs, strict=True):
        messages += [(time, f'/{name}/{COMMAND}', kind, message)
                     for time, topic, kind, message in run if topic.endswith(COMMAND)]
    for rows in zip(*([x for x in run if x[1] == '/joint_states'] for run in runs), strict=True):
        messages.append((*rows[0][:3], joint_state(rows[0][0], *(
            [getattr(x[3], field)[0] for x in rows]
            for field in ('position', 'velocity', 'effort')), names)))
    for time, topic, kind, message in without(runs[0], 'command', 'joint_states'):
        if topic.endswith(('plan', 'trajectory')):
            message.joint_names = list(names)
            for point in message.points:
                for field in ('positions', 'velocities', 'effort'):
                    setattr(point, field, np.repeat(getattr(point, field), len(names)))
        messages.append((time, topic, kind, message))
    return messages


def test_each_joint_of_a_planner_of_several_is_a_run(tmp_path, paper):
    other = replace(ACTUATOR, density=2100.0)
    folder = write(
        tmp_path / 'bag', of_several_joints(('left', 'right'), (ACTUATOR, other)), **KNOWN,
        **{'plant.right.actuator.density': '2100.0', 'plant.left.actuator.density': 'null'})
    left, right = parts_of(folder)
    assert (left.run.label, right.run.label) == ('bag left', 'bag right')
    for ours, theirs in zip(left.evaluation.results, paper.evaluation.results, strict=True):
        assert asdict(ours) == pytest.approx(asdict(theirs), rel=1e-6, abs=1e-9)
    assert max(x.residual for x in right.evaluation.results) > 0.01
    assert (left.run.plant, right.run.plant) == (ACTUATOR, other)
    planned = left.evaluation.planned.at(left.evaluation.time).stretch
    assert np.nanmax(np.abs(left.run.stretch - planned)) < SAME
    only, = parts_of(folder, joints=['right'])
    assert only.evaluation.results == right.evaluation.results
    with pytest.raises(BadInputError, match=r'no joint up: expected one of left, right'):
        read_runs(folder, joints=['up'])


# Bags of all kinds ---------------------------------------------------------------------------

def write_with_rosbags(folder, messages, storage='MCAP'):
    """Write a bag as another program does, without node parameters."""
    with rosbag2.Writer(
            folder, version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as writer:
        connections = {}
        for time, topic, kind, message in sorted(messages, key=lambda x: x[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time, STORE.serialize_cdr(message, kind))
    return folder


def test_a_bag_without_parameters_is_verified_and_exported_with_a_parameter_file(
        tmp_path, capsys, refusal):
    folder = write_with_rosbags(tmp_path / 'bag', simulated(((1.1, 10.0),)))
    file = tmp_path / 'block.yaml'
    for value, status in ((ACTUATOR.density, 0), (2.0 * ACTUATOR.density, 1)):
        file.write_text(
            '/**:\n  ros__parameters:\n'
            + ''.join(f'    actuator.{x}: {getattr(ACTUATOR, x)!r}\n' for x in ACTUATOR_FIELDS
                      if x != 'density') + f'    actuator.density: {value!r}\n')
        assert main([
            'bag', 'verify', str(folder), '--params-file', str(file), '--json']) == status
        actuator, = json.loads(capsys.readouterr().out)['actuators']
        assert (actuator['largest_difference'] < SAME) is (status == 0)
    assert '--params-file' in refusal('bag verify', folder)
    write_with_rosbags(tmp_path / 'samples', without(simulated(((1.1, 10.0),)), 'command'))
    assert main(['bag', 'verify', str(tmp_path / 'samples'), '--params-file', str(file)]) == 1
    assert 'samples, 0 commands (0 late), largest' in capsys.readouterr().out
    assert main(['export', str(folder), '--out', str(tmp_path / 'run.csv')]) == 0
    samples, levels = (
        np.genfromtxt(tmp_path / x, delimiter=',', names=True)
        for x in ('run.csv', 'run_levels.csv'))
    run, = read_runs(folder)
    assert samples['stretch'].tolist() == run.stretch.tolist()
    assert levels['flux_density'].tolist() == [x.flux_density for x in run.commands]


@pytest.mark.parametrize('storage', ['MCAP', 'SQLITE3'])
def test_a_bag_that_rosbags_wrote_will_do(tmp_path, paper, storage):
    write_with_rosbags(tmp_path / 'bag', simulated(), storage)
    part, = parts_of(tmp_path / 'bag')
    assert part.evaluation.results == paper.evaluation.results
    assert part.run.summary.lost is None
    assert 'not counted' in words_of(part)


def test_each_namespace_of_a_bag_is_a_run(tmp_path):
    messages = simulated(space='/left') + simulated(((1.3, 10.0),), space='/right')
    runs = parts_of(write(tmp_path / 'bag', messages))
    assert [x.run.label for x in runs] == ['bag /left', 'bag /right']
    assert [targets(x) for x in runs] == [REACHED, [1.3]]
    # Both are called actuator.
    with pytest.raises(BadInputError, match='expected one; record the topics of one namespace'):
        read_run(tmp_path / 'bag', joint='actuator')


def test_the_actuator_is_found_among_other_joints(tmp_path):
    def among_others(time, message):
        names = ('wheel', 'actuator') if time % (2 * PERIOD) else ('actuator', 'arm')
        values = np.full((3, 2), 99.0)
        values[:, names.index('actuator')] = (
            message.position[0], message.velocity[0], message.effort[0])
        return time, *values, names

    folder = write(tmp_path / 'bag', resampled(without(simulated(), 'plan'), among_others))
    run, = read_runs(folder)
    assert run.stretch.tolist() == [
        x.position[0] for _, topic, _, x in simulated() if topic == '/joint_states']
    with pytest.raises(BadInputError, match=r"no joint 'leg': expected one of actuator, arm"):
        read_runs(folder, joints=['leg'])


def test_hardware_that_measures_neither_rate_nor_field_will_do(tmp_path):
    part = one(tmp_path / 'bag', resampled(
        without(simulated(noise=1e-4), 'plan', 'status'),
        lambda time, x: (time, x.position, [], [])))
    assert any('rates were not recorded' in x for x in part.run.notes)
    assert targets(part) == REACHED
    moving = (part.evaluation.time > 0.001) & (part.evaluation.time < 0.004)
    assert np.median(part.run.rate[moving]) == pytest.approx(25.0, abs=5.0)
    assert 1e-3 < part.evaluation.results[0].residual < 0.02
    assert 'NaN' not in Page(page([part])).scripts[0][1]


def test_broken_samples_and_commands_are_left_out_and_told(part_of):
    part = part_of([
        x if i != 300 else (*x[:3], joint_state(x[0], math.nan, 0.0, 0.0))
        for i, x in enumerate(simulated())] + [NO_COMMAND])
    assert len(part.run.time) == len(without(
        simulated(), 'plan', 'status', 'y', 'command', 'outcomes')) - 1
    assert len(part.run.commands) == 6
    notes = ' '.join(part.run.notes)
    assert '1 samples are not finite' in notes
    assert '1 commands are not finite or not along z' in notes


def test_garbage_among_the_messages_does_not_spoil_the_rest(part_of, paper):
    messages = simulated()
    names = {topic: kind for _, topic, kind, _ in messages}
    late = messages[-1][0] + 1
    strange = [(late, topic, kind, payload(message, kind)[:-9]) for topic, kind, message in (
        next((topic, kind, x[3]) for x in messages if x[1] == topic)
        for topic, kind in names.items())]
    strange += [(START + 10, '/joint_states', TYPES[JOINT_STATES], x) for x in (
        joint_state(-10**9 * NANOSECONDS, 1.0, 0.0, 0.0), joint_state(START + 5, 1e300, 0.0, 0.0),
        joint_state(START + 7, -1e9, 0.0, 0.0), joint_state(START + 9, 1.0, 1e300, 0.0))]
    # Long before all others, it supersedes nothing; nobody can be at these stretches.
    strange += [(START - 1, '/planner/plan', TYPES[PLAN], trajectory(START - 5, [
        (0, -1e300, 0.0, 0.0), (1, 1e-320, 0.0, 0.0)]))]
    part = part_of(messages + strange)
    assert asdict(part.evaluation.results[1]) == pytest.approx(
        asdict(paper.evaluation.results[1]), rel=1e-9, abs=1e-12)
    assert len(part.run.time) == len(paper.run.time) + 1
    assert np.max(np.abs(part.run.rate)) < 1e3
    notes = ' '.join(part.run.notes)
    # Requests are not evaluated.
    for topic in names.keys() - {'/planner/joint_trajectory'}:
        assert f'a message of topic {topic} does not decode' in notes
    assert '1 samples are stamped more than 30 days away' in notes
    assert '2 samples are not finite numbers, or beyond 1e+06' in notes
    assert '1 stretch rates were not recorded' in notes
    assert 'NaN' not in Page(page([part])).scripts[0][1]


def test_a_plan_without_a_point_is_no_plan(part_of):
    part = part_of([*without(simulated(), 'plan'), (
        START, '/planner/plan', TYPES[PLAN], trajectory(START, []))])
    assert plan_points(part.run, part.evaluation) == []
    assert Page(page([part])).ids


@pytest.mark.parametrize(('text', 'reached'), [
    ('NaN', REACHED), ('"fast"', REACHED), ('1e-320', [])])
def test_a_slew_limit_that_is_none_is_not_taken_for_one(part_of, text, reached):
    # Without outcomes, the arrival includes the ramp.
    part = part_of(without(simulated(), 'outcomes'), **KNOWN, **{'plant.slew_limit': text})
    assert targets(part) == reached
    assert Page(page([part])).ids


def of_another_definition(folder, role):
    """Write a run in which one type has another definition."""
    return write(
        folder, simulated(), definitions={TYPES[role]: 'uint8 something\n'},
        **parameters(plant=ACTUATOR))


@pytest.mark.parametrize('role', [COMMAND, PLAN, STATUS, OUTCOMES])
def test_a_type_of_another_definition_is_told(tmp_path, role):
    run, = read_runs(of_another_definition(tmp_path / 'bag', role))
    assert f'a message of topic /{role} is not as {TYPES[role]} is defined in ROS 2' in ' '.join(
        run.notes)


def test_samples_of_another_definition_are_no_run(tmp_path):
    with pytest.raises(BadInputError, match='no usable message: .*; a message of topic /joint_st'):
        read_runs(of_another_definition(tmp_path / 'bag', JOINT_STATES))


def test_a_clock_that_jumps_back_is_told(part_of):
    messages = simulated()
    part = part_of(messages + [
        (x[0] + 10 * NANOSECONDS, *x[1:]) for x in messages if x[1] == '/joint_states'][:100])
    assert np.all(np.diff(part.run.time) > 0)
    assert any('jump back' in x for x in part.run.notes)


def test_samples_with_the_timestamp_of_another_are_told(part_of):
    # Rounded to 1 ms.
    rounded = [(time, topic, kind, replace(x, header=header(time // 1_000_000 * 1_000_000))
                if topic == '/joint_states' else x) for time, topic, kind, x in simulated()]
    part = part_of(rounded)
    assert len(part.run.time) < 0.2 * part.run.left_out
    assert f'{part.run.left_out} samples have the timestamp of an' in ' '.join(part.run.notes)


@pytest.mark.parametrize('ahead', [AHEAD, -AHEAD])
def test_samples_and_levels_of_two_clocks_are_not_identified(part_of, ahead):
    run = part_of(simulated()).run
    with pytest.raises(BadInputError, match='expected timestamps of one clock'):
        recording_of(replace(run, time=run.time + ahead))


def test_a_run_without_commands_shows_the_response_alone(tmp_path):
    part = one(tmp_path / 'bag', [*without(simulated(), 'command'), NO_COMMAND])
    report = Page(page([part]))
    assert part.evaluation.results == ()
    assert 'contains no command' in ' '.join(report.words)
    assert 'arrivals' not in report.ids
    assert len(report.curve('response', 'recorded')['y']) > 100
    # No scale without a field, no entry without a curve.
    blind = replace(part.run, flux_density=np.full_like(part.run.flux_density, np.nan))
    figure = draw(tmp_path / 'run.svg', [Part.of(blind)])
    assert not len(figure.axes[0].get_yticks())
    assert [x.get_text() for y in figure.legends for x in y.get_texts()] == [
        'recorded', 'start']


def test_a_move_that_the_recording_cut_off_is_left_out(part_of):
    part = part_of([x for x in simulated() if x[0] < START + LEAD + 88_000_000])
    assert targets(part) == [1.1, 1.2]


def test_a_refused_request_is_told_with_its_reason(part_of):
    text = page([part_of([*simulated(), (
        START + 1000, '/planner/status', TYPES[STATUS],
        status(2, 'out_of_range', 'target stretch is 9 <script>'))])])
    report = Page(text)
    assert report.table('request-table')[1]['code'][1] == 'out_of_range'
    assert '<script>alert' not in text
    assert '9 &lt;script&gt;' in text


@pytest.mark.parametrize('change', [
    {'target': 'nan'}, {'begins': '9' * 400}, {'omega': '0.0'}, {'moves': '[' * 9000},
    {'verdict': 'fine'}, {'setpoint': '-1'}, {'moves': '[[1, 2, 3]]'}])
def test_an_outcome_that_no_planner_publishes_is_told_and_hides_no_setpoint(part_of, change):
    messages = simulated()
    told = next(x for x in messages if x[1].endswith('outcomes'))
    values = {x.key: x.value for x in told[3].values} | change
    part = part_of([*messages, (*told[:3], diagnostic(0, '', values))])
    assert targets(part) == REACHED
    assert sum('topic /planner/outcomes is not as' in x for x in part.run.notes) == 1


def test_the_findings_of_a_run_are_those_of_its_planner(part_of):
    messages = simulated(extra=0.1)
    begin = 2 * START
    told = {x.key: x.value for x in next(
        y[3] for y in messages if y[1].endswith('outcomes')).values}
    changes = (
        # Judged, then corrected by another outcome.
        {'verdict': 'undecided', 'samples': '3'},
        {'verdict': 'vibrating', 'samples': '40', 'vibration': '0.0125'},
        # Replaced before it was reached, and of before the recording.
        {'setpoint': '2', 'ended': 'replaced', 'until': told['end']},
        {'setpoint': '3', 'verdict': 'arrived', 'decided': str(START - 1)},
        {'setpoint': '3', 'verdict': 'arrived', 'decided': str(begin + 60 * NANOSECONDS)})
    part = part_of([*without(messages, 'outcomes'), *(
        (START + i, '/planner/outcomes', TYPES[OUTCOMES], diagnostic(0, 'it rings', {
            **told, **x})) for i, x in enumerate(changes))])
    finding, = part.evaluation.findings
    assert (str(finding.verdict), finding.message, finding.samples, finding.vibration) == (
        'vibrating', 'it rings', 40, 0.0125)
    assert finding.setpoint.percent(finding.vibration) == pytest.approx(12.5)
    assert 'ended before setpoints 2 to 3 were decided' in ' '.join(part.run.notes)
    # With other tolerances than the planner's, the samples are judged.
    found = findings_of(part.run, Tolerances(0.5, 0.5))
    assert [str(x.verdict) for x in found] == ['arrived']


def test_a_replaced_setpoint_is_measured_until_the_next_begins(part_of):
    messages = simulated()
    told = next(x for x in messages if x[1].endswith('outcomes'))
    values = {x.key: x.value for x in told[3].values}
    part = part_of([*(x for x in messages if x is not told), (
        *told[:3], diagnostic(0, '', {**values, 'ended': 'replaced', 'until': values.pop('end'),
                                      'verdict': 'arrived', 'samples': '9'}))])
    assert targets(part) == REACHED
    assert max(x.error for x in part.evaluation.results) < ROUNDING


@pytest.mark.parametrize('measured', [True, False])
def test_levels_that_begin_at_rest_give_no_setpoint_of_noise(part_of, measured):
    messages = without(
        simulated(((1.2, 40.0), (1.0, 40.0)), noise=1e-3, extra=0.2), 'plan', 'outcomes')
    first = min(x[0] for x in messages if x[1].endswith('command'))
    if not measured:
        # A driver that reports what it applies.
        messages = resampled(
            messages, lambda time, x: (time, x.position, x.velocity, [])) + applied(messages)
    pause = 100_000_000
    messages = [(x[0] + pause, *x[1:]) if x[1].endswith('command') else x for x in messages]
    for _, topic, _, x in messages:
        if topic.endswith('command'):
            x.header = header(
                x.header.stamp.sec * NANOSECONDS + x.header.stamp.nanosec + pause)
    rest = (first, '/flux_density_command', TYPES[COMMAND], command(first + LEAD, 0.0))
    part = part_of([rest, *messages])
    assert [x.setpoint.target for x in part.evaluation.findings] == pytest.approx(
        [1.2, 1.0], abs=1e-6)


@pytest.mark.parametrize(('samples', 'levels', 'setpoints'), [
    (1, [0.02, 0.035], 0), (100, [0.02, 0.035], 0), (1000, [1e300], 1), (1000, [math.inf], 0)])
def test_odd_recordings_are_shown_for_what_they_are(tmp_path, part_of, samples, levels, setpoints):
    part = part_of([x for x in simulated() if x[1] == '/joint_states'][:samples] + [
        (START, '/flux_density_command', TYPES[COMMAND],
         command(START + LEAD + i * 6_000_000, value)) for i, value in enumerate(levels)])
    assert len(part.evaluation.results) == setpoints
    report = Page(page([part]))
    assert len(report.curve('response', 'simulated')['y']) == samples
    draw(tmp_path / 'run.svg', [part])
    assert (tmp_path / 'run.svg').read_bytes().startswith(b'<?xml')


def test_a_bag_that_was_cut_off_is_shown_up_to_the_cut_and_says_so(tmp_path, paper):
    folder = write(tmp_path / 'run', simulated(), chunk_size=10_000)
    whole = (folder / 'run_0.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(whole[:len(whole) // 2])
    part, = parts_of(tmp_path / 'cut.mcap')
    assert 100 < len(part.run.time) < len(paper.run.time)
    assert 'is not complete' in words_of(part)


# The page ------------------------------------------------------------------------------------

def test_the_page_fetches_nothing(report):
    assert not [x for x in report.tags if x[0] in ('iframe', 'object', 'embed', 'img', 'base')]
    for tag, attributes in report.tags:
        assert 'src' not in attributes, tag
        for name in ('href', 'action', 'data', 'poster', 'srcset'):
            assert re.match(r'#|data:', attributes.get(name, '#')), (tag, attributes)
    policy, = (x['content'] for tag, x in report.tags
               if x.get('http-equiv') == 'Content-Security-Policy')
    assert "default-src 'none'" in policy
    assert 'http' not in policy
    style, = re.findall(r'<style>(.*?)</style>', report.text, re.DOTALL)
    assert 'url(' not in style
    assert '@import' not in style
    own = ''.join(x for _, x in report.scripts)
    assert 'http' not in own
    assert 'fetch(' not in own
    # Small enough to be sent by mail.
    assert len(report.text) < LARGEST_PAGE


def test_every_figure_has_its_place_a_description_and_units(report):
    figures = report.figures
    # The plant is as planned, and samples have no delay and one interval.
    assert set(figures) == {'response', 'phase', 'arrival0', 'arrival1', 'arrival2', 'residuals'}
    places = {x['id']: x for tag, x in report.tags if x.get('class') == 'plot'}
    assert set(places) == set(figures)
    assert all(x['aria-label'] for x in places.values())
    assert len(report.ids) == len(set(report.ids))
    for figure in figures.values():
        for panel in figure['panels']:
            assert panel['curves']
            for name in 'xy':
                low, high = panel[name]['limits']
                assert low < high
                assert re.search(r'\(.+\)$', panel[name]['label']) or panel[name]['label'] in (
                    'setpoint', 'stretch λ')


def test_what_does_not_differ_is_said_in_a_sentence(part_of, report):
    words = ' '.join(report.words)
    assert 'The simulated motion and the plan are identical' in words
    assert 'Sample delay: 0 ms throughout.' in words
    assert 'Interval of the timestamps: 0.1 ms throughout.' in words
    # A heavier block differs from its plan, and messages may come late.
    random = np.random.default_rng(3)
    part = part_of([
        (time + int(random.integers(10_000)) * (topic == '/joint_states'), topic, *more)
        for time, topic, *more in simulated(plant=replace(ACTUATOR, density=2100.0))],
        **parameters(planner=ACTUATOR))
    report = Page(page([part]))
    assert {'deviation', 'timing'} <= set(report.figures)
    assert 'identical' not in ' '.join(report.words)
    apart = report.curve('deviation', 'recorded − planned')
    difference = part.run.stretch - part.evaluation.planned.at(part.evaluation.time).stretch
    assert max(map(abs, (x for x in apart['y'] if x is not None))) == pytest.approx(
        np.nanmax(np.abs(difference)))
    assert report.curve('timing', 'sample delay')['y'] == pytest.approx(
        1e3 * part.timing.delay, abs=1e-6)


def test_a_simulation_is_not_called_recorded_and_hardware_is_not_called_simulated(part_of, paper):
    device = part_of(simulated(), **parameters(planner=ACTUATOR))
    for part, word, unshaped in (
            (paper, 'simulated', 'unshaped steps'),
            (device, 'recorded', 'unshaped, simulated')):
        report = Page(page([part]))
        for figure in ('response', 'phase', 'arrival0', 'residuals'):
            assert report.curve(figure, word)
            assert report.curve(figure, unshaped)


def test_curves_are_what_was_recorded(report, paper):
    run = paper.run
    recorded = report.curve('response', 'simulated')
    zero = run.commands[0].stamp
    # Fewer samples than a screen could show: all of them, to nine digits.
    assert recorded['x'] == pytest.approx(((run.time - zero) / 1e6).tolist(), rel=1e-8)
    assert recorded['y'] == pytest.approx(run.stretch.tolist(), rel=1e-8)
    sent = report.curve('response', 'command')
    assert sent['x'][1:7] == pytest.approx([(x.stamp - zero) / 1e6 for x in run.commands])
    assert sent['y'][1:7] == pytest.approx([x.flux_density * 1e3 for x in run.commands])
    assert sent['form'] == 'steps'
    equilibria = report.curve('phase', 'equilibrium')
    assert equilibria['x'] == REACHED
    assert equilibria['y'] == [0, 0, 0]
    # Each target is a line through the whole hold.
    target, results = report.curve('response', 'target'), paper.evaluation.results
    assert target['x'] == pytest.approx([1e3 * y for x in results for y in (x.begin, x.end)])
    assert target['y'] == [y for x in results for y in (x.stretch, x.stretch)]


def test_an_arrival_is_shown_in_percent_of_its_step(report, paper):
    x = paper.evaluation.results[1]
    curve = report.curve('arrival1', 'simulated')
    assert curve['y'][0] == pytest.approx(-100.0, abs=0.1)
    after = [y for t, y in zip(curve['x'], curve['y'], strict=True)
             if t >= 1e3 * x.arrival]
    assert max(after) - min(after) == pytest.approx(100.0 * x.residual, rel=0.5)
    assert f'residual {percent(x.residual)} %' in ' '.join(report.words)
    # The axis shows the whole step, and the tolerance of 2 % of it.
    axis, band = report.figures['arrival1']['panels'][0]['y'], report.curve(
        'arrival1', 'tolerance')
    assert axis['scale'] == 'symlog'
    assert axis['limits'][0] < -100.0 < 100.0 < axis['limits'][1]
    assert band['y'] == [2.0, 2.0]
    assert band['lower'] == [-2.0, -2.0]


def test_the_table_has_the_measures_in_full_precision(report, paper):
    for i, x in enumerate(paper.evaluation.results):
        for column, value in (
                ('target λ [1]', x.stretch), ('b_p [1]', x.b_p), ('tau_p [1]', x.tau_p),
                ('b_1 [1]', x.b_1), ('begin [ms]', x.begin * 1e3),
                ('arrival [ms]', x.arrival * 1e3), ('end [ms]', (x.end - x.begin) * 1e3),
                ('largest error [%]', 100.0 * x.error), ('residual [%]', 100.0 * x.residual),
                ('unshaped steps [%]', 100.0 * x.residual_unshaped)):
            assert report.value('setpoint-table', i, column) == value
    assert [x['command'][1] for x in report.table('setpoint-table')] == ['2 levels'] * 3
    buttons = {x['data-table'] for tag, x in report.tags if 'data-table' in x}
    assert buttons == set(report.tables)


def test_losses_and_parameters_are_those_of_the_bag(report):
    losses = {x['topic'][1]: x for x in report.table('loss-table')}
    assert losses['/flux_density_command']['lost'] == ('2', '2')
    assert losses['/flux_density_command']['messages'] == ('6', '6')
    values = {x['parameter'][1]: float(x['actuator'][0]) for x in report.table('parameter-table')}
    assert values['shear modulus'] == ACTUATOR.shear_modulus
    assert values['zeta'] == ACTUATOR.nondimensional.zeta
    assert values['time unit'] == UNIT * 1e3
    recorded = {x['parameter'][1]: x['value'][1] for x in report.table('recorded-table')}
    assert recorded['plant.actuator.density'] == '1900.0'


def test_several_bags_lie_over_each_other_in_colours_of_their_own(paper, stiffer):
    report = Page(page([paper, *parts_of(stiffer)]))
    curves = report.figures['response']['panels'][1]['curves']
    assert {x['name']: x['hidden'] for x in curves} == {
        'stiffer': False, 'plan': True, 'run': False, 'target': False, 'unshaped steps': True}
    first, second = (x for x in curves if x['name'] in ('run', 'stiffer'))
    assert first['colour'] != second['colour']
    assert first['dash'] != second['dash']
    rows = report.table('setpoint-table')
    assert [x['run'][1] for x in rows] == ['run'] * 3 + ['stiffer'] * 3
    assert float(rows[3]['residual [%]'][0]) > 1.0


def test_block_of_the_plant_is_the_one_that_a_mismatch_leaves(tmp_path):
    run, = read_runs(write(
        tmp_path / 'run', simulated(plant=replace(ACTUATOR, density=2100.0)), **KNOWN,
        **{'plant.mismatch.density': json.dumps(2100.0 / ACTUATOR.density)}))
    assert run.plant.density == pytest.approx(2100.0, rel=1e-12)
    assert any('different parameters' in x for x in run.notes)


@pytest.mark.parametrize('name', ['a<b onload=x>&amp;"', '<!--<script>'])
def test_names_from_a_bag_cannot_become_markup(tmp_path, name):
    text = page(parts_of(write(tmp_path / name, simulated(), **parameters(plant=ACTUATOR))))
    report = Page(text)
    assert not [x for tag, x in report.tags if 'onload' in x]
    assert name in report.words
    assert '<!--' not in text
    assert '</script' not in report.scripts[0][1].lower()


def test_thinning_out_keeps_every_peak_and_the_ends():
    random = np.random.default_rng(2)
    x = np.arange(600_001.0)
    y = np.sin(x / 1e3) + 1e-3 * random.standard_normal(len(x))
    y[123_456], y[432_100], y[600_000] = 5.0, -7.0, 3.0
    thin_x, thin_y = decimate(x, y)
    assert len(thin_x) <= 2 * BUCKETS + 4
    assert np.all(np.diff(thin_x) > 0)
    assert set(zip(thin_x, thin_y, strict=True)) <= set(zip(x, y, strict=True))
    assert thin_y[thin_x == 123_456] == 5.0
    assert thin_y[thin_x == 432_100] == -7.0
    assert (thin_x[0], thin_x[-1]) == (0.0, 600_000.0)
    # The envelope in each of some coarser intervals is the whole curve's.
    for begin in range(0, 600_000, 30_000):
        inside = (thin_x >= begin) & (thin_x < begin + 30_000)
        assert np.max(thin_y[inside]) >= np.max(y[begin:begin + 30_000]) - 1e-3
        assert np.min(thin_y[inside]) <= np.min(y[begin:begin + 30_000]) + 1e-3


@pytest.mark.parametrize('count', [0, 1, 2, 3999, 4001, 6001])
def test_thinning_out_takes_any_number_of_points(count):
    x = np.arange(float(count))
    thin_x, thin_y = decimate(x, x ** 2)
    assert np.array_equal(thin_y, thin_x ** 2)
    if count:
        assert (thin_x[0], thin_x[-1]) == (0.0, count - 1.0)


def test_of_many_arrivals_the_worst_are_shown_and_the_table_has_all(part_of):
    sequence = tuple((1.1 if i % 2 else 1.2, 8.0) for i in range(20))
    part = part_of(simulated(sequence, period=200_000, noise=1e-5))
    report = Page(page([part]))
    report = Page(page([part]))
    shown = sorted(int(x.removeprefix('arrival')) for x in report.figures
                   if x.startswith('arrival'))
    ranked = sorted(range(20), key=lambda i: -part.evaluation.results[i].residual)
    assert shown == sorted(ranked[:MOST_PANELS])
    assert len(report.table('setpoint-table')) == 20


# The command ---------------------------------------------------------------------------------

def test_the_command_writes_page_and_pictures_and_names_them(bag, short, tmp_path, capsys):
    out, png, pdf, again, table = (
        str(tmp_path / x) for x in ('run.html', 'run.png', 'run.pdf', 'again.pdf', 'run.csv'))
    words = ['--out', out, '--dpi', '50', '--picture']
    assert main(['report', str(bag), *words, png, '--data']) == 0
    assert capsys.readouterr().out.split() == [out, png, table]
    assert (tmp_path / 'run.html').read_text(encoding='utf-8').startswith('<!DOCTYPE html>')
    assert (tmp_path / 'run.png').read_bytes().startswith(b'\x89PNG')
    # The data of the picture is what was recorded, and what was commanded.
    run, = read_runs(bag)
    with (tmp_path / 'run.csv').open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    shown = [float(x['y']) for x in rows if (x['panel'], x['curve']) == ('b', 'simulated')]
    assert len(shown) > 1000
    assert set(shown) <= set(run.stretch.tolist())
    levels = [float(x['y']) for x in rows if x['curve'] == 'command']
    assert levels[1:7] == pytest.approx([x.flux_density * 1e3 for x in run.commands])
    assert {x['x_axis'] for x in rows if x['panel'] == 'b'} == {'time t (ms)'}
    # Lines, not pixels, and the same again.
    assert main(['report', str(short), *words, pdf, again]) == 0
    drawn = (tmp_path / 'run.pdf').read_bytes()
    assert drawn.startswith(b'%PDF')
    assert b'/Subtype /Image' not in drawn
    assert (tmp_path / 'again.pdf').read_bytes() == drawn


def rounded(messages):
    """Return messages with the commands of hardware with steps of 1e-4 of 20 mT."""
    for _, topic, _, x in messages:
        if topic.endswith('command'):
            x.magnetic_field.z = 2e-6 * round(x.magnetic_field.z / 2e-6)
    return messages


@pytest.mark.parametrize('missing', [
    (), ('plan', 'status'),
    *(pytest.param(('plan', *x), marks=pytest.mark.slow) for x in ((), ('command',)))])
def test_levels_that_hardware_rounds_reach_the_setpoints_that_were_requested(part_of, missing):
    asked = [1.1, 1.2, 1.21, 1.4, 1.2, 1.1, 1.05, 1.0]
    part = part_of(without(
        rounded(simulated([(x, 40.0) for x in asked], period=500_000)), *missing))
    assert [(x.setpoint.number, x.setpoint.target, x.verdict)
            for x in part.evaluation.findings] == [
        (i, x, 'arrived') for i, x in enumerate(asked, 1)]
    assert targets(part) == (asked if 'command' not in missing else [])


def test_noise_is_no_vibration_and_an_offset_is_named(tmp_path):
    sequence = (1.3, 100.0), (1.05, 100.0)
    for plant, verdict in (ACTUATOR, 'arrived'), (
            replace(ACTUATOR, shear_modulus=1.1 * ACTUATOR.shear_modulus), 'off_target'):
        part = one(tmp_path / verdict, simulated(
            sequence, plant=plant, noise=1e-3, period=200_000),
            **parameters(planner=ACTUATOR, plant=plant))
        found = part.evaluation.findings
        assert found[0].verdict == verdict
        assert all(x.arrived if plant == ACTUATOR else x.failed for x in found)
    report = Page(page([part]))
    row = report.table('setpoint-table')[0]
    assert row['verdict'][1] == 'off target'
    assert float(row['offset [%]'][0]) == found[0].setpoint.percent(found[0].offset)
    assert found[0].message in report.words
    heading = ' '.join(report.words)
    assert re.search(r'1\. to 1\.3: residual [\d.]+ %, off target', heading)


def test_the_findings_of_a_bag_are_printed_as_json(bag, tmp_path, capsys):
    out = str(tmp_path / 'x.html')
    assert main(['report', str(bag), '--out', out, '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    assert result['files'] == [out]
    run, = result['runs']
    assert [(x['setpoint'], x['target'], x['verdict']) for x in run['setpoints']] == [
        (1, 1.1, 'arrived'), (2, 1.2, 'arrived'), (3, 1.4, 'arrived')]
    assert {'offset', 'offset_std', 'vibration', 'vibration_std', 'frequency', 'offset_percent',
            'vibration_percent'} <= set(run['setpoints'][0])


def test_the_page_is_named_after_the_bag_and_bags_of_one_name_are_told_apart(
        short, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ('a', 'b'):
        copytree(short, tmp_path / name / 'bag')
    assert main(['report', 'a/bag', 'b/bag', 'b/bag']) == 0
    assert capsys.readouterr().out == 'bag_report.html\n'
    words = Page((tmp_path / 'bag_report.html').read_text(encoding='utf-8')).words
    assert 'a/bag, b/bag (2), b/bag (3)' in words


def test_a_parameter_file_says_what_the_block_really_is(tmp_path):
    file = tmp_path / 'block.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    actuator:\n      shear_modulus: 2.0e+4\n'
        '    actuator.density: 2000.0\n')
    folder = write(tmp_path / 'bag', simulated())
    out = tmp_path / 'out.html'
    assert main(['report', str(folder), '--params', str(file), '--out', str(out)]) == 0
    report = Page(out.read_text(encoding='utf-8'))
    values = {x['parameter'][1]: float(x['actuator'][0])
              for x in report.table('parameter-table')}
    assert (values['shear modulus'], values['density']) == (2.0e4, 2000.0)
    assert values['half length'] == ACTUATOR.half_length


@pytest.fixture(scope='module')
def bad(tmp_path_factory, short):
    """Return a folder of what is no run, and of one that is."""
    folder = tmp_path_factory.mktemp('bad')
    (folder / 'good').symlink_to(short)
    (folder / 'text.mcap').write_text('not a bag')
    (folder / 'bad.yaml').write_text('a: [1')
    write(folder / 'empty', [])
    write(folder / 'chatter', [(
        1, '/chatter', 'std_msgs/msg/Float64', STORE.types['std_msgs/msg/Float64'](data=1.0))])
    with BagWriter(folder / 'silent') as writer:
        for role in (JOINT_STATES, COMMAND):
            encoding, text = message_definition(TYPES[role])
            writer.add_topic(BagTopic(f'/{role}', TYPES[role], text, encoding))
    return folder


@pytest.mark.parametrize(('words', 'said'), [
    ('nothing', 'does not exist'), ('text.mcap', 'is not an MCAP file'),
    ('chatter', 'has no topic .../joint_states'), ('empty', 'has no topic'),
    ('silent', 'no usable message'), ('good --out no/x.html', 'is no folder'),
    ('good --out .', 'it is a folder'), ('good --out good/bag_0.mcap', 'may be part of a bag'),
    ('good --picture x.png --out x.png', 'name the same file'),
    ('good --out /dev/full', 'cannot write /dev/full'),
    ('good --params bad.yaml', 'expected a parameter file')])
def test_bad_input_is_answered_in_one_line_with_status_2(bad, monkeypatch, capsys, words, said):
    monkeypatch.chdir(bad)
    assert main(['report', *words.split()]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert re.fullmatch(r'hmsa: error: [^\n]+\n', captured.err)
    assert said in captured.err
    assert not list(bad.glob('*.html'))


def test_the_report_is_made_without_ros(short, tmp_path):
    blocked = BLOCKED.format(blocked=ROS) + 'import hmsa.cli\nsys.exit(hmsa.cli.main())'
    done = subprocess.run(
        [sys.executable, '-W', 'error', '-c', blocked, 'report', str(short), '--out',
         str(tmp_path / 'x.html')], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_runs_are_compared_in_numbers_and_read_and_exported_without_ros(
        bag, stiffer, tmp_path, capsys):
    assert main(['compare', str(bag), str(stiffer), '--picture', str(tmp_path / 'both.svg'),
                 '--width', '85', '--json']) == 0
    said = json.loads(capsys.readouterr().out)
    assert (tmp_path / 'both.svg').exists()
    first, second = said['setpoints'][:2]
    assert (first['run'], second['run']) == ('run', 'stiffer')
    assert (first['verdict'], second['verdict']) == ('arrived', 'off target')
    # 10 % more stiffness at the same level: the same as the runs say one by one.
    read = [hmsa.read(x) for x in (bag, stiffer)]
    single = read[1].report()
    assert second['offset'] == pytest.approx(single['offset'][0])
    # Both were sampled at the same times, so that the samples differ by no more than the curves.
    begin = read[0].levels[0, 0]
    inside = (read[0].times >= begin) & (read[0].times < begin + 5e-3 * first['move time'])
    largest = np.max(np.abs(read[0].stretches - read[1].stretches)[inside])
    assert second['apart'] == pytest.approx(100.0 * largest / 0.1, rel=0.1)
    assert main(['compare', str(bag), str(stiffer)]) == 0
    assert 'move time (ms)' in capsys.readouterr().out
    assert main(['export', str(bag), '--out', str(tmp_path / 'run.mat')]) == 0
    matrix = loadmat(tmp_path / 'run.mat')
    assert np.array_equal(matrix['stretch'].ravel(), read[0].stretches)
    assert np.array_equal(matrix['level_time'].ravel(), read[0].levels[:, 0])
    assert read[0].actuator.block == ACTUATOR
