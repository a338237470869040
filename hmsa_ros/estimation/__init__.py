"""
State and parameters of an actuator that is being moved, estimated from samples as they come.

`Estimator` takes levels and samples, and gives the most probable state and parameters with their
covariance. Nothing here needs ROS.
"""

from hmsa_ros.estimation.estimator import Estimate, Estimator, Options
from hmsa_ros.estimation.prior import Prior

__all__ = ['Estimate', 'Estimator', 'Options', 'Prior']
