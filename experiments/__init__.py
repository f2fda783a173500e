"""Studies: each is a script, ``python -m experiments.NAME``."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: studies run in parallel processes
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MINIMAX_CAL_NO_FSYNC", "1")  # a study that a power cut ends is run again
