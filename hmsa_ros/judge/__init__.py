"""
Whether an actuator arrived: samples, a setpoint and tolerances in, one finding out.

Status, commands, reports, studies and benchmarks all show what `judge` finds.
"""

from hmsa_ros.judge.judging import judge
from hmsa_ros.judge.records import (
    Finding,
    missed,
    Sensor,
    Setpoint,
    Tolerances,
    unobserved,
    VERDICTS,
    worst,
)

__all__ = [
    'Finding', 'judge', 'missed', 'Sensor', 'Setpoint', 'Tolerances', 'unobserved', 'VERDICTS',
    'worst']
