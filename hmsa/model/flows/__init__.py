"""
Flow rules of viscoelastic branches: a table, and one module for each rule with constants.

These modules are not compiled; the rules are in `hmsa/motion/hmsa/flow.hpp`.
"""

from hmsa.model.flows import power_law
from hmsa.model.flows.record import Flow, MAXWELL

#: Flow rules by name; the first is the default.
FLOWS: dict[str, Flow] = {x.name: x for x in (MAXWELL, power_law.FLOW)}
#: Names of all constants, each once.
CONSTANTS = {x.name: x for flow in FLOWS.values() for x in flow.constants}
