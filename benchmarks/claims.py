"""
Statements in the paper's text, computed: ``python -m benchmarks.claims``.

Every printed line is part of docs/validation/paper-comparison.md, which explains it.
"""

from collections.abc import Iterator, Sequence
import math
import sys

import numpy as np

from hmsa.model.equations import (
    Array,
    critical_zeta,
    Floats,
    signed_root,
    stretch_limits,
)
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import residual_vibration, simulate
from hmsa.planning.two_step import CODES, Groups, plan_two_step, plan_two_step_batch
from hmsa_studies import paper_data
from hmsa_studies.paper_data import PaperResponse

_PAPER = NondimensionalParameters(zeta=0.2, j_lim=5.0)
#: J_lim that is practically infinite: the neo-Hookean solid.
_NO_LIMIT = 1e9
#: Fraction of the step within which a response counts as settled.
_SETTLED = 0.05


def lines() -> Iterator[str]:
    """Yield the computed statements, one line per number or group; titles end in a colon."""
    for section in (
            _limits, _critical, _damping_time, _damping, _mismatch, _inequality, _residuals,
            _settling, _cycles, _extensibility):
        yield from section()


def _limits() -> Iterator[str]:
    yield 'limiting stretches:'
    for j_lim in paper_data.J_LIMS:
        lower, upper = stretch_limits(j_lim)
        yield f'  J_lim {j_lim:g}: lower {lower:.6f}, upper {upper:.6f}'


def _critical() -> Iterator[str]:
    yield 'critical damping, linearised:'
    for j_lim, name in ((1.0, '1'), (3.0, '3'), (5.0, '5'), (_NO_LIMIT, 'infinite')):
        value = float(critical_zeta(1.1, NondimensionalParameters(j_lim=j_lim)))
        yield f'  at 1.1, J_lim {name}, c1 2: {value:.4f}'
    for quoted in (2.135, 2.14, 2.145):
        # (4/c1)^2 m psi'' = zeta^2 with 6 m = l^-3 + c1 is quadratic in c1.
        stiffness = float(critical_zeta(1.1, _PAPER)) ** 2 * 6.0 / 4.0 / (1.1 ** -3 + 2.0)
        ratio = 16.0 * stiffness / 6.0 / quoted ** 2
        c1 = 0.5 * (ratio + math.sqrt(ratio * ratio + 4.0 * ratio * 1.1 ** -3))
        check = float(critical_zeta(1.1, NondimensionalParameters(j_lim=5.0, c1=c1)))
        yield f'  at 1.1, J_lim 5: {check:.3f} for c1 {c1:.4f}'
    for stretch in (1.4, 1.2, 1.0, 0.8, 0.6):
        yield f'  at {stretch:g}, J_lim 5, c1 2: {float(critical_zeta(stretch, _PAPER)):.4f}'
    release = 1.05 * float(critical_zeta(1.0, _PAPER))
    for start, target in ((0.6, 1.0), (0.9, 1.0)):
        plan = plan_two_step(start, target, NondimensionalParameters(release, 5.0))
        yield (f'  {start:g} to {target:g} at 1.05 of the linearised value: {plan.code}'
               + (f', tau_p {plan.tau_p:.4f}' if math.isfinite(plan.tau_p) else ''))


def _damping_time() -> Iterator[str]:
    yield 'tau_p over zeta, 1 to 1.1:'
    for zeta in (0.0, 0.2, 1.0, 2.0, 2.1, 2.14):
        plan = plan_two_step(1.0, 1.1, NondimensionalParameters(zeta, 5.0))
        yield (f'  zeta {zeta:g}: tau_p {plan.tau_p:.4f}, '
               f'b_p {float(signed_root(plan.beta_p)):.4f}, '
               f'b_1 {float(signed_root(plan.beta_1)):.4f}')
    plan = plan_two_step(1.0, 1.1, NondimensionalParameters(2.2, 5.0))
    yield f'  zeta 2.2: {plan.code}'


def _damping() -> Iterator[str]:
    yield 'zeta 0.02 to 1.10, shaped:'
    low, high = paper_data.ZETAS[0], paper_data.ZETAS[-1]
    for targets in (paper_data.EXPANSION, paper_data.DEEP_CONTRACTION):
        for start, target in zip((1.0, *targets), targets, strict=False):
            plans = [plan_two_step(start, target, NondimensionalParameters(zeta, 5.0))
                     for zeta in (low, high)]
            times = [x.tau_p for x in plans]
            b_p = [float(signed_root(x.beta_p)) for x in plans]
            yield (f'  {start:g} to {target:g}: tau_p {times[0]:.4f} to {times[1]:.4f} '
                   f'({times[1] / times[0] - 1.0:+.1%}), b_p {b_p[0]:.4f} to {b_p[1]:.4f} '
                   f'({b_p[1] / b_p[0] - 1.0:+.1%})')
        # Sampled at the same, evenly spaced times.
        time = np.linspace(0.0, paper_data.SPAN * len(targets), paper_data.SAMPLES)
        responses = [
            _resample(_shaped(targets, NondimensionalParameters(zeta, 5.0)), time)
            for zeta in (low, high)]
        yield (f'  {_names(targets)}: stretch differs by at most '
               f'{float(np.max(np.abs(responses[1] - responses[0]))):.4f}')


def _mismatch() -> Iterator[str]:
    yield 'residual of the command for one zeta on an actuator of another, 1 to 1.1:'
    for designed, real in ((0.2, 0.21), (0.2, 0.02), (0.2, 0.4), (0.02, 1.1)):
        plan = plan_two_step(1.0, 1.1, NondimensionalParameters(designed, 5.0))
        time = np.linspace(0.0, paper_data.SPAN, 20_001)
        stretch, _ = simulate(
            [0.0, plan.tau_p], [plan.beta_p, plan.beta_1], time,
            NondimensionalParameters(real, 5.0))
        residual = residual_vibration(
            time, stretch, arrival=plan.tau_p, end=paper_data.SPAN, step=0.1)
        yield f'  zeta {designed:g} on {real:g}: {residual:.1%} of the step'


def _inequality() -> Iterator[str]:
    yield 'signed b_p^2 against the force at the target, J_lim 5, c1 2:'
    start, target, zeta = _moves(
        np.round(np.arange(0.6, 1.65, 0.1), 2), [0.0, 0.2, 0.4, 0.8, 1.2])
    plans = plan_two_step_batch(start, target, Groups(zeta=zeta))
    planned = np.array([str(CODES[x]) == 'two_step' for x in plans.status.tolist()])
    up = target > start
    lower = plans.beta_p < plans.beta_1
    weaker = np.abs(plans.beta_p) < np.abs(plans.beta_1)
    across = (start - 1.0) * (target - 1.0) < 0.0
    away = ~across & (np.abs(target - 1.0) > np.abs(start - 1.0))
    for name, kind in (('growing', up), ('shrinking', ~up)):
        yield (f'  {name} stretch: {np.count_nonzero(kind & planned)} plans, b_p^2 below the '
               f'force in {np.count_nonzero(kind & planned & lower)}, above in '
               f'{np.count_nonzero(kind & planned & (plans.beta_p > plans.beta_1))}')
    for name, kind in (
            ('away from 1', away), ('across 1', across), ('back towards 1', ~away & ~across)):
        yield (f'  moves {name}: {np.count_nonzero(kind & planned)} plans, |b_p| below |b_1| '
               f'in {np.count_nonzero(kind & planned & weaker)}')
    for sequence in (paper_data.CONTRACTION, paper_data.SECOND_CONTRACTION):
        run = _shaped(sequence, _PAPER)
        levels = ', '.join(f'{x:.4f}' for x in signed_root(run.loads))
        yield f'  {_names(sequence)}: b {levels}'
    plan = plan_two_step(1.0, 1.1, _PAPER)
    b_p, b_1 = float(signed_root(plan.beta_p)), float(signed_root(plan.beta_1))
    yield (f'  1 to 1.1: b_p/b_1 {b_p / b_1:.4f}, flux densities B_p/B_1 '
           f'{plan.beta_p / plan.beta_1:.4f}')


def _residuals() -> Iterator[str]:
    yield 'residual vibration a setpoint, share of the step:'
    cases = (
        (paper_data.EXPANSION, _PAPER), (paper_data.SECOND_EXPANSION, _PAPER),
        (paper_data.CONTRACTION, _PAPER), (paper_data.SECOND_CONTRACTION, _PAPER),
        *((x, NondimensionalParameters(zeta, 5.0))
          for x in (paper_data.EXPANSION, paper_data.DEEP_CONTRACTION)
          for zeta in paper_data.ZETAS),
        *((paper_data.near_limit(j_lim), NondimensionalParameters(0.2, j_lim))
          for j_lim in paper_data.J_LIMS))
    for targets, material in cases:
        shaped, plain = paper_data.respond('', targets, material, samples=30_001)
        arrivals = shaped.switches[1::2]
        residuals = [[
            residual_vibration(
                run.time, run.stretch, arrival=arrival, end=(i + 1) * paper_data.SPAN,
                step=target - start)
            for i, (start, target, arrival) in enumerate(
                zip((1.0, *targets), targets, arrivals, strict=False))]
            for run in (shaped, plain)]
        yield (f'  {_names(targets)}, zeta {material.zeta:g}, J_lim {material.j_lim:g}: '
               f'shaped below {_power(max(residuals[0]))}, unshaped '
               f'{", ".join(f"{x:.0%}" for x in residuals[1])}')


def _settling() -> Iterator[str]:
    yield 'unshaped, time until within 5 % of the step, from rest:'
    for targets in (paper_data.EXPANSION, paper_data.DEEP_CONTRACTION):
        for zeta in paper_data.ZETAS:
            run = _unshaped(targets, NondimensionalParameters(zeta, 5.0), 600.0)
            times = (f'{end - begin:.1f}' for begin, end in _unsettled(run, 600.0))
            yield f'  {_names(targets)}, zeta {zeta:g}: {", ".join(times)}'


def _cycles() -> Iterator[str]:
    yield 'unshaped, cycles until within 5 % of the step, from rest:'
    for j_lim in paper_data.J_LIMS:
        targets = paper_data.near_limit(j_lim)
        run = _unshaped(targets, NondimensionalParameters(0.2, j_lim), 60.0)
        counts = (f'{run.turning_points(*part) / 2:g}' for part in _unsettled(run, 60.0))
        yield f'  J_lim {j_lim:g}, {_names(targets)}: {", ".join(counts)}'


def _unshaped(
        targets: Sequence[float], material: NondimensionalParameters,
        span: float) -> PaperResponse:
    """Return the response to unshaped steps with durations so long that each starts from rest."""
    run, = paper_data.respond(
        '', targets, material, commands=('unshaped',), span=span, samples=30_001)
    return run


def _unsettled(run: PaperResponse, span: float) -> list[tuple[float, float]]:
    """Return for each setpoint its start and the time after which the response stays close."""
    parts = []
    for i, (start, target) in enumerate(zip((1.0, *run.targets), run.targets, strict=False)):
        begin, end = i * span, (i + 1) * span
        outside = (
            (run.time > begin) & (run.time < end)
            & (np.abs(run.stretch - target) > _SETTLED * abs(target - start)))
        parts.append((begin, float(run.time[outside][-1])))
    return parts


def _extensibility() -> Iterator[str]:
    yield 'J_lim 0.5 to 10:'
    sweep = paper_data.chain_limit_sweep()
    for shown in paper_data.J_LIMS:
        i = int(np.searchsorted(sweep.j_lim, shown))
        yield (f'  1 to 1.2, J_lim {shown:g}: tau_p {sweep.tau_p[i]:.4f}, '
               f'b_p {float(signed_root(sweep.beta_p[i])):.4f}, '
               f'b_1 {float(signed_root(sweep.beta_1[i])):.4f}')
    j_lim = np.linspace(*paper_data.J_LIM_RANGE, 200)
    start, target, zeta = _moves(np.round(np.arange(0.7, 1.45, 0.1), 2), [0.0, 0.2, 1.0])
    plans = plan_two_step_batch(
        start[:, None], target[:, None], Groups(zeta=zeta[:, None], j_lim=j_lim))
    rises = np.all(np.diff(plans.tau_p, axis=1) > 0.0, axis=1)
    falls = np.all(np.diff(np.abs(plans.beta_p), axis=1) < 0.0, axis=1)
    holding = np.all(np.diff(np.abs(plans.beta_1), axis=1) < 0.0, axis=1) | (target == 1.0)
    across = (start - 1.0) * (target - 1.0) < 0.0
    yield f'  tau_p rises all the way in {np.count_nonzero(rises)} of {rises.size} cases'
    yield (f'  |b_1| falls all the way (or is 0) in {np.count_nonzero(holding)} of '
           f'{holding.size} cases')
    yield (f'  |b_p| falls all the way in {np.count_nonzero(falls & ~across)} of '
           f'{np.count_nonzero(~across)} cases that stay on one side of 1, and in '
           f'{np.count_nonzero(falls & across)} of {np.count_nonzero(across)} that cross it')
    crossing = plan_two_step_batch(0.8, 1.2, Groups(zeta=0.2, j_lim=[0.5, 10.0]))
    b_p = signed_root(crossing.beta_p)
    yield f'  0.8 to 1.2, zeta 0.2: b_p {b_p[0]:.4f} at J_lim 0.5, {b_p[1]:.4f} at 10'


def _moves(stretches: Array, zetas: Sequence[float]) -> tuple[Array, Array, Array]:
    """Return start, target and zeta of all moves between the stretches."""
    start, target, zeta = np.meshgrid(stretches, stretches, zetas, indexing='ij')
    moves = start != target
    return start[moves], target[moves], zeta[moves]


def _shaped(targets: Sequence[float], material: NondimensionalParameters) -> PaperResponse:
    run, = paper_data.respond('', targets, material, commands=('shaped',))
    return run


def _resample(run: PaperResponse, time: Floats) -> Array:
    stretch, _ = simulate(run.switches, run.loads, time, run.material)
    return stretch


def _names(targets: Sequence[float]) -> str:
    return ', '.join(f'{x:.4g}' for x in targets)


def _power(value: float) -> str:
    """Return the power of ten above a value, since a rounding error varies."""
    return f'1e{max(math.ceil(math.log10(value)), -9)}' if value > 0.0 else '1e-9'


def main() -> int:
    """Print every claim and return 0."""
    for line in lines():
        print(line, flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
