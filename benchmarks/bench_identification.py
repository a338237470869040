"""How near identification comes to the Cramer-Rao bound, how its intervals cover, how fast."""

from time import perf_counter

import numpy as np
from scipy.optimize import least_squares

from benchmarks.sheet import Sheet
from hmsa_ros.core.model import Array, elastic_force
from hmsa_ros.core.parameters import paper_actuator
from hmsa_ros.core.two_step import plan_two_step
from hmsa_ros.identification import identify, Recording
from hmsa_ros.identification.quantities import (
    DEFAULT_FREE,
    derivative,
    from_coordinate,
    to_coordinate,
    values_of,
)
from hmsa_ros.identification.response import respond

BLOCK = paper_actuator()
SPAN = 10.0 * BLOCK.time_unit
SEQUENCE = (1.1, 1.4, 1.0)
DURATION = 2.0
RUNS, QUICK_RUNS = 200, 4
LARGEST_RATIO = 1.2


def levels_of(shaped: bool, repeats: int) -> tuple[Array, Array]:
    """
    Return times and levels of a sequence.

    Parameters
    ----------
    shaped : bool
        Whether moves are two-step commands; else plain steps.
    repeats : int
        Of the sequence 1.1, 1.4, 1.

    Returns
    -------
    times, levels : ndarray
        In s and T.

    """
    rows, start, now = [(-0.02, 0.0)], 1.0, 0.0
    for target in SEQUENCE * repeats:
        hold = float(elastic_force(target, BLOCK.nondimensional)) * BLOCK.flux_density_unit
        if shaped:
            plan = plan_two_step(start, target, BLOCK.nondimensional)
            rows += [(now, plan.beta_p * BLOCK.flux_density_unit),
                     (now + plan.tau_p * BLOCK.time_unit, hold)]
        else:
            rows.append((now, hold))
        start, now = target, now + SPAN
    table = np.array(rows)
    return table[:, 0].copy(), table[:, 1].copy()


def compare(*, quick: bool = False) -> Sheet:
    """
    Identify many simulated runs.

    Parameters
    ----------
    quick : bool
        Few runs.

    Returns
    -------
    Sheet
        Ratio of the errors to the bound, and coverage.

    """
    runs = QUICK_RUNS if quick else RUNS
    rows, figures, passed = [], {}, True
    for name, shaped, repeats in (
            ('one plain pass', False, 1), ('plain, repeated', False, 15),
            ('shaped, repeated', True, 15)):
        for noise in (1e-3, 1e-4):
            for rate in (1000, 200, 60):
                ratios, coverage, times, failed = _cell(
                    levels_of(shaped, repeats), noise, rate, runs)
                rows.append([
                    f'{name}, {noise:g}, {rate} Hz', *(f'{x:.2f}' for x in ratios),
                    f'{100.0 * coverage:.1f}', str(failed), f'{1e3 * np.median(times):.0f}'])
                figures[rows[-1][0]] = {
                    'ratios': ratios.tolist(), 'coverage': coverage, 'failed': failed,
                    'median_time': float(np.median(times))}
                passed = passed and bool(failed == 0 and (
                    quick or np.max(ratios) <= LARGEST_RATIO))
    return Sheet(
        'identification',
        f'Root mean square error over the Cramer-Rao bound, and coverage of the 95 % intervals; '
        f'{runs} runs of 2 s each, start values 30 % off',
        ['sequence, noise, rate', 'G', 'c', 'J_lim', 'Br', 'bias', 'coverage [%]', 'failed',
         'median [ms]'], rows, figures, passed)


def _cell(
        levels: tuple[Array, Array], noise: float, rate: int, runs: int
) -> tuple[Array, float, list[float], int]:
    """Return ratios to the bound, coverage, times and failures of one kind of run."""
    times = np.arange(int(DURATION * rate)) / rate
    values = values_of(BLOCK)
    blank = Recording(times, np.linspace(1.0, 1.5, len(times)), *levels)
    exact = respond(blank, values, DEFAULT_FREE, rtol=1e-12)
    scale = np.array([abs(derivative(x, values[x])) for x in DEFAULT_FREE])
    bound = scale * noise * np.sqrt(np.diag(np.linalg.inv(exact.jacobian.T @ exact.jacobian)))
    true = np.array([values[x] for x in DEFAULT_FREE])
    errors, inside, durations, failed = [], [], [], 0
    for seed in range(runs):
        random = np.random.default_rng(seed)
        stretch = exact.stretch + noise * random.standard_normal(len(times))
        start = _off(random)
        begin = perf_counter()
        found = identify(Recording(times, stretch, *levels), actuator=start)
        durations.append(perf_counter() - begin)
        if found.verdict != 'identified':
            failed += 1
            continue
        estimates = [found.parameters[x] for x in DEFAULT_FREE]
        errors.append(np.array([x.value for x in estimates]) - true)
        inside.append([x.low <= y <= x.high for x, y in zip(estimates, true, strict=True)])
    if not errors:
        return np.full(len(DEFAULT_FREE), np.nan), float('nan'), durations, failed
    ratios = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    return ratios, float(np.mean(inside)), durations, failed


def _off(random: np.random.Generator):
    """Return the block with parameters up to 30 % off."""
    from dataclasses import replace

    factors = np.exp(random.uniform(-0.3, 0.3, 4))
    return replace(
        BLOCK, shear_modulus=BLOCK.shear_modulus * factors[0],
        remanence=BLOCK.remanence * factors[1], chain_limit=BLOCK.chain_limit * factors[2],
        damping_coefficient=BLOCK.damping_coefficient * factors[3])


def speed(*, quick: bool = False) -> Sheet:
    """
    Time identification beside SciPy's least squares on the same simulation.

    Parameters
    ----------
    quick : bool
        Few runs.

    Returns
    -------
    Sheet
        Least and median times for five and nine parameters.

    """
    nine = (*DEFAULT_FREE, 'coil_time_constant', 'constant_force', 'viscoelastic_ratio',
            'viscoelastic_time')
    others = {'coil_time_constant': 5e-4, 'viscoelastic_ratio': 0.1,
              'viscoelastic_time': 2.0 * BLOCK.time_unit}
    levels = levels_of(False, 15)
    times = np.arange(2000) * 1e-3
    rows, figures = [], {}
    for free, known in ((DEFAULT_FREE, {}), (nine, others)):
        blank = Recording(times, np.linspace(1.0, 1.5, len(times)), *levels)
        values = values_of(BLOCK, known)
        clean = respond(blank, values, (), rtol=1e-12).stretch
        recording = Recording(
            times, clean + 1e-3 * np.random.default_rng(0).standard_normal(len(times)), *levels)
        start = np.array([to_coordinate(x, values[x]) for x in free])
        start = start + 0.1 * np.where(np.abs(start) > 1.0, 1.0, np.abs(start))

        def residual(x, free=free, values=values, recording=recording):
            moved = values | {n: from_coordinate(n, y) for n, y in zip(free, x, strict=True)}
            found = respond(recording, moved, ())
            return found.stretch - recording.stretch if found else np.full(len(times), 1e3)

        def scipy_fit(start=start, residual=residual):
            least_squares(residual, start, method='trf', x_scale='jac')

        def ours(recording=recording, free=free):
            identify(recording, free=free)

        for name, run in (('this package', ours), ('SciPy least_squares', scipy_fit)):
            run()
            found = []
            for _ in range(2 if quick else 12):
                begin = perf_counter()
                run()
                found.append(perf_counter() - begin)
            rows.append([f'{len(free)} parameters, {name}', f'{1e3 * min(found):.0f}',
                         f'{1e3 * np.median(found):.0f}'])
            figures[rows[-1][0]] = found
    return Sheet(
        'identification_speed',
        'Time of 2 s at 1 kHz: here start values, fit, diagnosis and intervals; there the '
        'fit alone, from 10 % off, by finite differences of the same simulation',
        ['', 'least [ms]', 'median [ms]'], rows, figures)
