"""All faults of the table, in order."""

from benchmarks.faults import (
    apart,
    delivery,
    hardware,
    inputs,
    model,
    processes,
    samples,
    set_clocks,
    timing,
)

FAULTS = (
    *delivery.FAULTS, *processes.FAULTS, *timing.FAULTS, *set_clocks.FAULTS, *inputs.FAULTS,
    *model.FAULTS, *samples.FAULTS, *hardware.FAULTS, *apart.FAULTS)

#: Faults injected by the tests: one of each kind.
QUICK = (
    'none', 'twice', 'drop_move', 'planner_restarted', 'planner_stopped',
    'planner_stalled', 'plant_stalled', 'stranger_first', 'parameter_refused', 'set_plant_-5',
    'set_both_60')
