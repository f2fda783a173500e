"""Calibration: start, identification, fit, weights, uncertainty."""
