"""ROS 2 edge: the planner, plant, recorder and player nodes, and what they share."""
