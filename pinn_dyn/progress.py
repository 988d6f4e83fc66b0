"""Progress of long tasks, as lines of the log."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import time

log = logging.getLogger(__name__)

FIRST, INTERVAL = 2.0, 10.0
"""Times before the first line and between two lines, s."""


class Progress(contextlib.AbstractContextManager["Progress"]):
    """Progress of a task, logged every ten seconds even if no update arrives::

        with Progress("evaluation", total=5, unit="models") as progress:
            progress.update(2, ", now mlp")  # evaluation: 2 of 5 models, now mlp, 14 s left

    A program without logging handlers, such as a notebook, gets the lines on stderr.

    Args:
        task: name of the task; None logs nothing.
        total: value of a finished task.
        unit: unit of the values, for the lines.
    """

    def __init__(self, task: str | None, total: float, unit: str):
        self.task, self.total, self.unit = task, total, unit
        self._state: tuple[float, str] = (0, "")
        self._first: tuple[float, float] | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._write_lines, daemon=True)

    def update(self, done: float, details: str = "") -> None:
        """Set the finished part, and details that the next line adds."""
        self._first = self._first or (time.monotonic(), done)
        self._state = done, details

    def __enter__(self) -> Progress:
        if self.task is not None:
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()

    def __str__(self) -> str:
        done, details = self._state
        parts = [f"{x:.2f}" if isinstance(x, float) else f"{x}" for x in (done, self.total)]
        text = f"{self.task}: {' of '.join(parts)} {self.unit}{details}"
        start, before = self._first or (0.0, done)
        if not before < done < self.total:  # no measured speed, which excludes a compilation
            return text
        seconds = (time.monotonic() - start) * (self.total - done) / (done - before)
        minutes = f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"
        return f"{text}, {minutes} left"

    def _write_lines(self) -> None:
        wait = FIRST
        while not self._end.wait(wait):
            wait = INTERVAL
            line = str(self)
            if log.hasHandlers():
                log.info("%s", line)
            else:
                print(line, file=sys.stderr, flush=True)
