"""Public Python interface: an actuator, its plans and motions, in seconds and tesla."""
