"""Worker processes that end with their parent.

This module imports no package of pinn_dyn, so that a worker watches before it imports PyTorch.
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
    """End this process soon after its parent, also if the parent was killed.

    Otherwise a worker of a killed parent would finish its task and then wait forever.
    """
    global _watching
    if not _watching:
        _watching = True
        # A parent that was killed before this line is no longer the parent of this process.
        parent = multiprocessing.parent_process()
        pid = os.getppid() if parent is None else parent.pid
        threading.Thread(target=_watch, args=(pid,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    # A normal exit would wait for the parent; files are whole or absent at any moment.
    os._exit(128 + signal.SIGTERM)
