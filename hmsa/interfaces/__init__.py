"""Definitions shared by nodes, bags, files and reports: topics, parameters, units, defaults."""
