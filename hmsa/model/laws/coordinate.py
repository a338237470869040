"""Kinds of position of an actuator: stretch, and deflection of a beam."""

from dataclasses import dataclass

from hmsa.model.laws.record import Elastic


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
    looks: str = ''  #: likely meaning of other values, and a remedy; empty if evident


STRETCH = Coordinate(
    'stretch', 'stretches', 'λ', r'\lambda', 'the length over the length at rest, around 1', 1.0,
    (0.6, 1.6), (0.15, 5.0), (0.0, 20.0), (0.6, 2.0))
DEFLECTION = Coordinate(
    'deflection', 'deflections', 'u', 'u',
    'the deflection of the tip over the length of the beam, around 0', 0.0,
    (-0.4, 0.4), (-1.2, 1.2), (-2.0, 2.0), (-0.6, 0.6),
    'a length, in mm perhaps, divide it by that of the beam; if it is the angle of the tip, take '
    'the deflection that goes with it')
#: Name of a position of unknown kind.
POSITION = 'position'
COORDINATES = {x.name: x for x in (STRETCH, DEFLECTION)}


def coordinate_of(law: Elastic | None) -> Coordinate:
    """Return the kind of position of a model; None for Gent."""
    return STRETCH if law is None else COORDINATES[law.coordinate]
