"""Which poses to measure next."""
