"""Poses at rest from ROS 2 topics to a measurement file of minimax-cal."""
