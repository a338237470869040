"""Sessions: node processes started together, and a client that talks to the planner."""
