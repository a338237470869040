"""Parameter file of a new actuator: missing, derived values, implausible values."""

from dataclasses import replace
import json
import math
from pathlib import Path
import re

from extras import needs
import numpy as np
import pytest
import yaml

from hmsa.api.actuator import Actuator
from hmsa.api.facts import scales
from hmsa.errors import BadInputError
from hmsa.interfaces.quantities import BY_KEY, DAMPING, OPTIONAL, QUANTITIES, quantity_of
from hmsa.model.equations import elastic_force, natural_frequency
from hmsa.model.parameters import ActuatorParameters, NondimensionalParameters, paper_actuator
from hmsa.model.simulation import simulate
from hmsa.planning.two_step import plan_two_step

ROOT = Path(__file__).resolve().parent.parent
PAPER = paper_actuator()
COIL = (-0.5, 0.5)
OWN = ['--half-length', '5mm', '--half-thickness', '4 mm', '--shear-modulus', '30kPa',
       '--density', '1.9 g/cm3', '--remanence', '80mT', '--j-lim', '20', '--zeta', '0.1',
       '--flux-max', '200mT']


@pytest.fixture
def run(command, tmp_path, monkeypatch):
    """Return a runner of ``hmsa init`` in an empty folder: status, standard output and error."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: command('init', *words)


def parameters(path):
    return yaml.safe_load(path.read_text())['/**']['ros__parameters']


# What follows --------------------------------------------------------------------------------

def test_scales_are_those_of_the_equations():
    found = scales(PAPER, *COIL)
    assert found.time_unit == PAPER.time_unit
    material = PAPER.nondimensional
    assert found.frequency == pytest.approx(
        float(natural_frequency(1.0, material)) / (2 * math.pi * PAPER.time_unit), rel=1e-12)
    # About rest, from the linearised Eq. 11: sqrt(6).
    assert found.critical_zeta == pytest.approx(math.sqrt(6.0), rel=1e-12)
    critical = replace(PAPER, damping_coefficient=found.critical_damping)
    assert critical.nondimensional.zeta == pytest.approx(found.critical_zeta, rel=1e-12)
    for stretch, flux in found.flux_densities:
        load = flux * PAPER.remanence / (4e-7 * math.pi * PAPER.shear_modulus)
        assert load == pytest.approx(float(elastic_force(stretch, 5.0)), rel=1e-9)
    for end, limit in zip(found.held, (-0.5, 0.5), strict=True):
        assert float(elastic_force(end, 5.0)) * PAPER.flux_density_unit == pytest.approx(limit)
    assert found.target == 1.1
    assert found.duration == plan_two_step(1.0, 1.1, material).tau_p * PAPER.time_unit


def test_the_frequency_is_that_of_small_motion():
    material = NondimensionalParameters(zeta=0.0)
    actuator = paper_actuator(material)
    time = np.linspace(0.0, 60.0, 60_001)
    stretch, _ = simulate([0.0], [1e-5], time, material)
    middle = stretch - stretch.mean()
    rises = time[:-1][(middle[:-1] < 0.0) & (middle[1:] >= 0.0)]
    period = np.mean(np.diff(rises)) * actuator.time_unit
    assert scales(actuator, *COIL).frequency == pytest.approx(1.0 / period, rel=1e-3)


@pytest.mark.parametrize(('zeta', 'limits'), [
    (0.2, (-0.1, 0.05)), (0.0, (-0.5, 0.5)), (0.2, (0.0, 0.2)), (1.5, (-0.1, 0.1))])
def test_reach_is_where_two_steps_end_to_be_within_the_coils_range(zeta, limits):
    actuator = paper_actuator(NondimensionalParameters(zeta))
    found = scales(actuator, *limits)
    loads = [x / actuator.flux_density_unit for x in limits]

    def reached(stretch):
        plan = plan_two_step(1.0, stretch, actuator.nondimensional, load_limits=tuple(loads))
        return plan.code == 'two_step' and all(
            loads[0] <= x <= loads[1] for x in (plan.beta_p, plan.beta_1))

    for end in found.reached:
        if end == 1.0:
            continue
        assert reached(1.0 + (end - 1.0) * (1.0 - 1e-4))
        assert not reached(1.0 + (end - 1.0) * (1.0 + 1e-4))
    # Nothing on the side on which the coil does nothing.
    assert (found.reached[0] == 1.0) == (limits[0] == 0.0)


def test_without_a_two_step_command_there_is_no_duration():
    found = scales(paper_actuator(NondimensionalParameters(zeta=50.0)), *COIL)
    assert found.reached == (1.0, 1.0)
    assert math.isnan(found.target)
    assert math.isnan(found.duration)


@pytest.mark.parametrize('values', [
    (0.1, 0.1), (0.2, 0.1), (math.nan, 0.1), (-math.inf, 0.1)])
def test_coils_that_cannot_be_are_refused(values):
    with pytest.raises(BadInputError, match='expected'):
        scales(PAPER, *values)


# The file ------------------------------------------------------------------------------------

def test_the_file_has_what_was_given_in_si_units(run, tmp_path):
    status, out, err = run(*OWN, '--out', 'my own.yaml')
    assert (status, err) == (0, '')
    found = parameters(tmp_path / 'my own.yaml')
    damping = found.pop('actuator.damping_coefficient')
    assert found == {
        'actuator.half_length': 0.005, 'actuator.half_thickness': 0.004,
        'actuator.shear_modulus': 30e3, 'actuator.density': 1900.0, 'actuator.remanence': 0.08,
        'actuator.chain_limit': 20.0, 'flux_density_min': -0.2, 'flux_density_max': 0.2,
        'slew_limit': 0.0, 'joint': 'actuator', 'publish_rate': 4000.0}
    assert damping == pytest.approx(8 * 0.1 * 0.005 * 0.004 * math.sqrt(1900 * 30e3))
    assert "hmsa planner --ros-args --params-file 'my own.yaml'" in out
    for line in [*out.splitlines()[:10], *out.splitlines()[-2:]]:
        assert f'#   {line.strip()}' in (tmp_path / 'my own.yaml').read_text()


def test_the_planner_of_an_actuator_with_modes_is_started_with_the_shaper_for_them(
        run, tmp_path):
    _, out, _ = run(*OWN, '--mount', 'free', '--out', 'free.yaml')
    planner = 'hmsa planner --ros-args --params-file free.yaml -p shaper:=modal'
    assert out.splitlines()[-1] == f'  {planner}'
    assert f'#   {planner}\n' in (tmp_path / 'free.yaml').read_text()


def test_a_block_takes_the_damping_ratio_of_its_ringing(run, tmp_path):
    own = [*OWN[:OWN.index('--zeta')], *OWN[OWN.index('--zeta') + 2:]]
    status, out, err = run(*own, '--damping-ratio', '0.04')
    assert (status, err) == (0, '')
    assert Actuator.from_yaml(tmp_path / 'actuator.yaml').damping_ratio == pytest.approx(0.04)


def test_a_law_without_limiting_stretches_shows_none(run):
    assert 'limiting stretches' in run('--yes', '--out', 'gent.yaml')[1]
    for law in ('neo_hookean', 'yeoh:c10=5kPa'):
        assert 'limiting' not in run('--yes', '--force', '--law', law)[1]


def test_a_small_actuator_is_sampled_often_enough(run, tmp_path):
    small = [x.replace('5mm', '0.3mm').replace('4 mm', '0.3 mm') for x in OWN]
    assert run(*small)[0] == 0
    document = yaml.safe_load((tmp_path / 'actuator.yaml').read_text())
    values = document['/**']['ros__parameters']
    rate = values['publish_rate']
    actuator = ActuatorParameters(**{
        x.partition('.')[2]: y for x, y in values.items() if x.startswith('actuator.')})
    period = 1.0 / scales(actuator, *COIL).frequency
    # More than a plant keeps up with in real time: no more than shows the peaks.
    assert rate > 4000.0
    assert 10.0 <= rate * period < 11.0
    assert 'real_time_factor' in (tmp_path / 'actuator.yaml').read_text()
    assert run('--yes', '--half-length', '20mm', '--out', 'large.yaml')[0] == 0
    assert 'publish_rate' not in (tmp_path / 'large.yaml').read_text()
    # 20 a period where that is not more than a plant keeps up with.
    assert run('--yes', '--half-length', '10mm', '--out', 'medium.yaml')[0] == 0
    medium = yaml.safe_load((tmp_path / 'medium.yaml').read_text())['/**']['ros__parameters']
    assert 20.0 <= medium['publish_rate'] / 89.437 < 22.0


def test_defaults_are_the_papers_block(run, tmp_path):
    assert run('--yes')[0] == 0
    found = parameters(tmp_path / 'actuator.yaml')
    for name in PAPER.numbers:
        assert found[f'actuator.{name}'] == pytest.approx(getattr(PAPER, name), rel=1e-15)


def test_json_says_everything_there_is(run, tmp_path):
    status, out, _ = run('--yes', '--json', '--half-length', '2e-3', '--joint', 'left,right')
    assert status == 0
    made = json.loads(out)
    assert made['file'] == 'actuator.yaml'
    assert made['joints'] == ['left', 'right']
    # A cube, unless told.
    assert made['parameters']['actuator.half_thickness'] == 2e-3
    assert made['scales']['duration'] == pytest.approx(0.005735 / 5, rel=1e-3)
    assert [x.split(' are guesses')[0] for x in made['warnings']] == [
        'half thickness 0.002 m, as the half length; shear modulus 10000 Pa; density 1900 '
        'kg/m^3; remanence 0.1 T; j lim 5; zeta 0.2; flux max 0.5 T']
    text = (tmp_path / 'actuator.yaml').read_text()
    assert parameters(tmp_path / 'actuator.yaml')['joints'] == ['left', 'right']
    assert '# left.actuator.remanence: 0.1\n' in text


def test_a_guess_is_marked_in_the_file_and_what_is_given_is_not(run, tmp_path):
    status, _, err = run('--yes', *(x for i in range(0, len(OWN), 2) if OWN[i] != '--density'
                                   for x in OWN[i:i + 2]))
    assert status == 0
    assert 'warning: density 1900 kg/m^3 is a guess' in err
    text = (tmp_path / 'actuator.yaml').read_text()
    assert text.count('a guess') == 1
    assert '# Density rho [kg/m^3], a guess.\n    actuator.density: 1900.0\n' in text


@pytest.mark.parametrize('sizes', [
    ('--half-length', '10mm', '--thickness', '1mm'), ('--length', '20mm', '--thickness', '1mm'),
    ('--length', '2cm', '--half-thickness', '0.5mm')])
def test_full_sizes_of_a_block_are_twice_the_half_ones(run, tmp_path, sizes):
    assert run('--yes', *sizes)[0] == 0
    found = parameters(tmp_path / 'actuator.yaml')
    assert (found['actuator.half_length'], found['actuator.half_thickness']) == (0.01, 0.0005)


@pytest.mark.parametrize(('text', 'unit', 'value'), [
    ('20hz', 'Hz', 20.0), ('0.02KHZ', 'Hz', 20.0), ('5 khz', 'Hz', 5e3), ('30KPA', 'Pa', 30e3),
    ('30kpa', 'Pa', 30e3), ('1 t', 'T', 1.0), ('3 OHM', 'ohm', 3.0), ('2MPA', 'Pa', 2e6)])
def test_units_may_be_in_another_case(text, unit, value):
    assert quantity_of(text, unit, 'it') == value


@pytest.mark.parametrize(('text', 'unit'), [('30mpa', 'Pa'), ('1MT', 'T'), ('2 M', 'm')])
def test_the_prefixes_of_a_million_and_a_thousandth_are_not_confused(text, unit):
    with pytest.raises(BadInputError, match='it has the unit'):
        quantity_of(text, unit, 'it')


def test_a_decimal_comma_is_refused_with_the_number_that_is_meant():
    with pytest.raises(BadInputError, match=r"it is '0,8mm': expected .*, as in '0\.8mm'$"):
        quantity_of('0,8mm', 'm', 'it')


@pytest.mark.parametrize('size', ['length', 'thickness'])
def test_a_size_is_given_once(run, size):
    status, _, err = run('--yes', f'--{size}', '1mm', f'--half-{size}', '1mm')
    assert status == 2
    assert f'both --{size} and --half-{size} are given: expected one of them' in err


def test_every_number_is_a_float_to_every_reader_of_yaml(run, tmp_path):
    assert run('--yes', '--half-length', '1e-7', '--damping', '1e-9', '--shear-modulus',
               '1e12')[0] == 0
    for name, value in parameters(tmp_path / 'actuator.yaml').items():
        assert isinstance(value, str if name == 'joint' else float), name


def test_a_file_that_exists_is_kept_unless_forced(run, tmp_path):
    (tmp_path / 'actuator.yaml').write_text('mine')
    status, out, err = run('--yes')
    assert (status, out) == (2, '')
    assert 'actuator.yaml exists: name another file with --out, or add --force' in err
    assert (tmp_path / 'actuator.yaml').read_text() == 'mine'
    assert run('--yes', '--force')[0] == 0
    assert 'shear_modulus' in (tmp_path / 'actuator.yaml').read_text()


@pytest.mark.parametrize(('words', 'said'), [
    ('--density heavy', "density is 'heavy': expected a number with or without a unit"),
    ("--density '5 mm'", "unit 'mm': expected one of kg/m^3"),
    ('--half-length 0', 'half length is 0 m: expected 1e-09 to 1000 m'),
    ('--half-length=-1mm', 'half length is -0.001 m'),
    ('--shear-modulus nan', "shear modulus is 'nan'"), ('--remanence 1e999', 'remanence is inf T'),
    ("--j-lim '5 Pa'", "unit 'Pa': expected a number without a unit"),
    ('--zeta 1 --damping 1', 'both --zeta and --damping'),
    ('--zeta 1 --damping-ratio 0.4', 'both --zeta and --damping-ratio'),
    ('--beam --damping-ratio 0.1 --damping 1', 'both --damping-ratio and --damping'),
    ('--beam --zeta 1', '--zeta is given: expected sizes of a beam'),
    ('--flux-min 0.5', 'expected the minimum below the maximum'),
    ('--joint 1st', "joint '1st': expected letters"), ('--joint a__b', "joint 'a__b'"),
    ('--joint a,a', 'named twice'), ('--out no/where.yaml', 'is no folder'),
    ('--out /dev/full --force', 'cannot write /dev/full')])
def test_bad_input_is_answered_in_one_line_and_writes_nothing(
        refusal, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    assert said in refusal(f'init --yes {words}')
    assert list(tmp_path.iterdir()) == []


def test_it_says_what_is_missing(run, tmp_path):
    assert run(*OWN[:-2]) == (2, '', (
        'hmsa: error: --flux-max is not given: expected it, or --yes for the defaults\n'))
    assert run(*OWN[:-4])[2] == (
        f'hmsa: error: {OWN[-4]}, --flux-max are not given: expected them, or --yes for the '
        'defaults\n')
    assert list(tmp_path.iterdir()) == []


# What is implausible -------------------------------------------------------------------------

@pytest.mark.parametrize(('words', 'said'), [
    ("--shear-modulus '79 GPa'", 'metals have'), ('--shear-modulus 30', 'did you mean kPa'),
    ('--density 1.2', 'that is air'), ('--density 1.9', 'did you mean g/cm^3'),
    ('--remanence 1.6', 'N55'), ('--remanence 80', 'did you mean mT'),
    ('--half-thickness 5', 'half thickness 5 m is unusual (did you mean mm?)'),
    ('--half-length 5', 'half length 5 m is unusual (did you mean mm?)'),
    ('--half-thickness 0.1mm', 'thin film'),
    ('--flux-max 50', 'flux max 50 T is unusual (did you mean mT?)'),
    ('--flux-min 0.01', 'flux min 0.01 T is unusual'),
    ('--zeta 3', 'zeta 3 is above the critical 2.44949'), ('--damping 20', 'zeta 5.73539'),
    ('--j-lim 1000', 'Gent'), ('--flux-max 1mT', 'a stretch of 1.1 or 0.9 needs about')])
def test_what_is_implausible_is_warned_of_with_the_usual_range(
        command, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    status, out, err = command(f'init --yes --json {words}')
    assert status == 0
    warnings = json.loads(out)['warnings']
    assert any(said in x for x in warnings)
    assert err == ''.join(f'hmsa: warning: {x}\n' for x in warnings)
    assert (tmp_path / 'actuator.yaml').exists()


@pytest.mark.parametrize(('words', 'said'), [
    ('--length 25', 'length 25 m'), ('--thickness 1', 'thickness 1 m')])
def test_a_size_in_another_unit_is_named_where_the_beam_is_impossible(run, words, said):
    # Of the file, too, which `Actuator` and the nodes read.
    status, out, err = run('--beam', '--yes', *words.split())
    assert (status, out) == (2, '')
    assert err.count('hmsa: error: ') == 1
    assert err.endswith(f'; {said} is unusual (did you mean mm?)\n')
    name, value = words.removeprefix('--').split()
    with pytest.raises(BadInputError, match=re.escape(f'; {said} is unusual')):
        Actuator.from_parameters({
            'law.name': 'beam', 'actuator.half_length': 0.0125, 'actuator.half_thickness': 5e-4,
            f'actuator.half_{name}': 0.5 * float(value)})


def test_usual_numbers_are_not_warned_of():
    for quantity in QUANTITIES:
        low, high = quantity.usual
        assert low < high
        assert quantity.least <= low
        assert quantity.doubt(low) is None
        if quantity.default is not None:
            assert quantity.doubt(quantity.default) is None
        if math.isfinite(high):
            assert quantity.doubt(math.nextafter(high, math.inf)).endswith(quantity.source)
            assert str(f'{high:g}') in quantity.doubt(math.nextafter(high, math.inf))


def test_numbers_are_taken_in_the_range_that_the_nodes_take():
    needs('rclpy')
    from hmsa.interfaces.parameters import ACTUATOR
    from hmsa_ros.nodes.planning import PARAMETERS
    declared = {x.name: x for x in (*ACTUATOR, *PARAMETERS)}
    for quantity in (*QUANTITIES, DAMPING):
        if quantity.parameter:
            spec = declared[quantity.parameter]
            assert (quantity.least, quantity.largest) == (spec.minimum, spec.maximum)
            assert quantity.unit == spec.unit
    assert set(OPTIONAL) <= set(BY_KEY)


# Used ----------------------------------------------------------------------------------------

@pytest.mark.slow
@pytest.mark.ros
def test_planner_and_plant_take_the_file_and_arrive_when_it_says(start, tmp_path, run):
    status, out, _ = run(*OWN, '--json', '--joint', 'finger')
    assert status == 0
    made = json.loads(out)
    file = str(tmp_path / 'actuator.yaml')
    arguments = ['--ros-args', '--params-file', file]
    # Fewer samples and further ahead than the file says, and no time passes where the plant
    # stands still: for a busy machine.
    start.hmsa('plant', *arguments, '-p', 'publish_rate:=500.0', '-p', 'publish_clock:=true')
    start.hmsa('planner', *arguments, '-p', 'lead_time:=3.0', '-p', 'use_sim_time:=true')
    recorder = start.hmsa(
        'recorder', '--ros-args', '-p', f'storage.uri:={tmp_path / "bag"}',
        '-p', 'record.all_topics:=true')
    for topic in '/planner/plan', '/joint_states', '/flux_density_command':
        recorder.wait_for_output(topic)
    target = made['scales']['target']
    send = start.hmsa('send', f'{target}:0.2', '--joint', 'finger', '--wait')
    assert send.wait(60.0) == 0, send.output
    assert recorder.stop() == 0, recorder.output
    from hmsa.report.evaluation import evaluate
    from hmsa.runs.bags import read_runs

    run_, = read_runs(tmp_path / 'bag')
    result, = evaluate(run_).results
    assert result.stretch == pytest.approx(target)
    assert result.arrival == pytest.approx(made['scales']['duration'], abs=1e-8)
    assert result.residual < 1e-6
    assert run_.plant.shear_modulus == 30e3
