"""Fault injection: processes that disturb, a rig of real nodes, and the table of faults."""
