"""Implausible values of an actuator: unusual numbers, and what follows from them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
import math
from typing import TYPE_CHECKING

from hmsa.errors import assume, UnusualWarning
from hmsa.interfaces.quantities import FORMS
from hmsa.model.equations import critical_zeta, equilibrium_stretch
from hmsa.model.laws import LAWS

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator

# Deflection under its own weight, over the length, from which a beam must not lie flat.
_SAG = 0.02
_GRAVITY = 9.81
# Reachable change of the stretch that is hardly visible.
_HARDLY = 0.01
# Sides of a block: half thickness over half length.
_SIMILAR = (0.05, 20.0)
_SILENT: ContextVar[bool] = ContextVar('silent', default=False)


@contextmanager
def unquestioned() -> Iterator[None]:
    """Make actuators without warnings, for those whose doubts are said elsewhere."""
    token = _SILENT.set(True)
    try:
        yield
    finally:
        _SILENT.reset(token)


def warn(actuator: 'Actuator') -> None:
    """Warn of each implausible value."""
    if not _SILENT.get():
        for doubt in doubts(actuator):
            assume(doubt, UnusualWarning)


def doubts(actuator: 'Actuator') -> list[str]:
    """Return a sentence about each implausible value of an actuator and its coil."""
    form = actuator.law if actuator.law in FORMS else 'block'
    values = _values(actuator, form)
    return [
        *(said for x in FORMS[form] if x.key in values and (said := x.doubt(values[x.key]))),
        *_of_motion(actuator, form), *_of_sizes(form, values)]


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
