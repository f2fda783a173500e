"""How good a calibration is: bootstrap, maps, ISO 9283."""
