"""Studies: each is a script, ``python -m experiments.NAME``."""
