"""
Whether an actuator arrived: samples, a setpoint and tolerances in, one finding out.

Status, commands, reports, studies and benchmarks all show what `judging.judge` finds.
"""
