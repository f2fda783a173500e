"""Calibration by one or several instruments that share an arm."""
