"""Measurements of an actuator, simulated by SciPy alone, for what identifies it."""

from dataclasses import dataclass
from functools import lru_cache
import math

import numpy as np
from scipy.constants import mu_0
from scipy.integrate import odeint
from scipy.optimize import brentq

from hmsa_ros.model.parameters import ActuatorParameters, paper_actuator

BLOCK = paper_actuator()


@dataclass(frozen=True)
class Extras:
    """What the actuator has besides the block, SI."""

    coil: float = 0.0
    ratio: float = 0.0
    time: float = 0.01
    force: float = 0.0
    bias: float = 0.0
    gain: float = 1.0
    power: tuple = (1.0, 1.0)  # with which branches flow: exponent, and stress over G
    more: tuple = ()  # pairs of ratio and time of more branches
    law: tuple = ()  # name and constants in Pa of a law in place of Gent's


def stress(stretch, law):
    """Return dW/dl in Pa of a law by name, as its energy has it."""
    name, *constants = law
    first, second = stretch ** 2 + 2.0 / stretch - 3.0, stretch - stretch ** -2
    if name == 'mooney_rivlin':
        return 2.0 * second * (constants[0] + constants[1] / stretch)
    if name == 'yeoh':
        return 2.0 * second * sum((i + 1) * c * first ** i for i, c in enumerate(constants))
    if name == 'ogden':
        return sum(mu * (stretch ** (alpha - 1.0) - stretch ** (-0.5 * alpha - 1.0))
                   for mu, alpha in zip(constants[::2], constants[1::2], strict=True))
    mu, most = constants
    return 2.0 * second * mu * sum(
        (i + 1) * c * (first + 3.0) ** i / most ** (2 * i) for i, c in enumerate(
            (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)))


def force_of(stretch, limit):
    """Return psi' of the Gent law."""
    return (stretch - stretch ** -2) / (1.0 - (2.0 / stretch + stretch ** 2 - 3.0) / limit)


def level_of(stretch, block: ActuatorParameters = BLOCK) -> float:
    """Return the flux density that holds a stretch."""
    return force_of(stretch, block.chain_limit) * mu_0 * block.shear_modulus / block.remanence


def steps(targets, span, repeats=1, begin=0.02):
    """Return times and levels of unshaped steps, after a while without field."""
    levels = [level_of(x) for _ in range(repeats) for x in targets]
    return (np.append(begin - 0.02, begin + span * np.arange(len(levels))),
            np.append(0.0, levels))


def simulate(times, level_times, levels, block: ActuatorParameters = BLOCK,
             extras: Extras | None = None):
    """Return the measured stretch, without noise."""
    arrays = (np.asarray(a, dtype=float).tobytes() for a in (times, level_times, levels))
    return _simulated(*arrays, block, extras or Extras()).copy()


@lru_cache(maxsize=16)
def _simulated(times: bytes, level_times: bytes, levels: bytes, block: ActuatorParameters,
               x: Extras):
    """Do what `simulate` does once for all tests that ask for the same, since it takes long."""
    times, level_times, levels = (np.frombuffer(a) for a in (times, level_times, levels))
    inertia = block.density * block.half_length ** 2
    c1 = 2.0 * (block.half_thickness / block.half_length) ** 2
    modulus = block.shear_modulus
    damping = block.damping_coefficient * block.half_thickness / (8.0 * block.half_length ** 2)
    load = x.force / (4.0 * block.half_length ** 2)

    branches, flows = ((x.ratio, x.time), *x.more), x.power[1] * modulus

    def held(stretch):
        return stress(stretch, x.law) if x.law else modulus * force_of(stretch, block.chain_limit)

    def slope(_, state, level):
        stretch, rate, field, *relaxed = state.tolist()
        elastic = held(stretch)
        acting = level if x.coil == 0.0 else field
        total = (
            block.remanence * acting / mu_0 + load - elastic
            - sum(ratio * (elastic - y) for (ratio, _), y in zip(branches, relaxed, strict=True))
            - damping * rate + 0.25 * inertia * rate ** 2 / stretch ** 4)
        return [rate, total / (inertia * (stretch ** -3 + c1) / 6.0),
                (level - field) / x.coil if x.coil else 0.0,
                *((elastic - y) / t * abs((elastic - y) / flows) ** (x.power[0] - 1.0)
                  for (_, t), y in zip(branches, relaxed, strict=True))]

    first = block.remanence * levels[0] / mu_0 + load
    rest = brentq(
        lambda y: held(y) - first, 0.5, 2.0 if x.law else 0.999 * _upper(block.chain_limit),
        xtol=1e-15)
    state = np.array([rest, 0.0, levels[0], *(held(rest) for _ in branches)])
    stretch = np.empty(len(times))
    ends = np.append(level_times[1:], max(times[-1], level_times[-1]) + 1e-9)
    for begin, end, level in zip(level_times, ends, levels, strict=True):
        inside = (times >= begin) & (times < end)
        moments = np.concatenate(([begin], times[inside], [end]))
        # It takes no moments that only rounding tells apart.
        apart = np.diff(moments, prepend=-math.inf) > 1e-11
        states = odeint(
            slope, state, moments[apart], args=(level,), tfirst=True, rtol=1e-12, atol=1e-12,
            mxstep=100_000)
        stretch[inside] = states[np.cumsum(apart)[1:-1] - 1, 0]
        state = states[-1]
    return x.gain * stretch + x.bias


def _upper(limit):
    roots = np.roots([1.0, 0.0, -(limit + 3.0), 2.0])
    return float(max(roots.real))


def relative(found, block: ActuatorParameters = BLOCK):
    """Return how far identified parameters of the block are off, in standard deviations."""
    return {
        name: (found.parameters[name].value - getattr(block, name)) / found.parameters[name].std
        for name in found.names if hasattr(block, name)
        and math.isfinite(found.parameters[name].value)}
