"""A command of the page in a process of its own: it tells every stage, and ends with the page."""

import os
import sys
import threading
import time
from _thread import interrupt_main

from minimax_cal.cli import INTERRUPTED, main, raise_on_signals

PATIENCE = 3.0  # seconds from being interrupted to being ended


def end_with_parent() -> None:
    """Interrupt the work once the other end of stdin is closed."""
    while os.read(0, 1):
        pass
    interrupt_main()
    time.sleep(PATIENCE)
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    raise_on_signals()
    threading.Thread(target=end_with_parent, daemon=True).start()
    os.chdir(sys.argv[1])  # the session's folder, once all is imported from where the page is
    main(sys.argv[2:])
