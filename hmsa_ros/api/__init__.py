"""What ``import hmsa_ros`` offers: an actuator, its plans and motions, in seconds and tesla."""
