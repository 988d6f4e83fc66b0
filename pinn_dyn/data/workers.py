"""Processes that work for another one."""

from __future__ import annotations

import os
import signal
import threading
import time

_POLL = 1.0  # s

_watching = False


def end_with_parent() -> None:
    """End this process soon after the one that started it, however that one ended.

    A worker whose parent was killed would wait for its next task for ever.
    """
    global _watching
    if not _watching:
        _watching = True
        threading.Thread(target=_watch, args=(os.getppid(),), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    # An orderly end waits for the parent too; what is written is whole or absent at any moment.
    os._exit(128 + signal.SIGTERM)
