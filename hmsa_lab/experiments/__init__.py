"""Experiments: tuning an actuator, and calibrating coil, latency and sensor."""
