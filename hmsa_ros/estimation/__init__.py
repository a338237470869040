"""
State and parameters of a moving actuator, estimated from samples in real time.

`Estimator` takes levels and samples, and returns the most probable state and parameters with their
covariance. The package does not depend on ROS.
"""

from hmsa_ros.estimation.estimator import Estimate, Estimator, Options
from hmsa_ros.estimation.prior import Prior

__all__ = ['Estimate', 'Estimator', 'Options', 'Prior']
