"""A command of the page in a process of its own: it tells every stage, and ends with the page."""

import os
import sys
import threading
import time
from _thread import interrupt_main

from minimax_cal.cli import INTERRUPTED_EXIT_CODE, main, raise_on_termination_signals

SECONDS_BEFORE_FORCED_END = 3.0  # seconds from being interrupted to being ended


def end_when_stdin_closes() -> None:
    """Interrupt the work once the other end of stdin is closed."""
    while os.read(0, 1):
        pass
    interrupt_main()
    time.sleep(SECONDS_BEFORE_FORCED_END)
    os._exit(INTERRUPTED_EXIT_CODE)


if __name__ == "__main__":
    raise_on_termination_signals()
    threading.Thread(target=end_when_stdin_closes, daemon=True).start()
    os.chdir(sys.argv[1])  # the session's folder, once all is imported from where the page is
    main(sys.argv[2:])
