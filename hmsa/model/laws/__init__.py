"""
Hyperelastic models: a table, and one module for each model with its constants and source.

An energy is a function in Python (`hmsa.model.laws.formula`) or compiled in
`hmsa/motion/hmsa/law.hpp`, where it is faster.
"""

from hmsa.model.laws import (
    arruda_boyce,
    beam,
    extended_tube,
    gent,
    mooney_rivlin,
    nonaffine,
    ogden,
    table,
    yeoh,
)
from hmsa.model.laws.record import Law

#: Models by name; the first is the default.
LAWS: dict[str, Law] = {x.name: x for x in (
    gent.GENT, gent.NEO_HOOKEAN, mooney_rivlin.LAW, yeoh.LAW, ogden.LAW, arruda_boyce.LAW,
    nonaffine.LAW, extended_tube.LAW, table.LAW, beam.LAW)}
