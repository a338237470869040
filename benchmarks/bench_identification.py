"""Compare identification with the Cramer-Rao bound; check its coverage; measure its speed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import process_time

import numpy as np

from benchmarks.fits import Fitted, with_casadi, with_scipy
from benchmarks.sheet import Sheet
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import DEFAULT_FREE, derivative, values_of
from hmsa.identification.response import respond, Response
from hmsa.model.equations import Array, elastic_force
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.planning.two_step import plan_two_step

BLOCK = paper_actuator()
SPAN = 10.0 * BLOCK.time_unit
SEQUENCE = (1.1, 1.4, 1.0)
DURATION = 2.0
RUNS, ROBUST_RUNS, QUICK_RUNS = 200, 40, 4
LARGEST_RATIO = 1.2
LEAST_COVERAGE, LARGEST_COVERAGE = 0.93, 0.97
_CHANCE = 1e-4


def levels_of(shaped: bool, repeats: int) -> tuple[Array, Array]:
    """Return times and levels of a sequence."""
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


def _simulated(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str] = (), *,
        rtol: float = 1e-12) -> Response:
    found = respond(recording, values, free, rtol=rtol)
    assert found is not None, 'the motion meets the limits of the chains'
    return found


def compare(*, quick: bool = False, runs: int = RUNS) -> Sheet:
    """Identify many simulated runs."""
    from scipy.stats import binom, chi2  # slow to import
    runs = QUICK_RUNS if quick else runs
    # Bounds that one row in ten thousand misses by chance.
    ratio = LARGEST_RATIO * np.sqrt(chi2.ppf(1.0 - _CHANCE, runs) / runs)
    least = binom.ppf(_CHANCE, runs, LEAST_COVERAGE) / runs
    most = binom.ppf(1.0 - _CHANCE, runs, LARGEST_COVERAGE) / runs
    rows: list[list[str]] = []
    figures, passed = {}, True
    for name, shaped, repeats in (
            ('one unshaped sequence', False, 1), ('unshaped, repeated', False, 15),
            ('shaped, repeated', True, 15)):
        for noise in (1e-3, 1e-4):
            for rate in (1000, 200, 60):
                cell = _cell(levels_of(shaped, repeats), noise, rate, runs, len(rows))
                good = bool(cell.failed == 0 and np.max(cell.ratios) <= ratio and least <= np.min(
                    cell.coverage) <= np.max(cell.coverage) <= most)
                rows.append([
                    f'{name}, {noise:g}, {rate} Hz',
                    f'{np.min(cell.ratios):.2f} to {np.max(cell.ratios):.2f}',
                    f'{100.0 * np.min(cell.coverage):.0f} to {100.0 * np.max(cell.coverage):.0f}',
                    f'{100.0 * np.mean(cell.coverage):.1f}', str(cell.failed),
                    f'{1e3 * np.median(cell.times):.0f}'])
                figures[rows[-1][0]] = {
                    'ratios': cell.ratios.tolist(), 'coverage': cell.coverage.tolist(),
                    'failed': cell.failed, 'median_time': float(np.median(cell.times)),
                    'good': good}
                passed = passed and (good or quick and cell.failed == 0)
    wide, narrow = (sum(x) for x in zip(*(
        (np.mean(x['coverage']) > LARGEST_COVERAGE, np.mean(x['coverage']) < LEAST_COVERAGE)
        for x in figures.values()), strict=True))
    return Sheet(
        'identification',
        f'Accuracy of G, c, J_lim, Br and bias in {runs} runs of 2 s each',
        ['sequence, noise, rate', 'error over bound', 'coverage [%]', 'all [%]',
         'not identified', 'processor [ms]'], rows, figures, passed, [
             'Start values have errors of 30 %. The sensor gain is given.',
             '*Error over bound*: root mean square error over the Cramer-Rao bound, from the best '
             f'to the worst parameter. With {runs} runs, a limit of {LARGEST_RATIO:g} allows '
             f'{ratio:.2f} by chance.',
             '*Coverage*: fraction of the 95 % intervals that contain the true value, from the '
             f'worst to the best parameter. Limits of {100.0 * LEAST_COVERAGE:.0f} and '
             f'{100.0 * LARGEST_COVERAGE:.0f} % allow {100.0 * least:.0f} to '
             f'{100.0 * most:.0f} % by chance.',
             f'*All*: the same over all parameters. {wide} of the {len(rows)} rows are above '
             f'{100.0 * LARGEST_COVERAGE:.0f} %, and {narrow} below '
             f'{100.0 * LEAST_COVERAGE:.0f} %.'])


@dataclass(frozen=True, eq=False)
class _Cell:
    """Results of many runs of one kind, by parameter and with durations."""

    ratios: Array
    coverage: Array
    times: list[float]
    failed: int


def _cell(
        levels: tuple[Array, Array], noise: float, rate: int, runs: int, place: int) -> _Cell:
    """Identify runs of one kind; ``place`` seeds their noise."""
    times = np.arange(int(DURATION * rate), dtype=np.float64) / rate
    values = values_of(BLOCK)
    blank = Measurement(times, np.linspace(1.0, 1.5, len(times), dtype=np.float64), *levels)
    exact = _simulated(blank, values, DEFAULT_FREE)
    scale = np.array([abs(derivative(x, values[x])) for x in DEFAULT_FREE])
    bound = scale * noise * np.sqrt(np.diag(np.linalg.inv(exact.jacobian.T @ exact.jacobian)))
    true = np.array([values[x] for x in DEFAULT_FREE])
    errors, inside, durations, failed = [], [], [], 0
    for seed in range(runs):
        random = np.random.default_rng((place, seed))
        stretch = exact.stretch + noise * random.standard_normal(len(times))
        start = _off(random)
        begin = process_time()
        # The gain is exact and given: an unknown gain widens intervals.
        found = identify(
            Measurement(times, stretch, *levels), actuator=start, known={'stretch_gain': 1.0})
        durations.append(process_time() - begin)
        if found.verdict != 'identified':
            failed += 1
            continue
        estimates = [found.parameters[x] for x in DEFAULT_FREE]
        errors.append(np.array([x.value for x in estimates]) - true)
        inside.append([x.low <= y <= x.high for x, y in zip(estimates, true, strict=True)])
    if not errors:
        nothing = np.full(len(DEFAULT_FREE), np.nan)
        return _Cell(nothing, nothing, durations, failed)
    return _Cell(
        np.sqrt(np.mean(np.square(errors), axis=0)) / bound, np.mean(inside, axis=0), durations,
        failed)


def _off(random: np.random.Generator, factor: float = np.exp(0.3)) -> ActuatorParameters:
    """Return the block with parameters changed by up to a factor; J_lim and remanence by 1.35."""
    size = np.log(factor)
    return replace(
        BLOCK, shear_modulus=BLOCK.shear_modulus * np.exp(random.uniform(-size, size)),
        remanence=BLOCK.remanence * np.exp(random.uniform(-0.3, 0.3)),
        chain_limit=BLOCK.chain_limit * np.exp(random.uniform(-0.3, 0.3)),
        damping_coefficient=BLOCK.damping_coefficient * np.exp(random.uniform(-size, size)))


def _spoilt(kind: str, clean: Array, random: np.random.Generator) -> Array:
    """Return samples with noise of 1e-3 and the defects of a sensor."""
    n = len(clean)
    white = 1e-3 * random.standard_normal(n)
    if kind == _CORRELATED:
        from scipy.signal import lfilter  # slow to import
        return clean + np.sqrt(1.0 - 0.9 ** 2) * lfilter([1.0], [1.0, -0.9], white)
    if kind == _PIXELS:
        pixel = 0.8 / 255.0
        return np.round((clean + white) / pixel) * pixel
    if kind == _LOST:
        lost = random.choice(n, n // 100, replace=False)
        white[lost] += random.choice([-1.0, 1.0], len(lost)) * random.uniform(0.05, 0.5, len(lost))
    if kind == _JUMPS:
        for begin in random.choice(n // 10, n // 500, replace=False) * 10:
            white[begin:begin + 5] += random.choice([-1.0, 1.0]) * random.uniform(0.05, 0.5)
    return clean + white


_FAR, _LOST, _JUMPS, _CORRELATED, _PIXELS, _JITTER, _LARGE_JITTER = (
    'start values wrong by up to a factor of 10', '1 % outliers of 0.05 to 0.5',
    '1 % outliers, jumps of five samples', 'correlated noise, 0.9 from sample to sample',
    'steps of 8 bits, 0.0031 of stretch', 'timestamps with jitter of 5 us',
    'timestamps with jitter of 20 us')
_ERRORS = {_JITTER: 5e-6, _LARGE_JITTER: 2e-5}


def robustness(*, quick: bool = False, runs: int = ROBUST_RUNS) -> Sheet:
    """Identify simulated runs with bad samples or bad start values."""
    runs = QUICK_RUNS if quick else min(runs, ROBUST_RUNS)
    levels = levels_of(False, 15)
    times = np.arange(int(1000 * DURATION), dtype=np.float64) * 1e-3
    blank = Measurement(times, np.linspace(1.0, 1.5, len(times), dtype=np.float64), *levels)
    values = values_of(BLOCK)
    true = np.array([values[x] for x in DEFAULT_FREE])
    exact = _simulated(blank, values, rtol=1e-10).stretch
    plain = [identify(Measurement(times, _spoilt(
        '', exact, np.random.default_rng(seed)), *levels)).parameters for seed in range(runs)]
    rows, figures = [], {}
    for kind in ('nothing but white noise', _FAR, _LOST, _JUMPS, _CORRELATED, _PIXELS, *_ERRORS):
        scores, moves, widths, verdicts = [], [], [], []
        for seed in range(runs):
            random = np.random.default_rng(seed)
            late = _ERRORS.get(kind, 0.0) * random.standard_normal(len(times))
            at = replace(blank, time=np.maximum(times + late, 0.0))
            clean = _simulated(at, values, rtol=1e-10).stretch
            spoilt = _spoilt(kind, clean, np.random.default_rng(seed))
            start = _off(random, 10.0) if kind == _FAR else _off(random)
            found = identify(Measurement(times, spoilt, *levels), actuator=start)
            verdicts.append(found.verdict)
            if found.verdict == 'not_identifiable':
                continue
            one, other = (
                [x[y] for y in DEFAULT_FREE] for x in (found.parameters, plain[seed]))
            value, std = (np.array([getattr(x, y) for x in one]) for y in ('value', 'std'))
            scores.append((value - true) / std)
            moves.append(np.max(np.abs(value - [x.value for x in other]) / std))
            widths.append(np.mean(std / [x.std for x in other]))
        counts = [verdicts.count(x) for x in ('identified', 'not_identifiable', 'model_rejected')]
        biases = np.mean(scores, axis=0) if scores else np.full(len(DEFAULT_FREE), np.nan)
        row = [float('nan')] * 5 if not scores else [
            float(biases[np.argmax(np.abs(biases))]),
            float(np.sqrt(np.mean(np.square(scores)))), 100.0 * float(np.mean(
                np.abs(scores) < 1.96)), float(np.median(widths)), float(np.max(moves))]
        rows.append([kind, ' / '.join(map(str, counts)), *(
            f'{x:.{n}f}' for x, n in zip(row, (2, 2, 0, 2, 2), strict=True))])
        figures[kind] = {'verdicts': counts, 'runs': runs, 'row': row, 'biases': biases.tolist()}
    return Sheet(
        'identification_robustness',
        f'Disturbed recordings: {runs} runs each of 2 s at 1 kHz, repeated unshaped steps, noise '
        '0.001',
        ['disturbance', 'identified / not identifiable / rejected', 'bias', 'error, rms',
         'covered by 95 % [%]', 'intervals wider by', 'largest change [std]'], rows, figures,
        legend=[
            '*Bias*: mean error of the worst parameter, in reported standard deviations; '
            f'{1.0 / np.sqrt(runs):.2f} by chance.',
            '*Error*: root mean square over all parameters, in reported standard deviations.',
            '*Wider by* and *largest change*: width of the intervals, and largest change of a '
            'value, relative to the same runs with white noise alone.'])


_REPEATS = 6


def speed(*, quick: bool = False) -> Sheet:
    """Time identification beside fits by SciPy and by CasADi with IPOPT."""
    nine = (*DEFAULT_FREE, 'coil_time_constant', 'constant_force', 'viscoelastic_ratio',
            'viscoelastic_time')
    others = {'coil_time_constant': 5e-4, 'viscoelastic_ratio': 0.1,
              'viscoelastic_time': 2.0 * BLOCK.time_unit}
    levels = levels_of(False, 15)
    times = np.arange(2000, dtype=np.float64) * 1e-3
    rows, figures, shooting = [], {}, []
    for free, known in ((DEFAULT_FREE, {}), (nine, others)):
        blank = Measurement(times, np.linspace(1.0, 1.5, len(times), dtype=np.float64), *levels)
        values = values_of(BLOCK, known)
        clean = _simulated(blank, values).stretch
        recording = Measurement(
            times, clean + 1e-3 * np.random.default_rng(0).standard_normal(len(times)), *levels)
        start = values | {x: 1.1 * values[x] for x in free}

        def ours(recording=recording, free=free) -> Fitted:
            begin = process_time()
            found = identify(recording, free=free)
            return Fitted(dict(found.values), process_time() - begin)

        def scipy_fit(derivatives, recording=recording, start=start, free=free) -> Fitted:
            return with_scipy(recording, start, free, derivatives=derivatives)

        ways: dict[str, Callable[[], Fitted] | None] = {
            'this package': ours, 'SciPy least_squares': partial(scipy_fit, False),
            'SciPy least_squares with our derivatives': partial(scipy_fit, True),
            'CasADi, IPOPT': with_casadi(recording, start, free)}
        reference = identify(recording, free=free).parameters
        for name, run in ways.items():
            if run is None:
                continue
            if name.startswith('CasADi'):
                shooting = ['*CasADi*: multiple shooting (Runge-Kutta, Gauss-Newton), without its '
                            'set-up.']
            found = [run() for _ in range(2 if quick else _REPEATS)][1:]
            apart = max(
                abs(found[0].values[x] - reference[x].value) / reference[x].std for x in free)
            spent = [x.seconds for x in found]
            rows.append([f'{len(free)} parameters, {name}', f'{1e3 * min(spent):.0f}',
                         f'{1e3 * np.median(spent):.0f}', f'{apart:.2f}'])
            figures[rows[-1][0]] = {'seconds': spent, 'apart': apart}
    return Sheet(
        'identification_speed',
        'Processor time to identify 2 s at 1 kHz',
        ['', 'least [ms]', 'median [ms]', 'apart [std]'], rows, figures, legend=[
            '*This package*: start values, fit, diagnosis and intervals; of nine parameters, also '
            'whether secondary modes would explain the samples as well as lag, force and creep.',
            '*SciPy*: the fit alone, of the same simulation, from values with errors of 10 %.',
            *shooting, '*Apart*: difference of the results in standard deviations.'])
