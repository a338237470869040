"""Recordings of an actuator, simulated with SciPy only, for identification."""

from dataclasses import dataclass
from functools import lru_cache
import math

from core_oracle import integrate
import numpy as np
from scipy.constants import mu_0
from scipy.optimize import brentq

from hmsa.model.parameters import ActuatorParameters, paper_actuator

BLOCK = paper_actuator()


@dataclass(frozen=True)
class Extras:
    """Properties of the actuator besides the block, in SI."""

    coil: float = 0.0
    ratio: float = 0.0
    time: float = 0.01
    force: float = 0.0
    bias: float = 0.0
    gain: float = 1.0
    power: tuple = (1.0, 1.0)  # flow of the branches: exponent, and stress over G
    more: tuple = ()  # pairs of ratio and time of further branches
    law: tuple = ()  # name and constants in Pa of a law other than Gent's


def _held(block: ActuatorParameters, law: tuple):
    """Return the stress dW/dl in Pa as a function of the stretch, for a law or Gent's."""
    name, *c = law or ('gent',)
    if name == 'gent':
        modulus, limit = block.shear_modulus, block.chain_limit
        return lambda x: modulus * (x - 1.0 / (x * x)) / (1.0 - (2.0 / x + x * x - 3.0) / limit)
    if name == 'mooney_rivlin':
        return lambda x: 2.0 * (x - x ** -2) * (c[0] + c[1] / x)
    if name == 'ogden':
        return lambda x: sum(mu * (x ** (alpha - 1.0) - x ** (-0.5 * alpha - 1.0))
                             for mu, alpha in zip(c[::2], c[1::2], strict=True))
    if name in ('nonaffine', 'extended_tube'):
        gc, ge, *others = c

        def network(x):
            invariant = x * x + 2.0 / x - 3.0
            if name == 'nonaffine':
                n, = (y * y for y in others)
                slope, a = gc / 6.0 + gc * n / (3.0 * (n - 1.0) - invariant), -1.0
                entangled = ge * (1.0 - x ** -1.5 - x ** -2.0 + x ** -0.5)
            else:
                d, a = others[0] ** 2, others[1]
                left = 1.0 - d * invariant
                slope = 0.5 * gc * ((1.0 - d) / left ** 2 - d / left)
                entangled = 2.0 * ge / a * (x ** (0.5 * a - 1.0) - x ** (-a - 1.0))
            return 2.0 * (x - x ** -2) * slope + entangled

        return network
    if name == 'arruda_boyce':  # in I1; Yeoh's in I1 - 3
        shares = enumerate((1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0))
        c = [c[0] * share / c[1] ** (2 * i) for i, share in shares]
    slopes = [(i + 1) * y for i, y in enumerate(c)][::-1]
    rest = 0.0 if name == 'arruda_boyce' else 3.0

    def stress(x):
        total, invariant = 0.0, 2.0 / x + x * x - rest
        for y in slopes:
            total = total * invariant + y
        return 2.0 * (x - x ** -2) * total

    return stress


def force_of(stretch, limit):
    """Return psi' of the Gent law."""
    return (stretch - stretch ** -2) / (1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / limit)


def level_of(stretch, block: ActuatorParameters = BLOCK) -> float:
    """Return the flux density that holds a stretch."""
    return force_of(stretch, block.chain_limit) * mu_0 * block.shear_modulus / block.remanence


def steps(targets, span, repeats=1, begin=0.02):
    """Return times and levels of unshaped steps, after an interval without field."""
    levels = [level_of(x) for _ in range(repeats) for x in targets]
    return (np.append(begin - 0.02, begin + span * np.arange(len(levels))),
            np.append(0.0, levels))


def simulate(times, level_times, levels, block: ActuatorParameters = BLOCK,
             extras: Extras | None = None):
    """Return the measured stretch with an error of 2e-9, without noise."""
    arrays = (np.asarray(a, dtype=float).tobytes() for a in (times, level_times, levels))
    return _simulated(*arrays, block, extras or Extras()).copy()


@lru_cache(maxsize=16)
def _simulated(times: bytes, level_times: bytes, levels: bytes, block: ActuatorParameters,
               x: Extras):
    """Run `simulate` once for all tests with the same arguments, since it takes long."""
    times, level_times, levels = (np.frombuffer(a) for a in (times, level_times, levels))
    inertia = block.density * block.half_length ** 2
    c1 = 2.0 * (block.half_thickness / block.half_length) ** 2
    modulus = block.shear_modulus
    damping = block.damping_coefficient * block.half_thickness / (8.0 * block.half_length ** 2)
    load = x.force / (4.0 * block.half_length ** 2)

    branches = [y for y in ((x.ratio, x.time), *x.more) if y[0]]
    push, flow = block.remanence / mu_0, x.power[0] - 1.0
    held = _held(block, x.law)

    def slope(_, state, level):
        # This dominates the time, so effects that the actuator lacks are skipped.
        stretch, rate, *rest = state.tolist()
        field, elastic, cube, rates = level, held(stretch), stretch * stretch * stretch, []
        total = load - elastic - damping * rate + 0.25 * inertia * rate * rate / (cube * stretch)
        if x.coil:
            field = rest.pop(0)
            rates.append((level - field) / x.coil)
        for (ratio, time), relaxed in zip(branches, rest, strict=True):
            left = elastic - relaxed
            total -= ratio * left
            faster = abs(left / (x.power[1] * modulus)) ** flow if flow else 1.0
            rates.append(left / time * faster)
        return [rate, (total + push * field) / (inertia * (1.0 / cube + c1) / 6.0), *rates]

    first = block.remanence * levels[0] / mu_0 + load
    rest = brentq(
        lambda y: held(y) - first, 0.5, 2.0 if x.law else 0.999 * _upper(block.chain_limit),
        xtol=1e-15)
    lagged = [levels[0]] if x.coil else []
    state = np.array([rest, 0.0, *lagged, *(held(rest) for _ in branches)])
    stretch = np.empty(len(times))
    ends = np.append(level_times[1:], max(times[-1], level_times[-1]) + 1e-9)
    for begin, end, level in zip(level_times, ends, levels, strict=True):
        inside = (times >= begin) & (times < end)
        states = integrate(
            slope, [begin, *times[inside], end], state, level, rtol=1e-10, atol=1e-10)
        stretch[inside], state = states[1:-1, 0], states[-1]
    return x.gain * stretch + x.bias


def _upper(limit):
    roots = np.roots([1.0, 0.0, -(limit + 3.0), 2.0])
    return float(max(roots.real))


def relative(found, block: ActuatorParameters = BLOCK):
    """Return the errors of identified block parameters in standard deviations."""
    return {
        name: (found.parameters[name].value - getattr(block, name)) / found.parameters[name].std
        for name in found.names if hasattr(block, name)
        and math.isfinite(found.parameters[name].value)}
