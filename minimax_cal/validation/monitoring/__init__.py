"""A calibration watched: whether it still holds, what moved, what differs from another."""
