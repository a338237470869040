"""The equations: derived again from the Lagrangian, differentiated, inverted, linearised."""

import math

from core_oracle import follow
from extras import needs
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from plants import acceleration_si
import pytest
from scipy.constants import mu_0

from hmsa.model import equations
from hmsa.model.parameters import (
    ActuatorParameters,
    NondimensionalParameters,
    paper_actuator,
)
from hmsa.model.simulation import simulate

mpmath = needs('mpmath')

EPS = np.finfo(float).eps
PAPER = NondimensionalParameters()
# A block with H != L, so that no symbol stands in for another.
BLOCK = ActuatorParameters(
    shear_modulus=1.3e4, density=2100.0, half_length=0.011, half_thickness=0.004,
    remanence=0.13, chain_limit=3.7, damping_coefficient=0.9)
RANDOM_STATES = 200


def inside(j_lim: float, share: np.ndarray) -> np.ndarray:
    """Return stretches at fractions of the admissible interval."""
    lower, upper = equations.stretch_limits(j_lim)
    return lower + (upper - lower) * share


# -- Eqs. 7 to 11 -------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def derivation():
    """Derive Eqs. 10 and 11 from the integrals and the energies of the paper."""
    sympy = needs('sympy')
    l, v, a, b = sympy.symbols('l v a B', real=True)  # noqa: E741
    rho, half_l, half_h, shear, j_lim, remanence, c, mu = sympy.symbols(
        'rho L H G J Br c mu', positive=True)
    x1, x2, x3 = sympy.symbols('X1 X2 X3', real=True)
    t = sympy.symbols('t', real=True)
    motion = sympy.Function('l')(t)
    # Eq. 7 from the motion of Eq. 1, over the reference block of constant mass.
    squares = sum(
        sympy.diff(x, t) ** 2 for x in (
            x1 / sympy.sqrt(motion), x2 / sympy.sqrt(motion), motion * x3))
    squares = squares.subs(sympy.diff(motion, t), v).subs(motion, l)
    kinetic = sympy.integrate(
        rho / 2 * squares, (x1, -half_l, half_l), (x2, -half_l, half_l),
        (x3, -half_h, half_h))
    printed = (sympy.Rational(2, 3) * rho * half_h * half_l ** 4 * v ** 2 / l ** 3
               + sympy.Rational(4, 3) * rho * half_l ** 2 * half_h ** 3 * v ** 2)
    # Eqs. 8 and 9.
    potential = -8 * half_h * half_l ** 2 * (
        shear * j_lim / 2 * sympy.log(1 - (2 / l + l ** 2 - 3) / j_lim)
        + l * remanence * b / mu)
    dissipation = c * v ** 2 * half_h ** 2 / 2
    # Eq. 6.
    lagrangian = printed - potential
    momentum = sympy.diff(lagrangian, v)
    balance = (sympy.diff(momentum, v) * a + sympy.diff(momentum, l) * v
               - sympy.diff(lagrangian, l) + sympy.diff(dissipation, v))
    acceleration = sympy.solve(balance, a)[0]
    # Nondimensional: time in L sqrt(rho/G), load Br B/(mu0 G), zeta and c1.
    zeta, c1, load, w = sympy.symbols('zeta c1 beta w', real=True)
    unit = half_l * sympy.sqrt(rho / shear)
    reduced = acceleration.subs({
        v: w / unit, b: load * mu * shear / remanence,
        c: 8 * zeta * half_l * half_h * sympy.sqrt(rho * shear)}) * unit ** 2
    reduced = sympy.simplify(reduced.subs(half_h, half_l * sympy.sqrt(c1 / 2)))
    return {
        'kinetic': sympy.simplify(kinetic - printed),
        'si': sympy.lambdify(
            (l, v, b, rho, half_l, half_h, shear, j_lim, remanence, c, mu), acceleration),
        'free': reduced.free_symbols - {l, w, load, zeta, c1, j_lim},
        'reduced': sympy.lambdify((l, w, load, zeta, c1, j_lim), reduced),
    }


@pytest.fixture
def states():
    """Return stretches, rates and loads throughout the admissible region."""
    random = np.random.default_rng(11)
    return (inside(BLOCK.chain_limit, random.uniform(0.01, 0.99, RANDOM_STATES)),
            random.normal(0.0, 2.0, RANDOM_STATES), random.normal(0.0, 5.0, RANDOM_STATES))


def closeness(found, expected, stretch, rate, load, material):
    """Return the difference in units of the largest term of Eq. 11."""
    inertia = 1.0 + material.c1 * stretch ** 3
    left = 1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / material.j_lim
    largest = (np.abs(1.5 * rate ** 2 / stretch)
               + np.abs(3.0 * material.zeta * material.c1 * stretch ** 3 * rate)
               + 6.0 * np.abs((stretch ** 4 + stretch) / left / np.minimum(left, 1.0))
               + 6.0 * np.abs(load) * stretch ** 3) / inertia
    return np.abs(found - expected) / largest


def test_the_kinetic_energy_is_the_integral_over_the_block(derivation):
    assert derivation['kinetic'] == 0


def test_scaling_leaves_zeta_c1_and_j_lim_alone_in_the_equation(derivation):
    assert derivation['free'] == set()


def test_acceleration_is_what_the_lagrangian_gives(derivation, states):
    stretch, rate, load = states
    material = BLOCK.nondimensional
    expected = derivation['reduced'](
        stretch, rate, load, material.zeta, material.c1, material.j_lim)
    found = equations.acceleration(stretch, rate, load, material)
    assert np.max(closeness(found, expected, stretch, rate, load, material)) < 20 * EPS


def test_acceleration_in_si_is_what_the_lagrangian_gives(derivation, states):
    stretch, rate, load = states
    rate = rate / BLOCK.time_unit
    flux_density = load * BLOCK.flux_density_unit
    expected = derivation['si'](
        stretch, rate, flux_density, BLOCK.density, BLOCK.half_length, BLOCK.half_thickness,
        BLOCK.shear_modulus, BLOCK.chain_limit, BLOCK.remanence, BLOCK.damping_coefficient,
        mu_0)
    found = acceleration_si(stretch, rate, flux_density, BLOCK)
    unit = BLOCK.time_unit
    close = closeness(
        found * unit ** 2, expected * unit ** 2, stretch, rate * unit, load,
        BLOCK.nondimensional)
    assert np.max(close) < 50 * EPS


def test_the_integration_is_of_the_same_acceleration(states):
    # A time short enough for the Taylor series: v(h) - v(-h) over 2 h, the load included.
    material = BLOCK.nondimensional
    h = 1e-4
    for stretch, rate, load in zip(*(x[:40] for x in states), strict=True):
        _, rates = simulate(
            [0.0], [load], [h, 2 * h, 3 * h, 4 * h], material, stretch=stretch, rate=rate)
        expected = float(equations.acceleration(stretch, rate, load, material))
        slope = (-25.0 / 12.0 * rate + 4.0 * rates[0] - 3.0 * rates[1] + 4.0 / 3.0 * rates[2]
                 - 0.25 * rates[3]) / h
        room = min(stretch - equations.stretch_limits(material.j_lim)[0],
                   equations.stretch_limits(material.j_lim)[1] - stretch)
        assert slope == pytest.approx(expected, rel=1e-6, abs=1e-6 / room ** 2)


# -- derivatives, energy ------------------------------------------------------------------------


@pytest.mark.parametrize('j_lim', [0.01, 1.0, 5.0, 1e6])
def test_force_and_stiffness_are_derivatives_of_the_energy(j_lim):
    shares = np.concatenate([[1e-5, 1e-3], np.linspace(0.05, 0.95, 13), [1 - 1e-3, 1 - 1e-5]])
    with mpmath.workdps(50):
        limit = mpmath.mpf(j_lim)

        def energy(x):
            return -limit / 2 * mpmath.log(1 - (2 / x + x * x - 3) / limit)

        for stretch in inside(j_lim, shares):
            exact = mpmath.mpf(float(stretch))
            lower, upper = equations.stretch_limits(j_lim)
            # Rounding of the stretch itself, near a limit, is all that may be left.
            loss = 16 * EPS * (1.0 + stretch / min(stretch - lower, upper - stretch))
            values = (
                (equations.elastic_energy, energy(exact)),
                (equations.elastic_force, mpmath.diff(energy, exact)),
                (equations.elastic_stiffness, mpmath.diff(energy, exact, 2)))
            for function, expected in values:
                tolerance = 3.0 * loss * (1.0 + abs(float(expected)))
                assert abs(function(stretch, j_lim) - float(expected)) < tolerance


def test_energy_is_lost_at_the_rate_of_the_damper():
    for zeta, start, rate, load in (
            (0.2, 1.0, 0.0, 0.3), (1.1, 0.6, 2.0, -0.5), (0.0, 2.5, -1.0, 1.0)):
        material = NondimensionalParameters(zeta=zeta)
        times = np.linspace(0.0, 3.0, 1501)
        stretch, speed = simulate([0.0], [load], times, material, stretch=start, rate=rate)
        energy = equations.energy(stretch, speed, load, material)
        power = equations.damping(material) * speed ** 2
        step = times[1] - times[0]
        # Simpson's rule over pairs of intervals.
        lost = step / 3.0 * np.cumsum(power[:-2:2] + 4.0 * power[1:-1:2] + power[2::2])
        assert np.max(np.abs(energy[2::2] - energy[0] + lost)) < 1e-9 * np.ptp(speed) ** 2
        if zeta == 0.0:
            assert np.ptp(energy) < 1e-12 * (1.0 + np.max(speed) ** 2)


# -- limits and equilibrium ---------------------------------------------------------------------


@pytest.mark.parametrize('j_lim', [*10.0 ** np.arange(-3.0, 7.0), 0.3, 3.0, 5.0])
def test_stretch_limits_are_the_roots_on_both_sides(j_lim):
    with mpmath.workdps(40):
        roots = sorted(
            mpmath.re(x) for x in mpmath.polyroots(
                [1, 0, -(3 + mpmath.mpf(float(j_lim))), 2], maxsteps=200, extraprec=200))
        lower, upper = (float(x) for x in roots[1:])
    found = equations.stretch_limits(float(j_lim))
    assert found[0] == pytest.approx(lower, rel=4 * EPS * (1.0 + 1.0 / math.sqrt(j_lim)))
    assert found[1] == pytest.approx(upper, rel=4 * EPS * (1.0 + 1.0 / math.sqrt(j_lim)))
    assert 0.0 < found[0] < 1.0 < found[1]


@pytest.mark.parametrize('j_lim', [0.01, 1.0, 3.0, 5.0, 1e3, 1e6])
def test_equilibrium_inverts_the_load_over_the_whole_interval(j_lim):
    lower, upper = equations.stretch_limits(j_lim)
    shares = np.linspace(0.001, 0.999, 401)
    gaps = 10.0 ** np.arange(-12.0, -2.0)
    stretch = np.concatenate([
        inside(j_lim, shares), lower + gaps * lower, upper - gaps * upper])
    stretch = stretch[(stretch > lower) & (stretch < upper)]
    load = equations.elastic_force(stretch, j_lim)
    found = equations.equilibrium_stretch(load, j_lim)
    # The load's own rounding moves the stretch by load/stiffness, at most by an ulp or two.
    assert np.max(np.abs(found - stretch) / stretch) < 8 * EPS
    assert np.all((found > lower) & (found < upper))


@pytest.mark.parametrize('j_lim', [0.01, 5.0, 1e6])
def test_equilibrium_of_tiny_loads_is_linear(j_lim):
    load = np.array([1e-300, 1e-20, 1e-12, 1e-8, -1e-8, -1e-12, -1e-20, -1e-300, 0.0])
    found = equations.equilibrium_stretch(load, j_lim)
    # psi''(1) = 3.
    assert np.max(np.abs(found - 1.0 - load / 3.0)) <= 1e-15
    assert found[-1] == 1.0


@pytest.mark.parametrize('load', [1e3, 1e6, 1e9, 1e12, -1e3, -1e6, -1e9, -1e12])
def test_equilibrium_of_a_huge_load_stays_inside_the_limits(load):
    for j_lim in (0.01, 1.0, 5.0, 1e4):
        lower, upper = equations.stretch_limits(j_lim)
        found = float(equations.equilibrium_stretch(load, j_lim))
        # Far beyond what doubles tell apart it is the limit itself.
        assert lower * (1 - 2 * EPS) <= found <= upper * (1 + 2 * EPS)


def test_the_field_is_signed_in_contraction():
    stretch = np.array([0.6, 0.9, 1.0, 1.1, 1.4])
    load = equations.elastic_force(stretch, 5.0)
    assert np.array_equal(np.sign(load), [-1.0, -1.0, 0.0, 1.0, 1.0])
    b = equations.signed_root(load)
    assert np.array_equal(np.sign(b), np.sign(load))
    assert b * np.abs(b) == pytest.approx(load, rel=4 * EPS)
    # Eq. 11 with b^2 = b |b| is in balance there.
    assert np.max(np.abs(equations.acceleration(stretch, 0.0, b * np.abs(b), PAPER))) < 1e-13


# -- linearised motion --------------------------------------------------------------------------


@pytest.mark.parametrize('j_lim', [1.0, 3.0, 5.0])
@pytest.mark.parametrize('c1', [0.1, 2.0, 30.0])
@pytest.mark.parametrize('zeta', [0.0, 0.2, 1.0, 6.0])
def test_linearised_motion_has_the_eigenvalues_of_the_jacobian(j_lim, c1, zeta):
    material = NondimensionalParameters(zeta=zeta, j_lim=j_lim, c1=c1)
    for stretch in inside(j_lim, np.array([0.1, 0.3, 0.5, 0.9])):
        with mpmath.workdps(40):
            rho = mpmath.mpf(float(stretch))
            limit, shape, damper = mpmath.mpf(j_lim), mpmath.mpf(c1), mpmath.mpf(zeta)
            load = (rho - rho ** -2) / (1 - (2 / rho + rho ** 2 - 3) / limit)

            def motion(x, v, load=load, limit=limit, shape=shape, damper=damper):
                left = 1 - (2 / x + x ** 2 - 3) / limit
                return (1.5 * v ** 2 / x - 3 * damper * shape * x ** 3 * v
                        - 6 * ((x ** 4 - x) / left - load * x ** 3)) / (1 + shape * x ** 3)

            by_stretch = mpmath.diff(lambda x: motion(x, 0), rho)  # noqa: B023
            by_rate = mpmath.diff(lambda v: motion(rho, v), 0)  # noqa: B023
            discriminant = by_rate ** 2 / 4 + by_stretch
        frequency = float(equations.natural_frequency(stretch, material))
        assert frequency ** 2 == pytest.approx(float(-by_stretch), rel=1e-12)
        critical = float(equations.critical_zeta(stretch, material))
        assert (zeta < critical) == (discriminant < 0)
        if zeta > 0.0:
            # The discriminant vanishes where zeta is the critical one.
            share = float(by_rate ** 2 / 4 / -by_stretch)
            assert (zeta / critical) ** 2 == pytest.approx(share, rel=1e-11)


def test_small_oscillations_have_the_natural_frequency():
    material = NondimensionalParameters(zeta=0.0)
    for stretch in (0.7, 1.0, 1.9):
        frequency = float(equations.natural_frequency(stretch, material))
        load = float(equations.elastic_force(stretch, 5.0))
        period = 2.0 * math.pi / frequency
        start = stretch * (1.0 + 1e-6)
        end = follow((start, 0.0), [(period, load)], 0.0, 5.0, 2.0)
        assert end[0] == pytest.approx(start, abs=1e-10)
        assert abs(end[1]) < 1e-10


# -- shapes, parameters -------------------------------------------------------------------------


def test_functions_take_scalars_and_broadcast_arrays():
    stretch = np.linspace(0.8, 1.3, 4)[:, None]
    rate = np.linspace(-1.0, 1.0, 3)
    table = equations.acceleration(stretch, rate, 0.2, PAPER)
    assert table.shape == (4, 3)
    assert table.dtype == np.float64
    assert table[2, 1] == pytest.approx(float(equations.acceleration(
        float(stretch[2, 0]), float(rate[1]), 0.2, PAPER)), rel=1e-14)
    assert equations.energy(stretch, rate, 0.2, PAPER).shape == (4, 3)
    assert equations.equilibrium_stretch([[0.1, -0.1]], 5.0).shape == (1, 2)
    assert float(equations.elastic_force(1, 5)) == 0.0
    for function in (
            equations.elastic_energy, equations.elastic_force, equations.elastic_stiffness):
        assert np.shape(function(1.2, 5.0)) == ()
        assert function(stretch, 5.0).shape == (4, 1)
    assert np.shape(equations.signed_root(-4)) == ()
    assert float(equations.signed_root(-4)) == -2.0


def test_elastic_energy_is_not_a_number_beyond_the_limits():
    lower, upper = equations.stretch_limits(5.0)
    assert np.all(np.isnan(equations.elastic_energy([0.9 * lower, 1.1 * upper], 5.0)))


@settings(max_examples=100, deadline=None)
@given(zeta=st.floats(0.0, 50.0), j_lim=st.floats(1e-2, 1e6), c1=st.floats(1e-2, 1e2),
       shear_modulus=st.floats(1e2, 1e7), density=st.floats(1e2, 1e4),
       half_length=st.floats(1e-5, 1.0), remanence=st.floats(1e-3, 2.0))
def test_parameters_survive_the_way_to_si_and_back(
        zeta, j_lim, c1, shear_modulus, density, half_length, remanence):
    material = NondimensionalParameters(zeta, j_lim, c1)
    actuator = ActuatorParameters.from_nondimensional(
        material, shear_modulus=shear_modulus, density=density, half_length=half_length,
        remanence=remanence)
    back = actuator.nondimensional
    assert back.zeta == pytest.approx(zeta, rel=8 * EPS)
    assert back.j_lim == j_lim
    assert back.c1 == pytest.approx(c1, rel=8 * EPS)
    again = ActuatorParameters.from_nondimensional(
        back, shear_modulus=shear_modulus, density=density, half_length=half_length,
        remanence=remanence)
    for name in ('half_thickness', 'damping_coefficient', 'time_unit', 'flux_density_unit'):
        assert getattr(again, name) == pytest.approx(getattr(actuator, name), rel=16 * EPS)


def test_the_default_block_has_the_scale_that_the_notes_give():
    actuator = paper_actuator()
    assert actuator.time_unit == pytest.approx(4.36e-3, abs=5e-6)
    assert actuator.half_thickness == actuator.half_length
    flux_density = float(equations.elastic_force(1.4, 5.0)) * actuator.flux_density_unit
    assert flux_density == pytest.approx(0.12, abs=2e-3)
