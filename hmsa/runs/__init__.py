"""
Record of one run of one actuator, from a bag or a table: samples, commands, plans, parameters.

`record.Run` contains it; `bags.read_runs` and `tables.read_table` create it.
"""
