"""Copies of this process, and the processes of a session, as /proc lists them."""

import multiprocessing
import os
import signal
import sys
from pathlib import Path


def fork(work, output):
    """Do something in a copy of this process, which has imported all; its output goes to a file."""

    def run():
        for number in (1, 2):
            os.dup2(output.fileno(), number)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
        # A background shell makes its children ignore Ctrl-C; a terminal does not.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        work()

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    return process


def alive(session: int) -> list[int]:
    """Processes of a session that have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, own = path.read_text().rsplit(")", 1)[1].split()[:4]
        except OSError:  # it has ended
            continue
        if int(own) == session and state != "Z":
            found.append(int(path.parent.name))
    return found
