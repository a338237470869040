"""
One run of one actuator, from a bag or a table: samples, commands, plans, parameters.

`record.Run` holds it; `bags.read_runs` and `tables.read_table` make it.
"""
