"""Measurements of speed and accuracy: ``python -m benchmarks [planner|plant|recorder]``."""
