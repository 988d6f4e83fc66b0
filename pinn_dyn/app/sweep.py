"""Sweeps by ``-m``: a failed job does not end them, and at the end the failures are listed."""

from __future__ import annotations

import logging
import math
import re
import shlex
import sys
import traceback
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.run.configuration.command_line import program
from pinn_dyn.worker_processes import end_with_parent

log = logging.getLogger(__name__)

ERROR = "error.txt"
"""File in the folder of a failed job: the message in the first line, then the traceback."""


class SweepCallback(Callback):
    """Records the errors of jobs, wherever the launcher runs them.

    A job of a sweep that fails counts as one of infinite error, so that a search goes on. After the
    last job the program ends with a list of the failures and a non-zero status.
    """

    _jobs = 0  # launchers hand it to the processes of the jobs

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Name the folder of the sweep, and let processes of joblib end with this one."""
        overrides = OverridesParser.create().parse_overrides(config.hydra.overrides.task)
        sweeps = [x for x in overrides if x.is_sweep_override()]
        self._jobs = config.hydra.sweeper.get("n_trials") or math.prod(
            sum(1 for _ in x.sweep_string_iterator()) for x in sweeps
        )
        text = "after an interrupt, go on with the same command and hydra.sweep.dir=%s"
        log.info(text, config.hydra.sweep.dir)
        if "joblib" in config.hydra.launcher._target_:
            from joblib.parallel import BACKENDS, register_parallel_backend

            loky = partial(BACKENDS["loky"], initializer=end_with_parent)
            register_parallel_backend("loky", loky)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remove the error of an earlier try, and log the number of the job."""
        if config.hydra.mode == RunMode.MULTIRUN:
            log.info("job %d of %d", config.hydra.job.num + 1, self._jobs)
        (Path(config.hydra.runtime.output_dir) / ERROR).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write an error down; in a sweep turn it, and NaN, into an infinite return value."""
        is_sweep = config.hydra.mode == RunMode.MULTIRUN
        result = job_return._return_value  # the public property would raise it
        if job_return.status == JobStatus.FAILED and isinstance(result, Exception):
            write_error(Path(config.hydra.runtime.output_dir), result)
            if is_sweep:
                log.error("failed: %s: %s", type(result).__name__, result)
                job_return.status, job_return.return_value = JobStatus.COMPLETED, math.inf
        elif is_sweep and isinstance(result, float) and math.isnan(result):
            job_return.return_value = math.inf

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """End the program with a list of the jobs that failed, if any."""
        failures = sorted(Path(config.hydra.sweep.dir).rglob(ERROR))
        if failures and sys.exc_info()[0] is None:  # not interrupted
            lines = [f"{len(failures)} {'job' if len(failures) == 1 else 'jobs'} failed:"]
            for path in failures:
                lines += [f"  {path.parent}", f"    {first_line(path)}"]
            lines.append(f"The same command with hydra.sweep.dir={config.hydra.sweep.dir} goes on.")
            raise SystemExit("\n".join(lines))


def write_error(folder: Path, error: Exception) -> None:
    """Write ``error.txt`` into the folder of a job."""
    details = "".join(traceback.format_exception(error))
    (folder / ERROR).write_text(f"{type(error).__name__}: {error}\n\n{details}")


def first_line(path: Path) -> str:
    """Return the message in an ``error.txt``."""
    with path.open(errors="replace") as file:
        return file.readline(10_000).rstrip("\n")


def resume_command(folder: Path) -> str:
    """Return the command that resumes a training of this process, for a shell."""
    config_dir = get_args_parser().parse_intermixed_args(sys.argv[1:]).config_dir
    options = [f"--config-dir={config_dir}"] if config_dir else []
    quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    value = folder if re.fullmatch(r"[\w./-]+", str(folder)) else f"'{quoted}'"  # for Hydra
    return shlex.join([*program(), *options, f"resume={value}"])
