"""Sessions of node processes, and a client of the planner."""
