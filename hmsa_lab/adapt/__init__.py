"""
Feedback: state and parameters estimated from samples, and plans corrected by them.

`hmsa_lab.adapt.estimator.Estimator` takes levels and samples, and returns the most probable state
and parameters with their covariance; `hmsa_lab.adapt.feedback.Feedback` plans with them. The
package does not depend on ROS, and a planner without feedback does not import it.
"""
