"""What a planner does at work, without ROS: requests and news in, commands and verdicts out."""
