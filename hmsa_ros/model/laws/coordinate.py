"""Kinds of position of an actuator: stretch, deflection of a beam, capacitance ratio."""

from collections.abc import Iterable
from dataclasses import dataclass

from hmsa_ros.model.laws.record import Elastic
from hmsa_ros.model.units import Drive, FLUX, VOLTAGE


@dataclass(frozen=True)
class Coordinate:
    """A kind of position, and the range of its values."""

    name: str  #: in sentences, as plural
    plural: str
    symbol: str  #: in axes of figures, as tex
    tex: str
    meaning: str  #: definition and typical value
    rest: float  #: without a field
    at_rest: tuple[float, float]  #: range of a sensor without a field
    possible: tuple[float, float]  #: usual range of a sensor
    conceivable: tuple[float, float]  #: range of any position
    usual: tuple[float, float]  #: range of a motion of moderate size
    drive: Drive = FLUX  #: field or voltage
    looks: str = ''  #: likely meaning of other values, and a remedy; empty if evident


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
#: Name of a position of unknown kind.
POSITION = 'position'
COORDINATES = {x.name: x for x in (STRETCH, DEFLECTION, CAPACITANCE)}


def shared_name(names: Iterable[str]) -> str:
    """Return the common name of the positions of several actuators."""
    found = set(names)
    return found.pop() if len(found) == 1 else POSITION


def drive_of(name: str) -> Drive:
    """Return the drive of an actuator by the name of its positions; a field if unknown."""
    return COORDINATES.get(name, STRETCH).drive


def coordinate_of(law: Elastic | None) -> Coordinate:
    """Return the kind of position of a model; None for Gent."""
    return STRETCH if law is None else COORDINATES[law.coordinate]
