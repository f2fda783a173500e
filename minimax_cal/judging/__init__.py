"""How good a calibration is: bootstrap, trade-off, maps, ISO 9283."""
