"""Drivers whose hardware fails, on a real serial line: the board's own record is the judge."""

import pytest

from benchmarks.faults import hardware
from benchmarks.faults.table import inject

# In the gate; the others, of which each is like one of these, take longer.
_FAST = (
    'driver_systemexit', 'driver_gil', 'driver_planner_stalled', 'driver_stalled')


@pytest.mark.ros
@pytest.mark.parametrize('fault', [
    pytest.param(x, id=x.key, marks=() if x.key in _FAST else pytest.mark.slow)
    for x in hardware.FAULTS])
def test_the_coil_is_off_or_the_truth_is_said(fault, ros_domain_id):
    seen = inject(fault, ros_domain_id)
    assert seen.met, f'expected {fault.expected}; seen {seen.text} ({seen.figure})'
