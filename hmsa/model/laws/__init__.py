"""Hyperelastic models of rubber, of measured curves and of beams, by name."""

from hmsa.model.laws import beam, rubber, table
from hmsa.model.laws.record import Law

#: Models by name; the first is the default.
LAWS: dict[str, Law] = {x.name: x for x in (
    rubber.GENT, rubber.NEO_HOOKEAN, rubber.MOONEY_RIVLIN, rubber.YEOH, rubber.OGDEN,
    rubber.ARRUDA_BOYCE, rubber.NONAFFINE, rubber.EXTENDED_TUBE, table.LAW, beam.LAW)}
