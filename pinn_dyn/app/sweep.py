"""Sweeps by ``-m``: a failed job does not end them, and at the end the failures are listed."""

from __future__ import annotations

import logging
import math
import sys
import traceback
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.app.words import command_line
from pinn_dyn.workers import end_with_parent

log = logging.getLogger(__name__)

ERROR = "error.txt"
"""Beside a job's configuration: why it failed, the message in the first line."""


class SweepCallback(Callback):
    """What Hydra tells about its jobs, wherever the launcher runs them.

    A job that fails leaves its error in ``error.txt``. In a sweep it counts as one of infinite
    error, so that the others run and a search goes on; the failures end the program when all jobs
    are done.
    """

    unfinished: ClassVar[Path | None] = None
    """Folder of the sweep under way in this process."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remember that a sweep is under way, whose processes end with this one."""
        SweepCallback.unfinished = Path(config.hydra.sweep.dir)
        if "joblib" in config.hydra.launcher._target_:
            from joblib.parallel import BACKENDS, register_parallel_backend

            # The launcher has no setting for the first act of a process.
            loky = partial(BACKENDS["loky"], initializer=end_with_parent)
            register_parallel_backend("loky", loky)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Forget how an earlier try ended."""
        (Path(config.hydra.runtime.output_dir) / ERROR).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write down an error; in a sweep turn it, and NaN, into an infinite return value."""
        sweep = config.hydra.mode == RunMode.MULTIRUN
        error = job_return._return_value  # the public property would raise it
        if isinstance(error, BaseException) and not isinstance(error, Exception):
            return  # an end that was asked for, of which Hydra 1.4 tells too
        if job_return.status == JobStatus.FAILED:
            write_error(Path(config.hydra.runtime.output_dir), error)
            if sweep:
                log.error("failed: %s: %s", type(error).__name__, error)
                job_return.status = JobStatus.COMPLETED
                job_return.return_value = math.inf
        elif sweep and math.isnan(job_return.return_value):
            job_return.return_value = math.inf

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """List the jobs that failed.

        Raises:
            SystemExit: if there are any.
        """
        if sys.exc_info()[0] is not None:
            return  # interrupted, of which Hydra 1.4 tells too
        SweepCallback.unfinished = None
        folder = Path(config.hydra.sweep.dir)
        failures = sorted(folder.rglob(ERROR))
        if failures:
            lines = [f"{len(failures)} {'job' if len(failures) == 1 else 'jobs'} failed:"]
            for path in failures:
                lines += [f"  {path.parent}", f"    {first_line(path)}"]
            lines.append(f"run what is missing with: {_same_command(folder)}")
            raise SystemExit("\n".join(lines))


def write_error(folder: Path, error: Exception) -> None:
    """Leave an ``error.txt`` in the folder of a job, for those who gather its results."""
    said = f"{type(error).__name__}: {error}"
    details = "".join(traceback.format_exception(error))
    try:
        (folder / ERROR).write_text(f"{said}\n\n{details}")
    except OSError as problem:  # a full disk leaves an empty file, which counts too
        log.error("%s cannot be written: %s", folder / ERROR, problem)


def first_line(path: Path) -> str:
    """The message in an ``error.txt``."""
    lines = path.read_text(errors="replace").splitlines()
    return lines[0] if lines else "without a word: was the disk full?"


def how_to_go_on() -> str | None:
    """What to do about a sweep that ended before its last job; None if there is none."""
    folder, SweepCallback.unfinished = SweepCallback.unfinished, None
    if folder is None or not any(folder.rglob(".hydra")):
        return None
    text = f"the sweep is not finished; go on with: {_same_command(folder)}"
    if (folder / ".submitit").is_dir():
        text += "\njobs in the queue go on by themselves: squeue --me lists them, scancel ends them"
    return text


def _same_command(folder: Path) -> str:
    """The command that this process was called with, on the same sweep folder."""
    words = [word for word in sys.argv[1:] if not word.startswith("hydra.sweep.dir=")]
    return command_line([*words, f"hydra.sweep.dir={folder}"])
