"""Measurements: reading, checking, faults, accuracy."""
