"""Numbers in, numbers out: the sums that every fit asks for, by NumPy and compiled by numba.

`plain` is the reference and always there; `fast` holds the same names for where numba is installed
(``pip install ".[fast]"`` in a clone).  `choice` says which of the two runs.
"""
