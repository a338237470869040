"""
How a branch of creep flows: one table, and one module for each flow with constants of its own.

Nothing here is compiled; the flows are in `hmsa_ros/motion/hmsa/flow.hpp`.
"""

from hmsa_ros.model.flows import power_law
from hmsa_ros.model.flows.record import Flow, MAXWELL

#: By name; the first is the default.
FLOWS: dict[str, Flow] = {x.name: x for x in (MAXWELL, power_law.FLOW)}
#: Names of all constants, each once.
CONSTANTS = {x.name: x for flow in FLOWS.values() for x in flow.constants}
