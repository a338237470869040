"""
Data of Figs. 2 to 10 of the paper (Polymers 2022, 14, 3037), computed with this package.

All quantities are dimensionless as in the paper: time in L sqrt(rho/G), b = sqrt(Br B/(mu0 G))
with the sign of the field. Constants here define parameters that the paper does not state.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from hmsa.files import write_rows
from hmsa.model.equations import Array, critical_zeta, signed_root, stretch_limits
from hmsa.model.moves import Setpoint
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import simulate
from hmsa.model.status import Code
from hmsa.planning.sequence import plan_sequence, Segment
from hmsa.planning.two_step import CODES, Groups, plan_two_step_batch

#: Duration of each setpoint, as stated in the paper.
SPAN = 10.0
#: The sequence of Figs. 4, 5 and 7; also used for Fig. 2, whose levels the paper does not state.
EXPANSION = (1.10, 1.20, 1.40)
SECOND_EXPANSION = (1.15, 1.25, 1.35)
CONTRACTION = (0.90, 0.80, 0.70)
SECOND_CONTRACTION = (0.85, 0.70, 0.85)
DEEP_CONTRACTION = (0.90, 0.80, 0.60)
#: Fig. 3 shows one move; the paper does not state which.
SINGLE = (1.10,)
ZETAS = (0.02, 0.40, 1.10)
J_LIMS = (1.0, 3.0, 5.0)
#: Third stretch of Fig. 9 relative to the limiting stretch. The paper only states that it is near.
#: For much nearer ones, the unshaped step, unlike the shaped one, cannot be simulated: it would
#: swing closer to the limit than double precision resolves.
NEAR_LIMIT = 0.95
#: Range of Fig. 10.
J_LIM_RANGE = (0.5, 10.0)
SAMPLES = 1201
SWEEP_POINTS = 1000

_PAPER = NondimensionalParameters(zeta=0.2, j_lim=5.0)
_BOTH = ('shaped', 'unshaped')
# Difference beta_1 - beta_p at which Fig. 8 ends, as it is then a rounding error.
_RESOLVED = 1e-12
# Factor on the sampling rate near the limiting stretch, where the response is faster.
_FASTER = 5


@dataclass(frozen=True)
class PaperResponse:
    """A response of the actuator."""

    name: str  #: distinguishes it in its figure, for instance ``zeta 0.02``
    command: str  #: ``shaped``, ``unshaped`` or ``b_p alone``
    material: NondimensionalParameters
    targets: tuple[float, ...]
    switches: Array  #: shape (m,): start times of the levels
    loads: Array  #: shape (m,): the levels beta
    time: Array  #: shape (n,), like stretch and rate; includes every switch
    stretch: Array
    rate: Array

    @property
    def load(self) -> Array:
        """The load at each sample."""
        level = np.searchsorted(self.switches, self.time, side='right') - 1
        return np.asarray(self.loads[level])

    def turning_points(self, begin: float, end: float) -> int:
        """Count the reversals between two times; two per cycle."""
        part = self.rate[(self.time > begin) & (self.time < end)]
        return int(np.count_nonzero(np.diff(np.signbit(part))))


@dataclass(frozen=True)
class PaperSweep:
    """The first move of a sequence over a parameter, zeta or j_lim."""

    start: float
    target: float
    zeta: Array  #: shape (n,), like all arrays
    j_lim: Array
    status: tuple[str, ...]  #: ``two_step`` if there is a plan
    tau_p: Array  #: NaN without a plan, as are the loads
    beta_p: Array
    beta_1: Array
    critical: float  #: linearised critical zeta at the target; NaN if zeta does not vary


Data = tuple[PaperResponse, ...] | PaperSweep


def respond(
        name: str, targets: Sequence[float], material: NondimensionalParameters, *,
        commands: Sequence[str] = _BOTH, span: float = SPAN,
        samples: int = SAMPLES, faster: int = 1) -> tuple[PaperResponse, ...]:
    """Compute the response to targets of a given duration, from rest; one run per command."""
    # With at least 2 evenly spaced samples, denser by a factor in the last setpoint.
    setpoints = [Setpoint(x, span) for x in targets]
    runs = []
    for command in commands:
        shaper = 'step' if command == 'unshaped' else 'two_step'
        segments = plan_sequence(setpoints, material, shaper=shaper)
        switches, loads = _levels(segments)
        if command == 'b_p alone':
            switches, loads = switches[:1], loads[:1]
        end = span * len(setpoints)
        fine = np.linspace(0.0, end, faster * (samples - 1) + 1)
        even = np.concatenate((fine[::faster], fine[fine > end - span]))
        time = np.union1d(even, switches)
        stretch, rate = simulate(switches, loads, time, material)
        runs.append(PaperResponse(
            name, command, material, tuple(targets), switches, loads, time, stretch, rate))
    return tuple(runs)


def _levels(segments: Sequence[Segment]) -> tuple[Array, Array]:
    levels = [(x.begin + level.time, level.load) for x in segments for level in x.move.levels]
    times, loads = np.array(levels).T
    return times, loads


def _respond_all(
        sequences: Sequence[Sequence[float]], commands: Sequence[str],
        samples: int = SAMPLES) -> tuple[PaperResponse, ...]:
    """Compute the responses of the paper's block to sequences, with a number of samples each."""
    return tuple(
        run for targets in sequences for run in respond(
            _names(targets), targets, _PAPER, commands=commands, samples=samples))


def _names(targets: Sequence[float]) -> str:
    return ', '.join(f'{x:g}' for x in targets)


# Figs. 2 to 6 by number of samples per run: one sequence or two.
multi_step = partial(_respond_all, (EXPANSION,), ('unshaped',))
single_move = partial(_respond_all, (SINGLE,), (*_BOTH, 'b_p alone'))
shaped_multi_step = partial(_respond_all, (EXPANSION,), _BOTH)
expansion = partial(_respond_all, (EXPANSION, SECOND_EXPANSION), _BOTH)
contraction = partial(_respond_all, (CONTRACTION, SECOND_CONTRACTION), _BOTH)


def damping_cases(samples: int = SAMPLES) -> tuple[PaperResponse, ...]:
    """Compute Fig. 7: three values of zeta in expansion, then contraction, shaped and unshaped."""
    return tuple(
        run for targets in (EXPANSION, DEEP_CONTRACTION) for zeta in ZETAS
        for run in respond(
            f'zeta {zeta:.2f}, {_names(targets)}', targets,
            NondimensionalParameters(zeta=zeta, j_lim=5.0), samples=samples))


def damping_sweep(points: int = SWEEP_POINTS) -> PaperSweep:
    """Compute Fig. 8: tau_p over zeta for 1 -> 1.1, while b_p differs from b_1 numerically."""
    start, target = 1.0, EXPANSION[0]
    critical = float(critical_zeta(target, _PAPER))
    near = critical * np.linspace(0.9, 1.1, 4001)
    plans = plan_two_step_batch(start, target, Groups(zeta=near, j_lim=_PAPER.j_lim, c1=_PAPER.c1))
    ended = [
        CODES[status] in (Code.TOO_DAMPED, Code.INDISTINGUISHABLE) or difference < _RESOLVED
        for status, difference in zip(
            plans.status.tolist(), (plans.beta_1 - plans.beta_p).tolist(), strict=True)]
    last = near[ended.index(True) - 1]
    zeta = last * (1.0 - np.linspace(1.0, 0.0, points) ** 1.5)
    return _sweep(start, target, zeta, np.full(points, _PAPER.j_lim), critical)


def near_limit(j_lim: float) -> tuple[float, ...]:
    """Return the stretches of Fig. 9."""
    return (1.2, 1.4, NEAR_LIMIT * stretch_limits(j_lim)[1])


def chain_limit_cases(samples: int = SAMPLES) -> tuple[PaperResponse, ...]:
    """Compute Fig. 9: three values of J_lim, the last setpoint near the limiting stretch."""
    runs: list[PaperResponse] = []
    for j_lim in J_LIMS:
        runs += respond(
            f'J_lim {j_lim:g}', near_limit(j_lim),
            NondimensionalParameters(zeta=0.2, j_lim=j_lim), samples=samples, faster=_FASTER)
    return tuple(runs)


def chain_limit_sweep(points: int = SWEEP_POINTS) -> PaperSweep:
    """Compute Fig. 10: tau_p and b_p over J_lim for 1 -> 1.2, including those of Fig. 9."""
    j_lim = np.union1d(np.linspace(*J_LIM_RANGE, points), J_LIMS)
    return _sweep(1.0, 1.2, np.full(j_lim.size, _PAPER.zeta), j_lim, float('nan'))


def _sweep(start: float, target: float, zeta: Array, j_lim: Array, critical: float) -> PaperSweep:
    plans = plan_two_step_batch(start, target, Groups(zeta=zeta, j_lim=j_lim, c1=_PAPER.c1))
    status = tuple(str(CODES[x]) for x in plans.status.tolist())
    return PaperSweep(
        start, target, zeta, j_lim, status, plans.tau_p, plans.beta_p, plans.beta_1, critical)


_RUN_COLUMNS = (
    'run', 'command', 'zeta [1]', 'J_lim [1]', 'tau [L sqrt(rho/G)]', 'b [1]',
    'beta [mu0 G/Br]', 'stretch [1]', 'stretch_rate [sqrt(G/rho)/L]')
_SWEEP_COLUMNS = (
    'start_stretch [1]', 'target_stretch [1]', 'zeta [1]', 'J_lim [1]', 'tau_p [L sqrt(rho/G)]',
    'b_p [1]', 'b_1 [1]', 'beta_p [mu0 G/Br]', 'beta_1 [mu0 G/Br]',
    'status')


def write_csv(path: Path, data: Data) -> None:
    """Write a figure's data in full precision, by rows; loads apply from their time on."""
    if isinstance(data, PaperSweep):
        write_rows(path, [_SWEEP_COLUMNS, *_rows(
            data.zeta, data.j_lim, data.tau_p, signed_root(data.beta_p),
            signed_root(data.beta_1), data.beta_p, data.beta_1, data.status,
            fixed=(data.start, data.target))])
        return
    write_rows(path, [_RUN_COLUMNS, *chain.from_iterable(_rows(
        run.time, signed_root(run.load), run.load, run.stretch, run.rate,
        fixed=(run.name, run.command, run.material.zeta, run.material.j_lim)) for run in data)])


def _rows(
        *columns: Array | tuple[str, ...],
        fixed: tuple[str | float, ...]) -> Iterator[tuple[str | float, ...]]:
    plain = (x if isinstance(x, tuple) else x.tolist() for x in columns)
    for row in zip(*plain, strict=True):
        yield *fixed, *row
