"""What follows from the values of an actuator, as text: derived quantities, and doubts."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING

import numpy as np

from hmsa.api.arguments import CLAMPED, clamped_beam
from hmsa.errors import assume, BadInputError, UnusualWarning
from hmsa.interfaces.actuator import actuator_from, parameters_of
from hmsa.interfaces.quantities import FORMS
from hmsa.model.equations import (
    critical_zeta,
    elastic_force,
    equilibrium_stretch,
    stretch_limits,
)
from hmsa.model.law import boundary
from hmsa.model.laws import LAWS
from hmsa.model.laws.record import ENDLESS
from hmsa.model.modes import Modes
from hmsa.model.moves import State
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import observed, sampled
from hmsa.model.status import Code
from hmsa.model.units import flux_text
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import CODES, Groups, plan_two_step, plan_two_step_batch

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator

#: Stretches and beam deflections whose flux density is listed if the coil reaches them.
STRETCHES = (0.6, 0.8, 0.9, 1.05, 1.1, 1.2, 1.4, 2.0)
DEFLECTIONS = (0.05, 0.1, 0.2, 0.4, 0.6, 0.7, 0.78)
#: Size of the move from rest whose duration is reported if the coil allows it.
USUAL_MOVE = 0.1
# Points of the first search for the reach on either side.
_REACHES = 400
# Damping, relative to critical damping where the block is stiffest, above which no step overshoots
# and no two-step command exists; a search for one would take long.
_OVERDAMPED = 3.0


@dataclass(frozen=True)
class Scales:
    """Derived quantities of an actuator and the range of its coil."""

    time_unit: float  #: L sqrt(rho/G) in s
    frequency: float  #: undamped, at rest without field, in Hz
    c1: float  #: shape 2 H^2/L^2
    zeta: float
    critical_zeta: float  #: above it, small motion about rest does not oscillate
    damping: float  #: zeta as a coefficient in N s/m
    critical_damping: float
    flux_density_unit: float  #: level of the dimensionless load 1, mu0 G/Br in T
    #: Stretches within reach of the coil, and the levels that hold them.
    flux_densities: tuple[tuple[float, float], ...]
    stretch_limits: tuple[float, float]  #: between which the force increases
    held: tuple[float, float]  #: minimum and maximum stretch that the coil can hold
    #: Minimum and maximum stretch that a two-step command reaches from rest; rest if none.
    reached: tuple[float, float]
    target: float  #: of a usual move from rest; NaN for none
    duration: float  #: of the two-step command for it, in s


def scales(actuator: ActuatorParameters, least: float, most: float) -> Scales:
    """
    Compute the derived quantities of parameters and the range of a coil in T.

    Ramps and creep are neglected. Raise `BadInputError` if the range is empty or infinite.
    """
    if not -math.inf < least < most < math.inf:
        raise BadInputError(
            f'flux densities from {least:g} to {most:g} T: expected the minimum below the maximum')
    material = actuator.nondimensional.elastic
    home = material.rest
    units = actuator.units
    loads = units.of_level(least), units.of_level(most)
    lower, upper = stretch_limits(material)
    held = tuple(float(equilibrium_stretch(x, material)) for x in loads)

    def duration(target: float) -> float:
        plan = plan_two_step(home, target, material, load_limits=loads)
        within = loads[0] <= min(plan.beta_p, plan.beta_1) and max(
            plan.beta_p, plan.beta_1) <= loads[1]
        return plan.tau_p if plan.code is Code.TWO_STEP and within else math.nan

    def reach(end: float) -> float:
        # Quadratic spacing, so that stretches near rest are resolved.
        targets = home + (end - home) * np.linspace(0.0, 1.0, _REACHES + 1)[1:] ** 2
        if material.zeta > _OVERDAMPED * np.max(critical_zeta(targets, material)):
            return home
        plans = plan_two_step_batch(
            home, targets,
            Groups(zeta=material.zeta, j_lim=material.j_lim, c1=material.c1, elastic=material.law),
            load_limits=loads)
        both = np.stack([plans.beta_p, plans.beta_1])
        good = np.array([CODES[x] is Code.TWO_STEP for x in plans.status.tolist()]) & np.all(
            (both >= loads[0]) & (both <= loads[1]), axis=0)
        found = np.flatnonzero(good)
        if not len(found):
            return home
        last = int(found[-1])
        beyond = targets[last + 1] if last + 1 < len(targets) else end
        return boundary(
            lambda x: math.isfinite(duration(x)), float(targets[last]), float(beyond))

    reached = tuple(reach(x) if abs(x - home) > 1e-12 else home for x in held)
    # Otherwise half of the way, or all of it, on the side that reaches further.
    end = max(reached, key=lambda x: abs(math.log(x)) if home else abs(x))
    target = next((x for x in (home + USUAL_MOVE, 0.5 * (home + end), end)
                   if x != home and math.isfinite(duration(x))), math.nan)
    tau = duration(target) if math.isfinite(target) else math.nan
    critical = float(critical_zeta(home, material))
    return Scales(
        time_unit=actuator.time_unit,
        frequency=1.0 / actuator.period,
        c1=actuator.geometry.c1, zeta=material.zeta, critical_zeta=critical,
        damping=actuator.damping_coefficient,
        critical_damping=critical * actuator.damping_unit, flux_density_unit=units.load,
        flux_densities=tuple(
            (x, float(units.level(elastic_force(x, material))))
            for x in _shown(held[0], held[1], home)),
        stretch_limits=(lower, upper), held=(held[0], held[1]),
        reached=(reached[0], reached[1]), target=target,
        duration=tau * actuator.time_unit)


def _shown(least: float, largest: float, home: float) -> tuple[float, ...]:
    """Return the usual stretches that a coil holds, or else half and all of its reach."""
    usual = tuple(x for x in (STRETCHES if home else DEFLECTIONS) if least <= x <= largest)
    return usual or tuple(
        home + share * (end - home) for end, share in (
            (least, 1.0), (least, 0.5), (largest, 0.5), (largest, 1.0)) if end != home)


# Deflection under its own weight, over the length, from which a beam must not lie flat.
_SAG = 0.02
_GRAVITY = 9.81
# Reachable change of the stretch that is hardly visible.
_HARDLY = 0.01
# Sides of a block: half thickness over half length.
_SIMILAR = (0.05, 20.0)
# By H/L, rest of a glued block beyond 0.9, 1.1 and 1.2 in % of the step, if its stiffness is that
# of small stretch: Newton's method on benchmarks/block_elements.py, 5 to 9 elements high, J_lim 5.
_GLUED = {0.1: (22.0, 6.0, 6.6), 0.25: (6.2, 1.1, 1.2), 0.35: (3.8, 0.7, 0.7),
          0.5: (2.3, 0.6, 0.7)}
_SILENT: ContextVar[bool] = ContextVar('silent', default=False)
# Moves from rest of which the vibration is told, of a block and of a beam; time in natural
# periods, and samples, in which it is looked for.
_MOVE, _BEND, _PERIODS, _LOOK = 0.1, 0.3, 2.0, 400


@contextmanager
def unquestioned() -> Iterator[None]:
    """Make actuators without warnings, for those whose doubts are said elsewhere."""
    token = _SILENT.set(True)
    try:
        yield
    finally:
        _SILENT.reset(token)


def warn(actuator: 'Actuator', mount: str = 'paper') -> None:
    """Warn of each implausible value."""
    if not _SILENT.get():
        for doubt in doubts(actuator, mount):
            assume(doubt, UnusualWarning)


def doubts(actuator: 'Actuator', mount: str = 'paper') -> list[str]:
    """Return a sentence about each implausible value of an actuator and its coil."""
    form = actuator.law if actuator.law in FORMS else 'block'
    values = _values(actuator, form)
    return [
        *(said for x in FORMS[form] if x.key in values and (said := x.doubt(values[x.key]))),
        *_of_motion(actuator, form), *_of_sizes(form, values), *(
            _of_glue(actuator.block) if mount == 'glued' else ())]


def _values(actuator: 'Actuator', form: str) -> Mapping[str, float]:
    """Return the values of the quantities of a form, by key."""
    block, given = actuator.block, actuator.parameters
    low, high = actuator.flux_density_limits
    sizes = {
        'half_length': block.half_length, 'half_thickness': block.half_thickness,
        'length': 2.0 * block.half_length, 'thickness': 2.0 * block.half_thickness}
    own = {x.key: given[x.parameter] for x in FORMS[form] if x.parameter in given}
    values = own | {x: y for x, y in sizes.items() if x in own} | {
        'zeta': actuator.zeta, 'damping_ratio': actuator.damping_ratio,
        'shear_modulus': block.shear_modulus, 'flux_max': high, 'flux_min': low}
    law = LAWS[actuator.law]
    if law.endless or law.scaled is not None or math.isinf(block.chain_limit):
        values.pop('j_lim', None)
    return values


def _of_motion(actuator: 'Actuator', form: str) -> Iterator[str]:
    """Yield doubts about damping and reach."""
    material, block = actuator.model.material, actuator.block
    zeta, critical = material.zeta, float(critical_zeta(material.rest, material))
    if zeta >= critical:
        yield (
            f'zeta {zeta:g} is above the critical {critical:g}: small motion about rest does not '
            'oscillate, and there is no two-step command for it')
    low, high = (float(x) for x in equilibrium_stretch(
        [block.units.of_level(x) for x in actuator.flux_density_limits], material))
    if high - low < 2.0 * _HARDLY:
        move = {'beam': 'deflection of 0.1', 'block': 'stretch of 1.1 or 0.9'}[form]
        yield (
            f'the coil only reaches {block.coordinate.plural} from {low:.6g} to {high:.6g}: a '
            f'{move} needs about {0.3 * block.units.load:.3g} T')


def _of_sizes(form: str, values: Mapping[str, float]) -> Iterator[str]:
    """Yield doubts about the sizes together."""
    if form == 'beam':
        # q L^4/(8 E I) of an even load, over L.
        sag = 1.5 * values['density'] * _GRAVITY * values['length'] ** 3 / (
            values['youngs_modulus'] * values['thickness'] ** 2)
        if sag > _SAG:
            yield (
                f'a horizontal beam sags by {sag:.2g} of its length under its own weight, which '
                'the model neglects: clamp it so that it bends in a horizontal plane')
    if form == 'block':
        ratio = values['half_thickness'] / values['half_length']
        if not _SIMILAR[0] <= ratio <= _SIMILAR[1]:
            yield (
                f'half thickness over half length is {ratio:.3g}: the model describes a block '
                'with sides of similar length; a thin film or a long rod bends instead')


def _of_glue(block: ActuatorParameters) -> Iterator[str]:
    """Yield how far a flat block rests from where uniform deformation has it."""
    shape, known = block.half_thickness / block.half_length, np.array([*_GLUED])
    if shape <= known[-1]:
        off = [float(np.interp(math.log(shape), np.log(known), x))
               for x in zip(*_GLUED.values(), strict=True)]
        yield (
            f'a glued block of H/L {shape:.3g} does not deform uniformly: moves to 0.9, 1.1 and '
            f'1.2 rest {"at least" if shape < known[0] else "about"} {off[0]:.2g}, {off[1]:.2g} '
            f'and {off[2]:.2g} % of the step beyond; correct its levels by hmsa learn')


def _facts_of_volume(block: ActuatorParameters) -> list[tuple[str, str]]:
    """Return what a compressible block changes, and what is left if this is ignored."""
    if math.isinf(block.bulk_ratio):
        return []
    alone = replace(block, modes=Modes())
    ignored = replace(alone, bulk_ratio=math.inf)
    nu = 0.5 * math.sqrt(block.geometry.transverse)
    load = elastic_force(1.0 + _MOVE, ignored.nondimensional)
    off = 100.0 * (float(equilibrium_stretch(load, block.nondimensional)) - 1.0 - _MOVE) / _MOVE
    side = block.side(1.0 + _MOVE)
    return [
        ("Poisson's ratio", f'{nu:.4g}'),
        (f'side and volume at {1.0 + _MOVE:g}',
         f'{side:.4f} ({ignored.side(1.0 + _MOVE):.4f}) and {(1.0 + _MOVE) * side ** 2:.4f} (1)'),
        ('with constant volume', f'{1.0 / ignored.period:.5g} Hz'), *_first(block),
        ('two_step, constant volume',
         f'leaves {_left(alone, ignored):.2g} % of a step to {1.0 + _MOVE:g}, and rests '
         f'{abs(off):.2g} % off')]


def _first(block: ActuatorParameters) -> list[tuple[str, str]]:
    """Return the first frequency of a free block, which does not deform uniformly."""
    from hmsa.model.continuum import SHAPES, spectrum  # slow to import

    shape = block.half_thickness / block.half_length
    if block.modes.ratios or not SHAPES[0] <= shape <= SHAPES[1]:
        return []
    found = spectrum(shape, 'free', bulk_ratio=block.bulk_ratio)
    unit = block.half_length * math.sqrt(block.density / block.shear_modulus)
    frequency = float(found.frequencies[found.first]) / (2.0 * math.pi * unit)
    return [('first mode, mount free',
             f'{frequency:.5g} Hz; uniform deformation is '
             f'{100.0 * (1.0 / (frequency * block.period) - 1.0):.2g} % above')]


def _facts_of_modes(actuator: ActuatorParameters) -> list[tuple[str, str]]:
    """Return what the modes of a block change."""
    if not actuator.modes.ratios:
        return []
    paper = replace(
        actuator, mass_factor=1.0, transverse_mass_factor=1.0, transverse_mass_exponent=0.0,
        modes=Modes())
    left, tuned, modal = (_left(actuator, *x) for x in (
        (paper,), (replace(actuator, modes=Modes()),), (actuator, 'modal')))
    return [
        ('if it deformed uniformly', f'{1.0 / paper.period:.5g} Hz'),
        ('modes, f/f1 (share)', _modes_text(actuator.modes)),
        ("two_step, paper's model", f'leaves {left:.2g} % of a step to {1.0 + _MOVE:g}'),
        ('two_step, first mode', f'leaves {tuned:.2g} %; shaper modal, {modal:.2g} %')]


def _facts_of_beam(beam: ActuatorParameters) -> list[tuple[str, str]]:
    """Return what the first mode alone leaves, and with secondary modes, what they change."""
    first = actuator_from(parameters_of(replace(beam, modes=Modes())) | {'law.shape': ''})
    actual = beam if beam.modes.ratios else clamped_beam(replace(beam, mass_factor=1.0))
    load = elastic_force(_BEND, first.nondimensional)
    off = 100.0 * (float(equilibrium_stretch(load, actual.nondimensional)) / _BEND - 1.0)
    left = (f'leaves {_left(actual, first):.2g} % of a step to {_BEND:g}, and rests '
            f'{abs(off):.2g} % off')
    if not beam.modes.ratios:
        return [('two_step, as an elastica', f'{left}; mount {CLAMPED} and shaper modal, none')]
    return [
        ('modes, f/f1 (share)', _modes_text(beam.modes)),
        ("two_step, mode's shape", left),
        ('two_step, elastica',
         f'leaves {_left(beam, replace(beam, modes=Modes())):.2g} %; shaper modal, none')]


def _modes_text(modes: Modes) -> str:
    return ', '.join(
        ('' if i in modes.ringing else 'weak ones ') + f'{x:.3g} ({100.0 * y:.2g} %)'
        for i, (x, y) in enumerate(zip(modes.ratios, modes.shares, strict=True)))


def _left(
        actual: ActuatorParameters, planned: ActuatorParameters, shaper: str = 'two_step'
) -> float:
    """Return the vibration in % of a step after a command, peak to peak."""
    material, rest = actual.nondimensional, actual.rest
    move = _BEND if rest == 0.0 else _MOVE
    levels = get_shaper(shaper)(MoveRequest(
        State(rest), rest + move, planned.nondimensional)).levels
    faster = planned.time_unit / actual.time_unit
    levels = tuple(x._replace(time=x.time * faster) for x in levels)
    end = levels[-1].time
    period = actual.period / actual.time_unit
    times = np.linspace(end, end + _PERIODS * period, _LOOK, dtype=np.float64)
    stretch = observed(sampled(levels, State(rest), times, material), material)[0]
    return 100.0 * float(np.ptp(stretch)) / move


def facts(found: Scales, block: ActuatorParameters) -> list[tuple[str, str]]:
    """
    Return names and values, with units, of the derived quantities.

    The last ones say what modes and compressibility change.
    """
    beam, words = block.rest == 0.0, block.coordinate.plural
    return [
        ('time unit' if beam or block.geometry.inertia != 1.0 else 'time unit L sqrt(rho/G)',
         _time_text(found.time_unit)),
        ('natural frequency at rest', f'{found.frequency:.5g} Hz'),
        ('damping', f'{found.damping:.4g} N s/m, zeta {found.zeta:.4g}'),
        ('critical damping at rest',
         f'{found.critical_damping:.4g} N s/m, zeta {found.critical_zeta:.4g}'),
        *([] if found.stretch_limits in (ENDLESS, (0.0, math.inf))
          else [(f'limiting {words}', '{:.4f} and {:.4f}'.format(*found.stretch_limits))]),
        *([] if beam else [('shape c1', f'{found.c1:.4g}')]),
        *((f'flux density for {stretch:.6g}', flux_text(level, '.4g'))
          for stretch, level in found.flux_densities),
        (f'coil holds {words}', '{:.6g} to {:.6g}'.format(*found.held)),
        ('two-step range from rest', 'none' if found.reached == (block.rest,) * 2
         else '{:.6g} to {:.6g}'.format(*found.reached)),
        ('move time from rest', 'no two-step command' if math.isnan(found.duration)
         else f'{_time_text(found.duration)} to {found.target:.6g}'),
        *(_facts_of_beam(block) if beam else _facts_of_volume(block) + _facts_of_modes(block))]


def _time_text(seconds: float) -> str:
    """Return a time in s, ms or us."""
    for size, unit in ((1.0, 's'), (1e-3, 'ms')):
        if seconds >= size:
            return f'{seconds / size:.4g} {unit}'
    return f'{seconds * 1e6:.4g} us'
