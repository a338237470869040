"""Modes of a block as a continuum, against closed forms and an independent integration."""

from dataclasses import replace
import json
import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hmsa import Actuator
from hmsa.api.facts import unquestioned
from hmsa.cli import main
from hmsa.errors import BadInputError, UnusualWarning
from hmsa.model import law
from hmsa.model.actuators import Actuators, Setup
from hmsa.model.continuum import mode_shapes, mounted, spectrum
from hmsa.model.delivery import Delivery
from hmsa.model.modes import BROAD, Modes
from hmsa.model.moves import Level, Setpoint, State
from hmsa.model.parameters import NondimensionalParameters, paper_actuator
from hmsa.model.simulation import follow, observed, sampled
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Options, Planner
from hmsa.planning.sequence import plan_sequence, remaining
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

TWO = Modes((1.37, 1.95), (0.19, 0.04), (0.08, 0.12), (0.5, -0.3), (-2.4, 1.1))
BLOCK = replace(paper_actuator(), modes=TWO, mass_factor=1.2, transverse_mass_factor=1.8)
GROUP = BLOCK.nondimensional


# -- the spectrum -------------------------------------------------------------------------------

def test_first_mode_of_the_cube_is_its_lame_mode():
    # Shear waves that reflect without conversion: pi/sqrt(2) for a half length of 1.
    found = spectrum(1.0, 'free')
    assert found.frequencies[found.first] == pytest.approx(math.pi / math.sqrt(2.0), rel=1e-4)


def test_first_mode_of_the_cube_is_the_sum_of_its_lame_modes_that_the_load_excites():
    # Those in both planes of the field, with a mean of 1 along the field on the face of the load.
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (40, 3))
    (x, y, z), size = 0.5 * np.pi * points.T, 0.25 * np.pi
    expected = size * np.column_stack([
        -np.sin(x) * np.cos(z), -np.sin(y) * np.cos(z), (np.cos(x) + np.cos(y)) * np.sin(z)])
    assert mode_shapes(1.0, 3, points)[0] == pytest.approx(expected, abs=1e-4)


def test_slender_block_is_a_bar():
    # A free bar with the mean load at its ends: odd quarter waves, with E = 3 G, and the shares of
    # 8/pi^2/n^2. Lateral inertia lowers the frequency by a few parts in a thousand.
    found = spectrum(10.0, 'free')
    first = found.first
    assert found.frequencies[first] == pytest.approx(
        0.5 * math.pi / 10.0 * math.sqrt(3.0), rel=5e-3)
    assert found.shares[first] == pytest.approx(8.0 / math.pi ** 2, rel=0.01)


@pytest.mark.parametrize(('shape', 'stretch', 'ratio'), [
    (0.4, 0.9, 1.003), (0.4, 1.2, 1.006), (1.0, 0.9, 1.088), (1.0, 1.2, 0.904), (1.5, 1.2, 0.890)])
def test_frequency_of_a_glued_block_follows_its_stretch(shape, stretch, ratio):
    """The ratios are those of finite elements at rest under a load (`block_elements`)."""
    with unquestioned():
        model = Actuator(half_thickness=0.01 * shape, chain_limit=5.0, mount='glued').model
    assert model.frequency(stretch) / model.frequency(1.0) == pytest.approx(ratio, rel=0.04)


def test_glued_slender_block_is_a_bar_of_twice_the_length():
    free, glued = spectrum(6.0, 'free'), spectrum(6.0, 'glued')
    assert glued.frequencies[glued.first] == pytest.approx(
        0.5 * free.frequencies[free.first], rel=0.03)
    assert 0.97 < glued.compliance < 1.0


@pytest.mark.parametrize('stretch', [0.9, 1.1, 1.2])
def test_statics_about_a_stretch_are_those_of_the_model(stretch):
    found = spectrum(0.7, 'free', stretch, 5.0)
    stiffness = float(law.elastic_stiffness(stretch, law.pack(0.0, 5.0, 0.98)))
    assert found.compliance / 3.0 * stiffness == pytest.approx(1.0, abs=2e-3)
    assert np.sum(found.shares) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize('shape', [
    0.3, *(pytest.param(x, marks=pytest.mark.slow) for x in (1.0, 2.0))])
def test_factors_reproduce_the_first_mode_about_any_stretch(shape):
    found = mounted(shape, 'free', 5.0, 0.05)
    block = replace(
        paper_actuator(NondimensionalParameters(c1=2.0 * shape ** 2)),
        mass_factor=found.mass_factor, transverse_mass_factor=found.transverse_mass_factor)
    unit = block.half_length * math.sqrt(block.density / block.shear_modulus)
    for stretch in (0.9, 1.0, 1.1, 1.2):
        exact = spectrum(shape, 'free', stretch, 5.0 if stretch != 1.0 else math.inf)
        frequency = float(law.natural_frequency(stretch, block.nondimensional.packed))
        assert frequency / block.time_unit * unit == pytest.approx(
            exact.frequencies[exact.first], rel=0.03)


@pytest.mark.parametrize(('shape', 'mount', 'said'), [
    (0.01, 'free', 'is 0.01: expected 0.02 to 10'),
    (1.0, 'hung', "mount is 'hung': expected one")])
def test_shape_or_mount_out_of_range_is_refused(shape, mount, said):
    with pytest.raises(BadInputError, match=said):
        mounted(shape, mount, 5.0, 0.05)


# -- parameters ---------------------------------------------------------------------------------

@pytest.mark.parametrize(('values', 'said'), [
    (((1.4,), (0.1, 0.2), (0.1,)), 'modes.share has 2, .*: expected one of each'),
    (((1.0,), (0.1,), (0.1,)), 'modes.frequency_ratio has 1: expected numbers above 1'),
    (((1.4,), (1.2,), (0.1,)), 'modes.share has 1.2: expected numbers between'),
    (((1.4, 2.0), (0.6, 0.5), (0.1, 0.1)), 'modes.share adds up to 1.1: expected less than 1'),
    (((1.4,), (0.1,), (1.0,)), 'modes.damping_ratio has 1: expected'),
    (((1.4,), (0.1,), (0.1,), (9.0,)), 'modes.ratio_exponent has 9: expected numbers from -5'),
    (((1.4,), (0.1,), (0.1,), (), (11.0,)), 'modes.share_exponent has 11: expected numbers'),
    (((1.4, 2.0), (0.6, -0.5), (0.1, 0.1), (), (1.0, 1.0)), 's of modes.share add up to 1.1'),
    (((1.4,), (0.1,), (0.1,), (), (1.0, 2.0)), 'modes.share_exponent has 2 values'),
    (((1.4,) * 4, (0.1,) * 4, (0.1,) * 4), 'has 4 values: expected at most 3'),
    (((math.nan,), (0.1,), (0.1,)), 'modes.frequency_ratio has nan')])
def test_modes_out_of_range_are_refused_by_name(values, said):
    with pytest.raises(BadInputError, match=said):
        Modes(*values)


def test_mass_factor_changes_the_frequency_and_not_the_statics_or_the_force_of_damping():
    paper, heavy = paper_actuator(), replace(
        paper_actuator(), mass_factor=4.0, transverse_mass_factor=3.0)
    assert heavy.period == pytest.approx(2.0 * paper.period, rel=1e-12)
    assert heavy.units.load == paper.units.load
    one, other = (Actuators([Setup(x)]) for x in (paper, heavy))
    for block in (one, other):
        block.command(0, 0, 0.05)
        block.advance(3_000_000_000)
    assert one.stretch[0] == pytest.approx(other.stretch[0], rel=1e-9)
    # The decay of a vibration is c over twice the mass.
    decays = [float(law.damping(1.0, x.nondimensional.packed)) / (
        2.0 * float(law.mass(1.0, x.nondimensional.packed))) / x.time_unit for x in (paper, heavy)]
    assert decays[1] == pytest.approx(decays[0] / 4.0, rel=1e-12)


def test_beam_has_no_transverse_factor_and_no_exponent():
    strip = Actuator.beam(length=10e-3, thickness=1e-3, width=5e-3, youngs_modulus=2e6).block
    with pytest.raises(BadInputError, match='transverse_mass_factor is 2: expected 1'):
        replace(strip, transverse_mass_factor=2.0)
    for name in ('exponents', 'share_exponents'):
        with pytest.raises(BadInputError, match='_exponent is given for a beam'):
            replace(strip, modes=replace(Modes((6.3,), (-0.1,), (0.1,)), **{name: (1.0,)}))


# -- motion -------------------------------------------------------------------------------------

def oracle(levels, end):
    """Return stretch and rate of all modes at an end time, by SciPy, from rest at 1."""
    group, c1 = GROUP, GROUP.c1

    def elastic(x):
        above = x - x ** -2
        g = 1.0 - (x * x + 2.0 / x - 3.0) / group.j_lim
        return above / g, ((1.0 + 2.0 * x ** -3) + 2.0 * above ** 2 / (group.j_lim * g)) / g

    def motion(_, y, load):
        x, v = y[:2]
        force, stiffness = elastic(x)
        mass = (x ** -3 + c1) / 6.0
        by = [v, (load - force - 0.5 * group.zeta * c1 * v + 0.25 * x ** -4 * v * v) / mass]
        for i, (ratio, damping, exponent) in enumerate(zip(
                TWO.ratios, TWO.dampings, TWO.exponents, strict=True)):
            w = math.sqrt(stiffness / mass) * ratio * x ** exponent
            z, u = y[2 + 2 * i:4 + 2 * i]
            rest = x + (load - force) / stiffness
            by += [u, w * w * (rest - z) - 2.0 * damping * w * u]
        return by

    y = np.array([1.0, 0.0] * 3)
    for (begin, load), (until, _) in zip(levels, (*levels[1:], (end, 0.0)), strict=True):
        y = solve_ivp(motion, (begin, until), y, method='DOP853', rtol=1e-11, atol=1e-12,
                      args=(load,)).y[:, -1]
    return y


def seen(y):
    """Return stretch and rate that modes show together; the latter by differences."""
    def stretch(z):
        odds = np.multiply(TWO.shares, z[0] ** np.array(TWO.share_exponents)) / TWO.first
        return np.append(1.0, odds) @ z / (1.0 + np.sum(odds))
    h = 1e-6
    return stretch(y[::2]), (stretch(y[::2] + h * y[1::2]) - stretch(y[::2] - h * y[1::2])) / (
        2.0 * h)


def test_motion_with_modes_is_that_of_scipy():
    levels, end = ((0.0, 0.2), (1.1, -0.1), (2.3, 0.35)), 4.0
    wanted = oracle(levels, end)
    rows = sampled([Level(*x) for x in levels], State(1.0, load=0.2), np.array([end]), GROUP)
    assert rows[[0, 1, 3, 4, 5, 6], 0] == pytest.approx(wanted, abs=1e-9)
    assert observed(rows, GROUP)[:, 0] == pytest.approx(seen(wanted), abs=1e-9)


def test_plant_shows_the_motion_of_all_modes():
    plant = Actuators([Setup(paper_actuator()), Setup(BLOCK)])
    unit, load = BLOCK.time_unit, BLOCK.units.load
    for i in (0, 1):
        plant.command(i, 0, 0.2 * load)
        plant.command(i, round(1.1 * unit * 1e9), -0.1 * load)
    plant.advance(round(2.5 * unit * 1e9))
    wanted = oracle(((0.0, 0.2), (1.1, -0.1)), 2.5)
    stretch, rate = seen(wanted)
    assert plant.stretch[1] == pytest.approx(stretch, abs=1e-7)
    assert plant.rate[1] * unit == pytest.approx(rate, abs=1e-6)


# -- plans --------------------------------------------------------------------------------------

def rest_by_modal(material, start, targets, most, delivery, order=2):
    """Require that modal moves bring all modes to rest; every other one begins in motion."""
    shape, state = get_shaper('modal'), State(start)
    for i, target in enumerate(targets.tolist()):
        request = MoveRequest(state, target, material, delivery=delivery, order=order)
        move = shape(request)
        end = follow(move.levels, request.start, move.duration, material, delivery)
        assert [end.stretch, *end.followed[::2]] == pytest.approx(
            [target] * (1 + len(end.followed) // 2), abs=most)
        assert np.max(np.abs([end.rate, *end.followed[1::2]])) < 10.0 * most
        if i % 2:
            half = 0.6 * move.duration
            state = follow(
                [x for x in move.levels if x.time < half], request.start, half, material,
                delivery)
        else:
            state = State(target)


@pytest.mark.parametrize('delivery', [
    Delivery(), Delivery(period=0.1), Delivery(slew=2.0), Delivery(lag=0.2),
    Delivery(period=0.05, slew=3.0, lag=0.1)], ids=['ideal', 'grid', 'ramps', 'lag', 'all'])
@pytest.mark.parametrize('order', [2, 3])
def test_modal_brings_all_modes_to_rest_from_rest_and_from_motion(delivery, order):
    rest_by_modal(
        GROUP, 1.0, np.random.default_rng(1).uniform(0.85, 1.35, 12), 1e-9, delivery, order)


@pytest.mark.parametrize('delivery', [
    Delivery(), Delivery(period=0.05, slew=3.0, lag=0.1)], ids=['ideal', 'all'])
def test_sequence_of_modal_moves_starts_each_from_where_the_motion_is(delivery):
    frame, dwell = MoveRequest(State(1.0), 1.0, GROUP, delivery=delivery), 12.0
    state = frame.state
    for segment in plan_sequence(
            [Setpoint(x, dwell) for x in (1.2, 0.9, 1.3)], frame, 'modal'):
        state = follow(
            segment.move.levels, replace(frame, state=state).start, dwell, GROUP, delivery)
        assert segment.end.followed[::2] == pytest.approx(state.followed[::2], abs=1e-9)
        assert segment.end.followed[1::2] == pytest.approx(state.followed[1::2], abs=1e-8)
        assert (segment.end.stretch, segment.end.rate, segment.end.load) == pytest.approx(
            (state.stretch, state.rate, state.load), abs=1e-8)
        assert (segment.end.amplifier is None) == (state.amplifier is None)


@pytest.mark.parametrize('factor', [0.985, 1.015])
@pytest.mark.parametrize('target', [0.9, 1.1, 1.3])
def test_third_order_of_modal_leaves_less_where_frequencies_are_wrong(target, factor):
    left = {}
    for order in (2, 3):
        request = MoveRequest(State(1.0), target, GROUP, order=order)
        move = get_shaper('modal')(request)
        # A longer command is one for a slower block.
        end = follow([Level(factor * x.time, x.load) for x in move.levels], request.start,
                     factor * move.duration, GROUP, Delivery())
        left[order] = math.hypot(end.stretch - target, end.rate / request.frequency)
    assert left[3] < 0.004 * abs(target - 1.0)
    assert left[3] < 0.75 * left[2]


@pytest.mark.parametrize('shape', [0.1, 0.5, 1.0, 4.0])
def test_modal_takes_2_3_and_3_5_times_as_long_as_the_two_step_command_of_the_paper(shape):
    with unquestioned():
        paper = Actuator(half_thickness=0.01 * shape, damping_ratio=0.05, chain_limit=5.0)
        block = paper.replace(mount='free')
    unit = block.block.time_unit / paper.block.time_unit
    for target in (0.9, 1.1, 1.2):
        whole = get_shaper('two_step')(
            MoveRequest(State(1.0), target, paper.model.material)).duration
        for order, most in ((2, 2.3), (3, 3.5)):
            move = get_shaper('modal')(
                MoveRequest(State(1.0), target, block.model.material, order=order))
            assert 0.95 * most < unit * move.duration / whole <= most


def test_modal_without_modes_is_the_two_step_command():
    request = MoveRequest(State(1.0), 1.2, paper_actuator().nondimensional)
    assert get_shaper('modal')(request) == get_shaper('two_step')(request)


def test_modal_keeps_the_limits_of_the_coil_or_is_refused():
    block = Actuator(mount='free', flux_density_limits=0.06)
    assert np.max(np.abs(block.plan([(1.05, 0.5), (0.96, 0.5)], 'modal').flux_densities)) <= 0.06
    with pytest.raises(BadInputError, match='expected'):
        block.plan([(1.3, 0.5)], 'modal')


def test_flat_glued_block_says_how_far_it_rests_from_its_targets(tmp_path, capsys):
    words = 'to 0.9, 1.1 and 1.2 rest about 2.3, 0.6 and 0.7 % of the step beyond'
    with pytest.warns(UnusualWarning, match=words):
        Actuator(half_thickness=5e-3, mount='glued')
    with pytest.warns(UnusualWarning, match=words):
        Actuator(half_thickness=5e-3).replace(mount='glued')
    assert main(['init', '--yes', '--half-thickness', '5mm', '--mount', 'glued', '--out',
                 str(tmp_path / 'actuator.yaml')]) == 0
    assert words in capsys.readouterr().err
    assert ('    # Shear modulus G of the material, times the relative stiffness of a glued block '
            '[Pa]') in (tmp_path / 'actuator.yaml').read_text()


def test_mounted_block_rests_by_modal_and_rings_by_two_step():
    block = Actuator(half_length=5e-3, zeta=0.1, mount='free')
    setpoints = [(1.1, 0.5), (1.2, 0.5), (0.95, 0.5)]
    left = {x: block.plan(setpoints, x).simulate().report()['residual'] for x in (
        'two_step', 'modal')}
    assert min(left['two_step']) > 5.0
    # In % of the step, by the weak modes, which have no levels of their own.
    assert 0.5 < max(left['modal']) < 2.0
    plan, material = block.plan(setpoints, 'modal'), block.model.material
    state = State(1.0, load=0.0)
    for segment in plan.segments:
        levels = segment.move.levels
        state = follow(levels, state, segment.move.duration, material, Delivery())
        target = segment.setpoint.stretch
        assert [state.stretch, *state.followed[:4:2]] == pytest.approx([target] * 3, abs=1e-8)
        state = State(target, load=levels[-1].load)


@pytest.mark.parametrize(('shaper', 'modes'), [
    ('two_step', [2, 2]), ('robust', [2, 2]), ('smooth', [2, 2]), ('zvd', [2, 2]),
    ('minimum_time', [4, 2])])
def test_plan_predicts_the_vibration_that_its_simulation_shows(shaper, modes):
    block = Actuator(half_length=5e-3, damping_ratio=0.05, mount='free', flux_density_limits=0.2)
    plan, before = block.plan([(1.05, 0.3), (0.97, 0.3)], shaper), 1.0
    seen = plan.simulate(rate=2e5)
    for i, segment in enumerate(plan.segments):
        target, period = segment.setpoint.stretch, block.model.frequency(segment.setpoint.stretch)
        arrival = 0.3 * i + plan.move_times[i]
        period = 2.0 * math.pi / period * block.model.units.time
        left = seen.stretches[(seen.times >= arrival) & (seen.times < arrival + period)]
        assert segment.left.vibration * abs(target - before) == pytest.approx(
            float(np.ptp(left)), rel=0.02)
        assert segment.left.mode == modes[i]
        assert f'by {segment.move.code} leaves a vibration of' in segment.notes()[-1]
        before = target


@pytest.mark.parametrize(('shape', 'target', 'elements'), [
    (0.1, 1.1, 20.1), (0.3, 0.9, 23.1), (1.0, 1.2, 11.1), (4.0, 1.1, 11.4), *(
        pytest.param(*x, marks=pytest.mark.slow) for x in (
            (0.5, 0.9, 26.7), (0.5, 1.2, 21.1), (0.707, 1.2, 12.9), (1.0, 0.9, 20.1),
            (2.0, 1.1, 15.8)))])
def test_vibration_of_a_tuned_two_step_is_predicted_to_a_fifth(shape, target, elements):
    # Measured on finite elements (benchmarks continuum).
    with unquestioned():
        paper = Actuator(half_thickness=0.01 * shape, damping_ratio=0.08, chain_limit=5.0)
        material = paper.replace(mount='free').model.material
    request = MoveRequest(State(1.0), target, material)
    left = remaining(request, get_shaper('two_step')(request))
    assert 100.0 * left.vibration == pytest.approx(elements, rel=0.2)


@pytest.mark.parametrize(('shape', 'target', 'elements'), [
    (0.05, 0.9, 3.7), (0.3, 1.1, 2.7), (0.5, 1.1, 1.6), (1.0, 1.1, 1.9), (2.0, 1.2, 2.5)])
def test_vibration_after_modal_is_predicted_to_a_factor_of_two(shape, target, elements):
    # Measured on finite elements with a damping ratio of 0.02 (benchmarks continuum).
    with unquestioned():
        material = Actuator(
            half_thickness=0.01 * shape, damping_ratio=0.02, chain_limit=5.0, mount='free',
        ).model.material
    request = MoveRequest(State(1.0), target, material)
    left = remaining(request, get_shaper('modal')(request))
    assert 0.5 * elements < 100.0 * left.vibration < 2.0 * elements


@pytest.mark.parametrize(('order', 'told'), [(2, True), (3, False)])
def test_modal_advises_a_higher_order_for_a_flat_block_of_little_damping(order, told):
    with unquestioned():
        block = Actuator(half_thickness=2e-3, damping_ratio=0.02, mount='free')
    note, = block.plan([(1.1, 0.5)], 'modal', order=order).segments[0].notes()
    assert note.endswith(': a higher robust_order leaves less') == told


def test_modal_tells_of_weak_modes_alone_and_an_actuator_without_modes_of_nothing():
    ringing = replace(paper_actuator(), modes=Modes((1.4,), (0.2,), (0.1,)))
    told = [x.plan([(1.05, 0.5)], y).segments[0].notes() for x, y in (
        (Actuator(), 'two_step'), (Actuator(mount='free'), 'modal'))]
    assert told[0] == []
    assert re.fullmatch(
        r'the move to 1\.05 by modal leaves a vibration of [\d.]+ % of the move, most of it in '
        r'weak modes at 3\.54 times the first frequency', told[1][0])
    request = MoveRequest(State(1.0), 1.1, ringing.nondimensional)
    assert remaining(request, get_shaper('modal')(request)) is None


def vibration_of(plan, begin):
    """Return the vibration that a simulation shows in a period from a time on, peak to peak."""
    seen, block = plan.simulate(rate=2e5), plan.segments[0]
    period = 2.0 * math.pi / plan.actuator.model.frequency(
        block.setpoint.stretch) * plan.actuator.model.units.time
    begin = 0.5 * period if begin is None else begin
    return np.ptp(seen.stretches[(seen.times >= begin) & (seen.times < begin + period)])


@pytest.mark.parametrize(('shape', 'mount', 'target', 'mild', 'strong'), [
    (0.3, 'free', 1.1, 2.0, 4.0), (2.0, 'free', 1.1, 10.0, 30.0), (2.0, 'glued', 0.9, 10.0, 30.0),
    (None, 'clamped', 0.3, 30.0, 100.0), *(pytest.param(*x, marks=pytest.mark.slow) for x in (
        (0.1, 'free', 0.9, 4.0, 10.0), (4.0, 'free', 1.1, 10.0, 30.0)))])
def test_minimum_time_warns_where_a_step_leaves_less(shape, mount, target, mild, strong):
    """Limits of the coil are in units of the level that holds the target."""
    with unquestioned():
        actuator = Actuator.beam(
            length=25e-3, thickness=1e-3, width=5e-3, youngs_modulus=1e6, density=2000.0,
            damping_ratio=0.03, mount=mount) if shape is None else Actuator(
            half_thickness=0.01 * shape, damping_ratio=0.05, chain_limit=5.0, mount=mount)
    step = actuator.plan([(target, 0.5)], 'step')
    by_step, held = vibration_of(step, None), abs(float(step.flux_densities[-1]))
    for push, warned in ((mild, False), (strong, True)):
        limit = push * held
        with unquestioned():
            wide = actuator.replace(flux_density_limits=limit)
        plan = wide.plan([(target, 0.5)], 'minimum_time')
        assert (vibration_of(plan, plan.move_times[0]) > by_step) == warned
        segment, = Planner(actuator.block, Options(
            shaper='minimum_time', flux_density_min=-limit, flux_density_max=limit,
        )).draft_setpoint(target, 0).segments
        assert segment.warns == warned
        assert bool(re.search(
            r'by minimum_time leaves a vibration of \d+ % .* an unshaped step \d+ %: expected '
            'the shaper modal', segment.told)) == warned


def test_damping_ratio_of_a_mounted_block_is_that_of_its_first_mode():
    block = Actuator(damping_ratio=0.05, mount='glued')
    assert block.damping_ratio == pytest.approx(0.05, rel=1e-12)
    *ringing, weak = block.block.modes.dampings
    assert ringing == pytest.approx([0.05 * x for x in block.block.modes.ratios[:-1]], rel=1e-12)
    assert weak == BROAD


def test_parameter_file_keeps_mount_and_modes(tmp_path):
    block = Actuator(half_length=5e-3, zeta=0.1, mount='free')
    block.to_yaml(tmp_path / 'block.yaml')
    assert Actuator.from_yaml(tmp_path / 'block.yaml') == block
    with pytest.raises(BadInputError, match='already has modes'):
        block.replace(mount='glued')


def test_file_of_a_mount_is_planned_with_its_modes(tmp_path, capsys, refusal):
    path = str(tmp_path / 'block.yaml')
    assert main(['init', '--half-length', '20mm', '--zeta', '0.1', '--flux-max', '400mT', '--yes',
                 '--mount', 'free', '--out', path]) == 0
    out = capsys.readouterr().out
    assert re.search(r"two_step, paper's model +leaves \d+ % of a step to 1\.1", out)
    assert main(['plan', '1.1:1', '0.95:1', '--shaper', 'modal', '--params-file', path,
                 '--json']) == 0
    plan = json.loads(capsys.readouterr().out)
    assert [x['status'] for x in plan['segments']] == ['modal', 'modal']
    assert 'mount free is given for a beam: expected paper, clamped' in refusal(
        'init --beam --length 25mm --thickness 1mm --width 5mm --yes --mount free --out',
        tmp_path / 'beam.yaml')


def test_stop_in_a_modal_move_brings_all_modes_to_rest():
    ms = 1_000_000
    planner = Planner(BLOCK, Options(
        shaper='modal', flux_density_min=-0.5, flux_density_max=0.5, lead_time=ms))
    group = PlannerGroup({'a': planner})
    draft, = group.draft_setpoint('a', 1.3, 0).values()
    group.take({'a': draft}, 0)
    stop = planner.draft_stop(5 * ms)
    last = stop.levels[-1]
    assert stop.segments[-1].arrival == last.stamp < draft.segments[-1].arrival + 10 * ms
    state = last.at(last.stamp)
    assert [state.stretch, *state.followed[::2]] == pytest.approx(
        [stop.segments[-1].stretch] * 3, abs=1e-8)
    assert [state.rate, *state.followed[1::2]] == pytest.approx([0.0] * 3, abs=1e-7)
