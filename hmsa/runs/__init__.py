"""
Record of one run of one actuator, from a bag: samples, commands, plans, parameters.

`record.Run` contains it; `bags.read_runs` creates it.
"""
