"""Processes that work for another one.

Outside the rooms, whose imports take seconds: a worker watches before it imports PyTorch.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time

_POLL = 1.0  # s

_watching = False


def end_with_parent() -> None:
    """End this process soon after the one that started it, however and whenever that one ended.

    A worker whose parent was killed would do its task to the end, then wait for another for ever.
    """
    global _watching
    if not _watching:
        _watching = True
        # As the parent said itself: one killed before this line is no parent any more.
        parent = multiprocessing.parent_process()
        pid = os.getppid() if parent is None else parent.pid
        threading.Thread(target=_watch, args=(pid,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    # An orderly end waits for the parent too; what is written is whole or absent at any moment.
    os._exit(128 + signal.SIGTERM)
