"""A beam of one mode, from the equations of docs/explanation/beam.md with SciPy only."""

from functools import cache
import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from hmsa.interfaces.actuator import actuator_from
from hmsa.interfaces.parameters import BLOCK
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import MU_0

# A strip of silicone with 20 % of magnetised powder, in SI.
YOUNGS, LENGTH, WIDTH, THICKNESS, DENSITY, REMANENCE = 1e6, 0.025, 0.005, 0.001, 2000.0, 0.1
DAMPING = 2e-4
AREA, BENDING = WIDTH * THICKNESS, YOUNGS * WIDTH * THICKNESS ** 3 / 12.0


def silicone(**changes: float) -> ActuatorParameters:
    """Return the strip, with changed parameters."""
    return actuator_from({x.name: x.default for x in BLOCK} | {
        'law.name': 'beam', 'law.youngs_modulus': YOUNGS, 'law.width': WIDTH,
        'actuator.half_length': LENGTH / 2, 'actuator.half_thickness': THICKNESS / 2,
        'actuator.density': DENSITY, 'actuator.remanence': REMANENCE,
        'actuator.damping_coefficient': DAMPING} | changes)


@cache
def mode():
    """Return nodes and weights of Simpson's rule along the beam, and the slope of its mode."""
    root = brentq(lambda x: math.cos(x) * math.cosh(x) + 1.0, 1.5, 2.2, xtol=1e-15)
    s = np.linspace(0.0, 1.0, 2001)
    weights = np.full(2001, 2.0)
    weights[1::2] = 4.0
    weights[[0, -1]] = 1.0
    x = root * s
    ratio = (math.cosh(root) + math.cos(root)) / (math.sinh(root) + math.sin(root))
    slope = np.sinh(x) + np.sin(x) - ratio * (np.cosh(x) - np.cos(x))
    curved = root * (np.cosh(x) + np.cos(x) - ratio * (np.sinh(x) + np.sin(x)))
    return s, weights / 6000.0, slope / slope[-1], curved / slope[-1], root


def _up_to(values):
    """Return the integral from the clamp to each node, by cubics through neighbours."""
    s = mode()[0]
    return CubicSpline(s, values).antiderivative()(s)


def _of_angle(q):
    """Return kinetic mass, stiffness, lever of the field and deflection at an angle, in SI."""
    _, w, f, curved, _ = mode()
    across, along = (_up_to(part(q * f) * f) for part in (np.cos, np.sin))
    return (
        DENSITY * AREA * LENGTH ** 3 * (w @ (across ** 2 + along ** 2)),
        BENDING / LENGTH * (w @ curved ** 2),
        REMANENCE / MU_0 * AREA * LENGTH * (w @ (np.cos(q * f) * f)),
        w @ np.sin(q * f))


@cache
def _series():
    """Return mass, lever and deflection as Chebyshev series of the angle, and the stiffness."""
    nodes = 1.6 * np.cos(np.pi * (np.arange(49) + 0.5) / 49)
    values = np.array([_of_angle(x) for x in nodes])
    return [np.polynomial.Chebyshev.fit(nodes, values[:, i], 40, domain=[-1.6, 1.6])
            for i in (0, 2, 3)], values[0, 1]


def slope(modulus=1.0, damping=1.0, remanence=1.0, force=0.0):
    """Return the right-hand side in the angle, for parameter factors and a force in N."""
    (mass, lever, across), stiffness = _series()
    by_angle = across.deriv()
    change, held = mass.deriv(), damping * DAMPING * (LENGTH * by_angle(0.0)) ** 2
    return lambda _, z, flux: [z[1], (
        remanence * flux * lever(z[0]) + force * LENGTH * by_angle(z[0])
        - modulus * stiffness * z[0] - held * z[1]
        - 0.5 * change(z[0]) * z[1] ** 2) / mass(z[0])]


def follow(deflection, pieces):
    """Return deflection and rate after pieces of (s, T), from rest, using the tip angle."""
    across = _series()[0][2]
    end = np.array([brentq(lambda q: across(q) - deflection, -1.5, 1.5, xtol=1e-15), 0.0])
    for duration, flux in pieces:
        end = solve_ivp(
            slope(), (0.0, duration), end, method='DOP853', rtol=1e-12, atol=1e-13,
            args=(flux,)).y[:, -1]
    return across(end[0]), across.deriv()(end[0]) * end[1]


def sampled(times, level_times, levels, **changes):
    """Return noise-free deflections at times under levels in T, from rest."""
    motion = slope(**changes)
    rest = brentq(lambda q: motion(0.0, [q, 0.0], levels[0])[1], -1.5, 1.5, xtol=1e-15)
    across = _series()[0][2]
    found, state = np.empty(len(times)), np.array([rest, 0.0])
    ends = np.append(level_times[1:], times[-1] + 1e-9)
    for begin, end, flux in zip(level_times, ends, levels, strict=True):
        inside = (times >= begin) & (times < end)
        solved = solve_ivp(
            motion, (begin, end), state, method='DOP853', rtol=1e-9, atol=1e-11,
            args=(flux,), dense_output=True)
        found[inside] = across(solved.sol(times[inside])[0])
        state = solved.y[:, -1]
    return found
