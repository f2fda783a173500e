"""`python -m minimax_cal.cli`."""

from minimax_cal.cli import main

if __name__ == "__main__":
    main()
