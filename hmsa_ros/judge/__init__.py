"""
Whether an actuator arrived: samples, a setpoint and tolerances in, one finding out.

Status, commands, reports, studies and benchmarks all show what `judge` finds.
"""

from hmsa_ros.judge.judging import ENOUGH, judge, look_length, rests_from
from hmsa_ros.judge.records import (
    Finding,
    GoalTolerances,
    missed,
    Sensor,
    Setpoint,
    Tolerances,
    unobserved,
    VERDICTS,
    worst,
)

__all__ = [
    'ENOUGH', 'Finding', 'GoalTolerances', 'judge', 'look_length', 'missed', 'rests_from',
    'Sensor', 'Setpoint', 'Tolerances', 'unobserved', 'VERDICTS', 'worst']
