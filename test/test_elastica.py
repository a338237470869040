"""A beam along its elastica with its second mode, against closed forms and an exact rod."""

from dataclasses import replace
import math
import re

from beam_oracle import silicone
import numpy as np
import pytest
from scipy.integrate import solve_bvp
from test_continuum import rest_by_modal

from benchmarks.beam_rod import FIRST, Rod
from hmsa import Actuator
from hmsa.cli import main
from hmsa.errors import BadInputError, UnusualWarning
from hmsa.interfaces.actuator import parameters_of
from hmsa.model import equations, law
from hmsa.model.continuum import clamped
from hmsa.model.delivery import Delivery
from hmsa.model.laws import elastica
from hmsa.model.moves import Level, State
from hmsa.model.simulation import observed, sampled
from hmsa.model.status import Code
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest

pytestmark = pytest.mark.thorough

STRIP = silicone(**{'law.shape': 'elastica'})
# Time scale of the rod in that of the strip, whose first frequency is sqrt(3).
UNIT = FIRST / math.sqrt(3.0)


def beam(ratio, modes=True):
    """Return the strip with a damping ratio, and the second mode."""
    critical = float(equations.critical_zeta(0.0, STRIP.nondimensional))
    made = replace(STRIP, damping_coefficient=ratio * critical * STRIP.damping_unit)
    return (replace(made, modes=clamped(ratio)) if modes else made).nondimensional


def held(deflection):
    """Return the load of the rod under which the strip has a deflection."""
    return float(
        equations.elastic_force(deflection, STRIP.nondimensional)) / elastica.FIRST_SHARE


# -- statics and modes --------------------------------------------------------------------------

@pytest.mark.parametrize('deflection', [0.05, -0.3, 0.6, 0.78])
def test_a_field_holds_the_deflection_that_the_elastica_has(deflection):
    force, s = held(deflection), np.linspace(0.0, 1.0, 50)
    solved = solve_bvp(
        lambda _, z: np.vstack([z[1], -force * np.cos(z[0]), np.sin(z[0])]),
        lambda a, b: np.array([a[0], b[1], a[2]]), s,
        deflection * np.vstack([1.4 * np.sin(np.pi * s / 2), 1.4 * (1.0 - s), s ** 2]),
        tol=1e-9, max_nodes=20000)
    assert solved.success
    assert solved.y[2, -1] == pytest.approx(deflection, rel=1e-7)


def test_second_mode_of_a_straight_beam_is_that_of_euler_and_bernoulli():
    root, first = 4.694091132974175, 1.8751040687119611
    found = elastica.second_mode()
    assert found.ratio == pytest.approx((root / first) ** 2, rel=1e-9)
    # Of a force at the tip, each mode has the share 12/root^4.
    assert found.share == pytest.approx(12.0 / root ** 4, rel=1e-9)


@pytest.mark.parametrize('deflection', [0.0, 0.4, -0.6, 0.75])
def test_small_motion_about_any_bent_state_has_the_frequencies_of_the_rod(deflection):
    material, aside = beam(0.0), 1e-5
    load = held(deflection)
    wanted = Rod(0.0, 16).frequencies(load)[:2] * (1.0 / UNIT)
    assert float(equations.natural_frequency(deflection, material)) == pytest.approx(
        wanted[0], rel=2e-4)
    # The second mode alone, from its displacement.
    times = np.linspace(0.0, 4.0 * math.pi / wanted[1], 400)
    state = State(deflection, 0.0, load * elastica.FIRST_SHARE, None, (deflection + aside, 0.0))
    rows = sampled([Level(0.0, state.load)], state, times, material)
    assert rows[3] - deflection == pytest.approx(
        aside * np.cos(wanted[1] * times), abs=0.02 * aside)


def test_tables_agree_with_twice_the_polynomials_and_have_no_jumps(monkeypatch):
    packed = np.array(elastica.packed())
    monkeypatch.setattr(elastica, '_TERMS', 2 * elastica._TERMS)
    monkeypatch.setattr(elastica, '_POINTS', 2 * elastica._POINTS)
    rows = packed[8:].reshape(int(packed[0]), -1)
    at = rows[1:, 0]
    exact = elastica._Rod().states(at)
    straight = elastica._Rod().states(np.array([1e-7]))[:, 0]
    exact[:2] *= elastica.FIRST_SHARE
    exact[1:] /= straight[1:, None]
    before, after = (
        np.array([[np.polynomial.polynomial.polyval(u - row[0], row[2 + 8 * i:10 + 8 * i])
                   for i in range(8)] for u, row in zip(at, some, strict=True)]).T
        for some in (rows[:-1], rows[1:]))
    assert before == pytest.approx(after, rel=1e-9, abs=1e-9)
    assert after == pytest.approx(exact, rel=1e-9, abs=1e-9)


# -- motion -------------------------------------------------------------------------------------

def test_motion_without_damping_keeps_the_energy_of_its_lagrangian():
    material, load = beam(0.0), 2.5
    start = State(0.35, 0.3, load, None, (0.36, 0.5))
    rows = sampled([Level(0.0, load)], start, np.linspace(0.0, 6.0, 60), material)
    u, v, _, y, rate = rows
    size = np.abs(u)
    states = elastica._Rod().states(size)
    straight = elastica._Rod().states(np.array([1e-7]))[:, 0]
    share = elastica.FIRST_SHARE
    _, inertia, _, g, h, square, _, _ = states
    # In units of the rod; a and y - u are related by the share of a straight beam in u'.
    a, a_rate = (y - u) * straight[4], (rate - v) * UNIT * straight[4]
    moved = v * UNIT
    force = np.array([float(x) for x in equations.elastic_force(u, material)]) / share
    energy = np.array([float(x) for x in equations.elastic_energy(u, material)]) / share
    total = (
        0.5 * (1.0 - g * h) * inertia * moved ** 2 + 0.5 * (a_rate + h * moved) ** 2 + energy
        - load / share * u - (load / share - force) * g * a + 0.5 * square * a ** 2)
    assert np.ptp(u) > 0.3
    assert total == pytest.approx(total[0], abs=1e-7 * np.ptp(energy))


def test_what_a_two_step_command_leaves_is_predicted_about_a_bent_state():
    rod, start, target = Rod(0.01, 8), 0.45, 0.6
    move = get_shaper('two_step')(MoveRequest(State(start), target, beam(0.01)))
    period = 2.0 * math.pi / rod.frequencies(held(target))[0]
    begin, end = (x.time / UNIT for x in move.levels)
    times, deflections = rod.follow(held(start), [
        (end - begin, move.levels[0].load / elastica.FIRST_SHARE), (period, held(target))], 300)
    material, after = beam(0.01), np.flatnonzero(times > end)[1:]
    at = times[after] * UNIT
    seen, speed = observed(sampled(move.levels, State(start), at, material), material)
    # The third mode is not predicted.
    assert np.ptp(seen) == pytest.approx(np.ptp(deflections[after]), rel=0.3)
    # The rate is that of the stretch.
    assert speed[5:-5] == pytest.approx(np.gradient(seen, at)[5:-5], abs=0.03 * np.ptp(speed))


@pytest.mark.parametrize(('start', 'target', 'ratio'), [
    (0.0, 0.3, 0.02), (0.5, -0.7, 0.05), *(pytest.param(*x, marks=pytest.mark.slow) for x in (
        (0.71, 0.5, 0.02), (0.7, 0.05, 0.05)))])
def test_modal_moves_a_rod_between_bent_states_without_vibration_or_offset(start, target, ratio):
    rod, step = Rod(ratio, 8), abs(target - start)
    two, move = (
        get_shaper(x)(MoveRequest(State(start), target, beam(ratio, x == 'modal')))
        for x in ('two_step', 'modal'))
    assert move.duration <= 1.35 * two.duration
    levels = [(x.time / UNIT, x.load / elastica.FIRST_SHARE) for x in move.levels]
    period = 2.0 * math.pi / rod.frequencies(held(target))[0]
    ends = [*(x for x, _ in levels[1:]), levels[-1][0] + 2.0 * period]
    times, deflections = rod.follow(held(start), [
        (end - begin, load) for (begin, load), end in zip(levels, ends, strict=True)], 300)
    first, last = (
        deflections[(times > ends[-1] - x * period) & (times <= ends[-1] - (x - 1.0) * period)]
        for x in (2.0, 1.0))
    assert np.ptp(first) < 0.01 * step
    assert last.mean() == pytest.approx(target, abs=1e-3 * step)


def test_modal_takes_at_most_1_3_times_as_long_as_two_steps_to_any_bent_state():
    random = np.random.default_rng(4)
    moves = [(0.0, 0.724), (0.07, 0.724), *random.uniform(-0.724, 0.724, (60, 2)).tolist()]
    for ratio in (0.005, 0.02, 0.08):
        for start, target in moves:
            two, move = (
                get_shaper(x)(MoveRequest(State(start), target, beam(ratio, x == 'modal')))
                for x in ('two_step', 'modal'))
            assert move.code is Code.MODAL
            assert move.duration <= 1.3 * two.duration


@pytest.mark.parametrize('delivery', [
    Delivery(), Delivery(period=0.05), Delivery(slew=6.0), Delivery(lag=0.1),
    Delivery(period=0.04, slew=8.0, lag=0.05)], ids=['ideal', 'grid', 'ramps', 'lag', 'all'])
def test_modal_brings_both_modes_of_a_beam_to_rest_from_rest_and_from_motion(delivery):
    rest_by_modal(
        beam(0.05), 0.0, np.random.default_rng(3).uniform(-0.7, 0.7, 12), 1e-8, delivery)


# -- parameters ---------------------------------------------------------------------------------

def test_shape_of_the_first_mode_is_the_beam_as_before_and_is_not_said():
    assert silicone(**{'law.shape': 'mode'}) == silicone()
    assert 'law.shape' not in parameters_of(silicone())
    assert parameters_of(STRIP)['law.shape'] == 'elastica'


def test_other_shape_or_mount_is_refused_in_a_sentence():
    with pytest.raises(BadInputError, match="law.shape is 'arc': expected mode or elastica"):
        silicone(**{'law.shape': 'arc'})
    with pytest.raises(BadInputError, match='clamped is given for a block: expected paper, free'):
        Actuator(mount='clamped')


def test_clamped_beam_rests_by_modal_and_keeps_its_modes_in_a_file(tmp_path, capsys):
    path = tmp_path / 'strip.yaml'
    assert main(['init', '--beam', '--length', '25mm', '--thickness', '1mm', '--width', '5mm',
                 '--youngs-modulus', '1MPa', '--damping-ratio', '0.02', '--flux-max', '30mT',
                 '--yes', '--mount', 'clamped', '--out', str(path)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"mode's shape +leaves 1.\d % of a step to 0.3, and rests 1.9 % off", out)
    with pytest.warns(UnusualWarning, match='sags by 0.44 of its length'):
        strip = Actuator.from_yaml(path)
    assert strip.damping_ratio == pytest.approx(0.02, rel=1e-12)
    strip.to_yaml(path)
    with pytest.warns(UnusualWarning, match='sags by 0.44 of its length'):
        assert Actuator.from_yaml(path) == strip
    setpoints = [(0.6, 1.0), (0.4, 1.0), (-0.1, 1.0)]
    left = {x: strip.plan(setpoints, x).simulate().report()['residual'] for x in (
        'two_step', 'modal')}
    assert min(left['two_step']) > 0.003
    assert max(left['modal']) < 1e-6
    assert float(law.elastic_force(0.3, strip.model.material.packed)) == pytest.approx(
        float(equations.elastic_force(0.3, STRIP.nondimensional)), rel=1e-12)
