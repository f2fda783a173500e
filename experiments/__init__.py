"""Studies: each is a script, ``python -m experiments.NAME``."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: studies run in parallel processes
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
