"""What the position of an actuator is: a stretch, the deflection of a beam, a capacitance."""

from collections.abc import Iterable
from dataclasses import dataclass

from hmsa_ros.model.laws.record import Elastic
from hmsa_ros.model.units import Drive, FLUX, VOLTAGE


@dataclass(frozen=True)
class Coordinate:
    """What a position is, and which values it may have."""

    name: str  #: in sentences, as plural
    plural: str
    symbol: str  #: in axes of figures, as tex
    tex: str
    meaning: str  #: what it is, and about which value
    rest: float  #: without a field
    at_rest: tuple[float, float]  #: what a sensor may show without a field
    possible: tuple[float, float]  #: what a sensor may usually show
    conceivable: tuple[float, float]  #: what can be a position at all
    usual: tuple[float, float]  #: range of a motion that is not too large
    drive: Drive = FLUX  #: what moves it
    looks: str = ''  #: what other values may be, and how to mend them; empty where the values tell


STRETCH = Coordinate(
    'stretch', 'stretches', 'λ', r'\lambda', 'the length over the length at rest, around 1', 1.0,
    (0.6, 1.6), (0.15, 5.0), (0.0, 20.0), (0.6, 2.0))
DEFLECTION = Coordinate(
    'deflection', 'deflections', 'u', 'u',
    'the deflection of the tip over the length of the beam, around 0', 0.0,
    (-0.4, 0.4), (-1.2, 1.2), (-2.0, 2.0), (-0.6, 0.6), FLUX,
    'a length, in mm perhaps, divide it by that of the beam; if it is the angle of the tip, take '
    'the deflection that goes with it')
CAPACITANCE = Coordinate(
    'capacitance ratio', 'capacitance ratios', 'C/C₀', 'C/C_0',
    'the capacitance over that without a voltage, around 1', 1.0,
    (0.5, 2.0), (0.05, 50.0), (0.0, 400.0), (0.5, 3.0), VOLTAGE)
#: What a position is called where nothing more is known.
POSITION = 'position'
COORDINATES = {x.name: x for x in (STRETCH, DEFLECTION, CAPACITANCE)}


def shared_name(names: Iterable[str]) -> str:
    """Return what positions of several actuators are called together."""
    found = set(names)
    return found.pop() if len(found) == 1 else POSITION


def drive_of(name: str) -> Drive:
    """Return what moves an actuator whose positions have a name; a field if it is unknown."""
    return COORDINATES.get(name, STRETCH).drive


def coordinate_of(law: Elastic | None) -> Coordinate:
    """Return what the position is under a law; None for Gent."""
    return STRETCH if law is None else COORDINATES[law.coordinate]
