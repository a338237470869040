"""A planner at work, without ROS: from requests, receipts and samples to commands and verdicts."""
