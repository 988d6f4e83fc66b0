"""Sweeps by ``-m``: a failed job does not end them, and at the end the failures are listed."""

from __future__ import annotations

import logging
import math
import shlex
import sys
import traceback
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.workers import end_with_parent

log = logging.getLogger(__name__)

ERROR = "error.txt"
"""File in the folder of a failed job: the message in the first line, then the traceback."""


class SweepCallback(Callback):
    """Records the errors of jobs, wherever the launcher runs them.

    A job that fails leaves its error in ``error.txt``. In a sweep it counts as one of infinite
    error, so that the other jobs run and a search goes on. After the last job the program ends with
    a list of the failures and a non-zero status.
    """

    unfinished: ClassVar[Path | None] = None
    """Folder of the sweep that runs in this process."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember the folder of the sweep; processes of joblib end with this one."""
        SweepCallback.unfinished = Path(config.hydra.sweep.dir)
        if "joblib" in config.hydra.launcher._target_:
            from joblib.parallel import BACKENDS, register_parallel_backend

            # The launcher has no setting for the first act of a process.
            loky = partial(BACKENDS["loky"], initializer=end_with_parent)
            register_parallel_backend("loky", loky)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remove the error of an earlier try."""
        (Path(config.hydra.runtime.output_dir) / ERROR).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write an error down; in a sweep turn it, and NaN, into an infinite return value."""
        is_sweep = config.hydra.mode == RunMode.MULTIRUN
        result = job_return._return_value  # the public property would raise it
        if isinstance(result, BaseException) and not isinstance(result, Exception):
            return  # an intended end, of which Hydra 1.4 tells too
        if job_return.status == JobStatus.FAILED:
            write_error(Path(config.hydra.runtime.output_dir), result)
            if is_sweep:
                log.error("failed: %s: %s", type(result).__name__, result)
                job_return.status = JobStatus.COMPLETED
                job_return.return_value = math.inf
        elif is_sweep and math.isnan(job_return.return_value):
            job_return.return_value = math.inf

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """List the jobs that failed.

        Raises:
            SystemExit: if a job failed.
        """
        if sys.exc_info()[0] is not None:
            return  # interrupted, of which Hydra 1.4 tells too
        SweepCallback.unfinished = None
        folder = Path(config.hydra.sweep.dir)
        if failures := sorted(folder.rglob(ERROR)):
            lines = [f"{len(failures)} {'job' if len(failures) == 1 else 'jobs'} failed:"]
            for path in failures:
                lines += [f"  {path.parent}", f"    {first_line(path)}"]
            lines.append(f"run what is missing with: {_same_command(folder)}")
            raise SystemExit("\n".join(lines))


def write_error(folder: Path, error: Exception) -> None:
    """Write ``error.txt`` into the folder of a job."""
    details = "".join(traceback.format_exception(error))
    (folder / ERROR).write_text(f"{type(error).__name__}: {error}\n\n{details}")


def first_line(path: Path) -> str:
    """Return the message in an ``error.txt``."""
    return next(iter(path.read_text(errors="replace").splitlines()), "no message")


def how_to_go_on() -> str | None:
    """Return the command that completes an interrupted sweep; None if there is none."""
    folder, SweepCallback.unfinished = SweepCallback.unfinished, None
    if folder is None or not any(folder.rglob(".hydra")):
        return None
    text = f"the sweep is not finished; go on with: {_same_command(folder)}"
    if (folder / ".submitit").is_dir():
        text += "\njobs in the queue go on by themselves: squeue --me lists them, scancel ends them"
    return text


def command_line(words: list[str] | None = None) -> str:
    """Return the command of this process, or with other arguments, for a shell."""
    program = Path(sys.argv[0]).name
    start = ["python", program] if program.endswith(".py") else [program]
    words = sys.argv[1:] if words is None else words
    return shlex.join([*start, *(word.removeprefix("++") for word in words)])


def _same_command(folder: Path) -> str:
    """Return the command of this process on the same sweep folder."""
    words = [word for word in sys.argv[1:] if not word.startswith("hydra.sweep.dir=")]
    return command_line([*words, f"hydra.sweep.dir={folder}"])
