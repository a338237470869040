"""
Judgement of arrivals: samples, a setpoint and tolerances in, one finding out.

Status, commands, reports, studies and benchmarks all show the result of `judging.judge`.
"""
