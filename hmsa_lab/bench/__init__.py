"""What is on a bench: amplifiers, sensors and boards, their calibration and their simulation."""

from hmsa_lab.bench.assembly import Assembly, CoilModel, parts, SensorScale

__all__ = ['Assembly', 'CoilModel', 'parts', 'SensorScale']
