"""Torques along trajectories: logs of an arm in motion, and what they show of its drives."""
