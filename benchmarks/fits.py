"""Reference fits of a recording with SciPy and with CasADi, for timing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import process_time

import numpy as np
from scipy.constants import mu_0
from scipy.optimize import least_squares

from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import from_coordinate, to_coordinate
from hmsa.identification.response import respond
from hmsa.model.equations import Array

# Runge-Kutta steps from one sample to the next: errors far below the noise.
_SUBSTEPS = 4


@dataclass(frozen=True)
class Fitted:
    """Values by name in SI, and the seconds of the fit without one-time setup."""

    values: dict[str, float]
    seconds: float


def with_scipy(
        recording: Measurement, start: Mapping[str, float], free: Sequence[str], *,
        derivatives: bool) -> Fitted:
    """Fit with SciPy's least squares and this package's simulation, from start values."""
    def respond_at(x: Array, names: Sequence[str] = ()):
        moved = dict(start) | {
            n: from_coordinate(n, y) for n, y in zip(free, x.tolist(), strict=True)}
        return respond(recording, moved, names)

    def residual(x: Array) -> Array:
        found = respond_at(x)
        return found.stretch - recording.stretch if found else np.full(
            len(recording.time), 1e3)

    first = np.array([to_coordinate(x, start[x]) for x in free])
    begin = process_time()
    found = least_squares(
        residual, first, method='trf', x_scale='jac',
        jac=(lambda x: respond_at(x, free).jacobian) if derivatives else '2-point')
    seconds = process_time() - begin
    return Fitted({n: from_coordinate(n, x) for n, x in zip(
        free, found.x.tolist(), strict=True)}, seconds)


def with_casadi(
        recording: Measurement, start: Mapping[str, float], free: Sequence[str]
) -> Callable[[], Fitted] | None:
    """
    Set up a fit by CasADi and IPOPT: multiple shooting with the Gauss-Newton Hessian.

    An interval starts at every sample and every switch; four Runge-Kutta steps give its end. The
    states at the starts are unknowns too, initialised from the samples.

    Parameters
    ----------
    recording : Recording
        Samples from rest without field, and levels as steps.
    start : mapping of str to float
        Start values of all quantities in SI.
    free : sequence of str
        Quantities to estimate.

    Returns
    -------
    callable or None
        The fit; None if CasADi is not installed.

    """
    try:
        import casadi
    except ImportError:
        return None
    unit = start['time_unit']
    names = list(free)
    scales = np.array([start[x] or _SCALES[x] for x in names])
    known = {x: start[x] for x in _SCALES if x not in names}
    scaled = casadi.SX.sym('parameters', len(names))
    values = known | {x: scaled[i] * scales[i] for i, x in enumerate(names)}
    creeping, lagging = 'viscoelastic_ratio' in names, 'coil_time_constant' in names
    state = casadi.SX.sym('state', 2 + creeping + lagging)
    level, gap = casadi.SX.sym('level'), casadi.SX.sym('gap')
    slope = casadi.Function('slope', [state, scaled, level], [_slope(
        casadi, state, values | {x: start[x] for x in _GEOMETRY}, level, unit, creeping, lagging)])
    after = state
    for _ in range(_SUBSTEPS):
        h = gap / _SUBSTEPS
        k1 = slope(after, scaled, level)
        k2 = slope(after + h / 2.0 * k1, scaled, level)
        k3 = slope(after + h / 2.0 * k2, scaled, level)
        k4 = slope(after + h * k3, scaled, level)
        after = after + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    move = casadi.Function('move', [state, scaled, level, gap], [after])

    inside = recording.level_times[
        (recording.level_times > recording.time[0]) & (recording.level_times < recording.time[-1])]
    grid = np.union1d(recording.time, inside)
    place = np.searchsorted(recording.level_times, grid[:-1], side='right') - 1
    sampled = np.searchsorted(grid, recording.time)
    count = len(grid)
    symbols = casadi.MX.sym('unknowns', len(names))
    states = casadi.MX.sym('states', state.numel(), count)
    ends = move.map(count - 1)(
        states[:, :-1], casadi.repmat(symbols, 1, count - 1), recording.levels[place][None, :],
        np.diff(grid)[None, :] / unit)
    bias = symbols[names.index('stretch_bias')] * scales[names.index('stretch_bias')]
    miss = (states[0, sampled.tolist()].T + bias - recording.stretch) / 1e-3
    unknowns = casadi.veccat(symbols, states)
    jacobian = casadi.jacobian(miss, unknowns)
    factor = casadi.MX.sym('factor')
    hessian = casadi.Function(
        'nlp_hess_l',
        {'x': unknowns, 'lam_f': factor,
         'hess_gamma_x_x': factor * casadi.triu(jacobian.T @ jacobian)},
        ['x', 'p', 'lam_f', 'lam_g'], ['hess_gamma_x_x'])
    solver = casadi.nlpsol(
        'fit', 'ipopt',
        {'x': unknowns, 'f': 0.5 * casadi.dot(miss, miss),
         'g': casadi.vec(states[:, 1:] - ends)},
        {'hess_lag': hessian, 'ipopt.print_level': 0, 'print_time': False, 'ipopt.sb': 'yes'})
    # At rest without field; a lagging field is 0 there too.
    resting = np.array([1.0, 0.0] + [0.0] * (creeping + lagging))
    guess = np.zeros((state.numel(), count))
    guess[0] = np.interp(grid, recording.time, recording.stretch)
    guess[1] = np.gradient(guess[0], grid) * unit
    guess[:, 0] = resting
    low, high = np.full((2, state.numel(), count), [[[-np.inf]], [[np.inf]]])
    low[:, 0] = high[:, 0] = resting
    first = np.array([start[x] for x in names]) / scales

    def pack(head: Array, table: Array) -> Array:
        return np.concatenate([head, table.ravel(order='F')])

    def run() -> Fitted:
        begin = process_time()
        found = solver(
            x0=pack(first, guess), lbg=0.0, ubg=0.0,
            lbx=pack(np.full(len(names), -np.inf), low), ubx=pack(
                np.full(len(names), np.inf), high))
        seconds = process_time() - begin
        if not solver.stats()['success']:
            raise ArithmeticError(f'IPOPT ended with {solver.stats()["return_status"]}')
        solved = np.array(found['x']).ravel()[:len(names)] * scales
        return Fitted(dict(zip(names, solved.tolist(), strict=True)), seconds)

    return run


_GEOMETRY = ('half_length', 'half_thickness', 'density')
#: Quantities of the equations: typical sizes in SI of values that may be 0.
_SCALES = {
    'shear_modulus': 1e5, 'damping_coefficient': 1.0, 'chain_limit': 5.0, 'remanence': 0.1,
    'stretch_bias': 1e-2, 'coil_time_constant': 1e-3, 'constant_force': 1e-2,
    'viscoelastic_ratio': 0.1, 'viscoelastic_time': 1e-2}


def _slope(casadi, state, values, level, unit, creeping, lagging):
    """Return the derivatives of the state with respect to time in units of ``unit``."""
    stretch, rate = state[0], state[1] / unit
    inertia = values['density'] * values['half_length'] ** 2
    c1 = 2.0 * (values['half_thickness'] / values['half_length']) ** 2
    modulus = values['shear_modulus']
    elastic = (stretch - stretch ** -2) / (
        1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / values['chain_limit'])
    field = state[2 + creeping] if lagging else level
    total = (
        values['remanence'] * field / mu_0
        + (values['constant_force'] / 4.0 / values['half_length'] ** 2)
        - modulus * elastic
        - values['damping_coefficient'] * values['half_thickness'] / (
            8.0 * values['half_length'] ** 2) * rate
        + 0.25 * inertia * rate ** 2 / stretch ** 4)
    if creeping:
        over = elastic - state[2]
        total = total - values['viscoelastic_ratio'] * modulus * over
    slopes = [rate, total / (inertia * (stretch ** -3 + c1) / 6.0) * unit]
    if creeping:
        slopes.append(over / values['viscoelastic_time'])
    if lagging:
        slopes.append((level - field) / values['coil_time_constant'])
    return casadi.vertcat(*slopes) * unit
