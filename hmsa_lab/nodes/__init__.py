"""Nodes and hardware classes that convert topics of other nodes."""
