"""
Quantities of an actuator: names, units, defaults, limits, and usual ranges.

``hmsa init`` takes them as options, and `hmsa.api` warns of unusual ones.

The options of the command line depend on this module, so it imports nothing slow.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
import re

from hmsa.errors import BadInputError
from hmsa.interfaces.parameters import (
    ACTUATOR,
    ACTUATOR_FIELDS,
    BULK_RATIO,
    FLUX_DENSITY_MAX,
    FLUX_DENSITY_MIN,
    ParameterSpec,
    SLEW_LIMIT,
    ZETA,
)

_UNITS: dict[str, dict[str, float]] = {
    'm': {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'µm': 1e-6},
    'Pa': {'Pa': 1.0, 'kPa': 1e3, 'MPa': 1e6, 'GPa': 1e9},
    'kg/m^3': {'kg/m^3': 1.0, 'kg/m3': 1.0, 'g/cm^3': 1e3, 'g/cm3': 1e3},
    'T': {'T': 1.0, 'mT': 1e-3},
    'V': {'V': 1.0, 'kV': 1e3},
    'T/s': {'T/s': 1.0, 'mT/s': 1e-3},
    '': {},
    'N s/m': {'N s/m': 1.0, 'Ns/m': 1.0},
    's': {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'µs': 1e-6},
    'N': {'N': 1.0, 'mN': 1e-3},
    'H': {'H': 1.0, 'mH': 1e-3, 'uH': 1e-6, 'µH': 1e-6},
    'ohm': {'ohm': 1.0, 'mohm': 1e-3, 'Ω': 1.0},
    'T/A': {'T/A': 1.0, 'mT/A': 1e-3},
    'Hz': {'Hz': 1.0, 'kHz': 1e3},
    'degC': {'degC': 1.0, 'C': 1.0, '°C': 1.0},
}
_NUMBER = re.compile(r'\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*')
_NAME = re.compile(r'[A-Za-z](?:_?[A-Za-z0-9])*')

_BLOCK = dict(zip(ACTUATOR_FIELDS, ACTUATOR, strict=True))
_REVIEW = 'Wu et al., Multifunctional Materials 3 (2020) 042003'
_ZHAO = 'Zhao et al., J. Mech. Phys. Solids 124 (2019) 244'


def quantity_of(text: str, unit: str, words: str) -> float:
    """
    Read a number with or without a unit, and return it in SI units; ``words`` name it in messages.

    Raises `BadInputError` for any other text.
    """
    found = _NUMBER.fullmatch(text)
    units = _UNITS.get(unit, {unit: 1.0})
    if found is None:
        example = f' with or without a unit ({", ".join(units)})' if units else ''
        raise BadInputError(f'{words} is {text!r}: expected a number{example}')
    number, own = found[1], found[2].replace('\u03bc', 'µ')
    if re.match(r',\d', own):
        raise BadInputError(
            f'{words} is {text!r}: expected a decimal point, as in {text.replace(",", ".", 1)!r}')
    if own not in units:
        # In another case, but not across the prefixes m (milli) and M (mega).
        own = next((x for x in units if x.lower() == own.lower() and not (
            x[0] in 'mM' and x[0] != own[0])), own)
    if own and own not in units:
        raise BadInputError(
            f'{words} has the unit {own!r}: expected '
            + (f'one of {", ".join(units)}' if units else 'a number without a unit'))
    return float(number) * (units[own] if own else 1.0)


@dataclass(frozen=True)
class GivenNumber:
    """A number given by the user."""

    key: str  # name in the code and, with hyphens, of the option
    parameter: str  # name of the nodes' parameter
    text: str
    unit: str  # SI; empty for a dimensionless number
    default: float | None  # None if it follows from another, see `default_of`
    least: float  # limits of the nodes
    largest: float
    usual: tuple[float, float]  # range without a warning
    source: str  # source of the usual range
    hints: tuple[tuple[float, float, str], ...] = ()  # ranges with the likely mistake

    @classmethod
    def of(
            cls, key: str, spec: ParameterSpec, text: str, usual: tuple[float, float],
            source: str, hints: tuple[tuple[float, float, str], ...] = (), *,
            follows: bool = False) -> 'GivenNumber':
        """Return the quantity of a node parameter; its default may follow from others."""
        default = spec.default if isinstance(spec.default, float) and not follows else None
        return cls(
            key, spec.name, text, spec.unit, default,
            -math.inf if spec.minimum is None else spec.minimum,
            math.inf if spec.maximum is None else spec.maximum, usual, source, hints)

    @property
    def option(self) -> str:
        """Name of the option."""
        return '--' + self.key.replace('_', '-')

    def parse(self, text: str) -> float:
        """Read a number in SI or with a unit, ``'10 mm'``; raise `BadInputError` if invalid."""
        value = quantity_of(text, self.unit, self.words)
        if not self.least <= value <= self.largest:
            raise BadInputError(
                f'{self.words} is {self.show(value)}: expected {self.least:g} to '
                f'{self.largest:g}{self._unit}')
        return value

    @property
    def words(self) -> str:
        """Name as words."""
        return self.key.replace('_', ' ')

    @property
    def _unit(self) -> str:
        return f' {self.unit}' if self.unit else ''

    def show(self, value: float) -> str:
        """Return a value with its unit."""
        return f'{value:g}{self._unit}'

    def mistake(self, value: float) -> str:
        """Return the likely mistake behind an unusual value in SI; empty if none is known."""
        hint = '' if self.usual[0] <= value <= self.usual[1] else next(
            (words for begin, end, words in self.hints if begin <= value <= end), '')
        return hint and f'{self.words} {self.show(value)} is unusual ({hint})'

    def doubt(self, value: float) -> str | None:
        """Return why a value in SI units is implausible and the usual range, None if it is not."""
        low, high = self.usual
        if low <= value <= high:
            return None
        return (
            f'{self.mistake(value) or f"{self.words} {self.show(value)} is unusual"}: the usual '
            f'range is {low:g} to {high:g}{self._unit}, {self.source}')


QUANTITIES: tuple[GivenNumber, ...] = (
    GivenNumber.of(
        'half_length', _BLOCK['half_length'], 'half length L of the block, across the field',
        (1e-5, 0.1), f'from printed swimmers to moulded grippers in {_REVIEW}',
        ((0.5, 1e3, 'did you mean mm?'),)),
    GivenNumber.of(
        'half_thickness', _BLOCK['half_thickness'],
        'half thickness H of the block, along the field', (1e-5, 0.1),
        f'from printed swimmers to moulded grippers in {_REVIEW}',
        ((0.5, 1e3, 'did you mean mm?'),), follows=True),
    GivenNumber.of(
        'shear_modulus', _BLOCK['shear_modulus'], 'shear modulus G', (1e3, 3e6),
        f'from silicone gels to filled rubber; 303 kPa in {_ZHAO}',
        ((1e10, 1e12, 'metals have 25 to 80 GPa'), (1e8, 1e10, 'that is a hard plastic'),
         (1.0, 999.0, 'did you mean kPa?'), (0.0, 1.0, 'did you mean MPa?'))),
    GivenNumber.of(
        'density', _BLOCK['density'], 'density rho', (900.0, 4000.0),
        'silicone of 1000 to 1200 kg/m^3 with up to 40 % by volume of NdFeB powder of '
        '7600 kg/m^3',
        ((0.8, 1.3, 'that is air, or did you mean g/cm^3?'),
         (1.3, 10.0, 'did you mean g/cm^3?'), (7000.0, 9000.0, 'that is solid metal'))),
    GivenNumber.of(
        'remanence', _BLOCK['remanence'], 'remanence Br along the thickness',
        (0.005, 0.4),
        'isotropic NdFeB powder of 0.7 to 0.9 T diluted to 1 to 40 % by volume; 0.143 T in '
        + _ZHAO,
        ((1.5, 1e3, 'the strongest sintered NdFeB magnets, grade N55, have 1.5 T; did you mean '
          'mT?'), (0.9, 1.5, 'that is a solid magnet'))),
    GivenNumber.of(
        'j_lim', _BLOCK['chain_limit'],
        'Gent limiting extensibility J_lim', (0.5, 200.0),
        'Gent, Rubber Chem. Technol. 69 (1996) 59, fits rubber with some 30 to 100; the paper '
        'takes 1 to 5'),
    GivenNumber.of(
        'bulk_ratio', BULK_RATIO, 'bulk over shear modulus of a compressible block, 1 to 1e6',
        (3.0, math.inf), 'from porous silicones to rubber, which has some 1000'),
    GivenNumber(
        'zeta', '', 'damping zeta, c/(8 L H sqrt(rho G))', '', ZETA, 0.0, 1e12, (0.005, 2.0),
        'where the paper takes 0.02 to 1.1'),
    GivenNumber.of(
        'flux_max', FLUX_DENSITY_MAX, "coil's maximum flux density", (1e-3, 2.0),
        'from Helmholtz coils, some 1 to 50 mT, to electromagnets, whose iron saturates near '
        '2 T', ((2.0, 1e3, 'did you mean mT?'),)),
    GivenNumber.of(
        'flux_min', FLUX_DENSITY_MIN,
        "coil's minimum flux density, negative in the other direction", (-2.0, 0.0),
        'since at 0 T the block is at rest, and coils reach some 2 T',
        ((-1e3, -2.0, 'did you mean mT?'),), follows=True),
    GivenNumber.of(
        'slew_limit', SLEW_LIMIT, "rate of the amplifier's ramps, 0 for steps",
        (0.0, math.inf), ''),
)
BY_KEY: Mapping[str, GivenNumber] = {x.key: x for x in QUANTITIES}
_STRIPS = f'from printed strips to fingers in {_REVIEW}'
#: Quantities of a beam, whose sizes are full ones.
BEAM: tuple[GivenNumber, ...] = (
    GivenNumber(
        'length', 'actuator.half_length', 'free length of the beam, from clamp to tip', 'm', 0.025,
        1e-9, 1e3, (1e-4, 0.2), _STRIPS, ((0.5, 1e3, 'did you mean mm?'),)),
    GivenNumber(
        'thickness', 'actuator.half_thickness', 'thickness of the section, along the field', 'm',
        0.001, 1e-9, 1e3, (1e-5, 0.02), _STRIPS, ((0.1, 1e3, 'did you mean mm?'),)),
    GivenNumber(
        'width', 'law.width', 'width of the section, across the field', 'm', 0.005, 1e-9, 1e3,
        (1e-5, 0.1), _STRIPS, ((0.5, 1e3, 'did you mean mm?'),)),
    GivenNumber(
        'youngs_modulus', 'law.youngs_modulus', "Young's modulus E, 3 G of an elastomer", 'Pa',
        1e6, 1e-3, 1e12, (3e3, 1e7), f'from silicone gels to filled rubber; 909 kPa in {_ZHAO}',
        ((1e9, 1e12, 'that is a hard plastic or a metal'), (0.0, 3e3, 'did you mean kPa?'))),
    BY_KEY['density'],
    replace(
        BY_KEY['remanence'], text='remanence Br along the length'),
    GivenNumber(
        'damping_ratio', '', 'damping ratio about rest, from the ringing', '', 0.05, 0.0,
        1e3, (0.005, 0.9), 'of silicone strips in air'),
    *(BY_KEY[x] for x in ('flux_max', 'flux_min', 'slew_limit')),
)
#: Quantities by form of the actuator, by default a block.
FORMS: Mapping[str, tuple[GivenNumber, ...]] = {'beam': BEAM, 'block': QUANTITIES}
#: All quantities, each once.
EVERY = tuple({x.key: x for form in (BEAM, QUANTITIES) for x in form}.values())
#: Alternative to zeta.
DAMPING = GivenNumber.of(
    'damping', _BLOCK['damping_coefficient'], 'damping coefficient c', (0.0, math.inf), '',
    follows=True)
#: Quantities with a default; all others are given, or set by --yes.
OPTIONAL = ('bulk_ratio', 'flux_min', 'slew_limit')


def mistakes(form: str, values: Mapping[str, float]) -> list[str]:
    """Return the likely mistakes in the parameters of an actuator of a form."""
    return [found for x in FORMS[form] if x.parameter in values and (found := x.mistake(
        # Parameters are half sizes.
        values[x.parameter] * (2.0 if f'half_{x.key}' in x.parameter else 1.0)))]


def default_of(quantity: GivenNumber, given: Mapping[str, float]) -> float:
    """Return a default in SI units: a cube, and a coil with symmetric limits."""
    if quantity.default is not None:
        return quantity.default
    return given['half_length'] if quantity.key == 'half_thickness' else -abs(given['flux_max'])


def joint_names(text: str) -> list[str]:
    """Read joint names, an empty list from an empty text; raise `BadInputError` if invalid."""
    names = text.replace(',', ' ').split()
    for name in names:
        if not _NAME.fullmatch(name):
            raise BadInputError(
                f'joint {name!r}: expected letters, digits and single underscores, starting '
                'with a letter')
        if names.count(name) > 1:
            raise BadInputError(f'joint {name!r} is named twice: expected different names')
    return names
