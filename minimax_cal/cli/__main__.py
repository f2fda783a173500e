"""`python -m minimax_cal.cli`."""

from minimax_cal.cli import main

main()
