"""What every room stands on: arrays, errors, whole files, tables."""
