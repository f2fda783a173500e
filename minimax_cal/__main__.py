"""`python -m minimax_cal`."""

from minimax_cal.cli import main

if __name__ == "__main__":
    main()
