"""Entry points of train.py and the other programs, and of the installed scripts."""

from __future__ import annotations

import importlib
import io
import os
import re
import sys
from contextlib import nullcontext, redirect_stdout
from functools import partial
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pinn_dyn import wording
from pinn_dyn.app.config import completed, composed, config_folder, explained
from pinn_dyn.app.sweep import write_error
from pinn_dyn.run.configuration.command_line import hush
from pinn_dyn.run.configuration.validation import ConfigError


def main(command: str) -> None:
    """Run ``pinn_dyn.app.<command>`` on the configuration that the command line describes."""
    flags = get_args_parser().parse_intermixed_args(sys.argv[1:])
    options = [word for word in sys.argv[1:] if word not in flags.overrides]
    shows = flags.help or flags.hydra_help or flags.cfg or flags.info or flags.shell_completion
    installed = Path(sys.argv[0]).name.startswith("pinn-dyn-")
    help_text = io.StringIO()  # names the scripts of a checkout
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises what it would print a traceback of
    hush()
    try:
        if not flags.shell_completion:
            sys.argv[1:] = [*options, *completed(command, flags.overrides)]
        if not (shows or flags.config_name or flags.config_path):
            composed(command, flags.overrides, flags.config_dir)
        folder = str(config_folder(command))
        run = partial(_run, command)
        try:
            with redirect_stdout(help_text) if flags.help and installed else nullcontext():
                hydra.main(version_base="1.3", config_path=folder, config_name=command)(run)()
        finally:
            text = re.sub(r"python (\w+)\.py", r"pinn-dyn-\1", help_text.getvalue())
            print(text, end="", flush=True)
    except BrokenPipeError:
        if not shows:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # --help | head
    except KeyboardInterrupt:
        raise SystemExit("interrupted") from None
    except (HydraException, OmegaConfBaseException) as error:
        raise SystemExit(f"Error: {explained(error)}") from error
    except ConfigError as error:
        raise SystemExit(f"Error: {error}") from error


def _run(command: str, cfg: DictConfig) -> object:
    # PyTorch and Lightning take seconds to import, which --help does not need.
    from pinn_dyn.data import SimulationError
    from pinn_dyn.training import NonFiniteLossError

    module = importlib.import_module(f"pinn_dyn.app.{command}")
    task = getattr(module, "main", None) or getattr(module, command)
    try:
        with wording.command_line():
            return task(cfg)
    except (ConfigError, NonFiniteLossError, SimulationError) as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # SweepCallback goes on with the other jobs
        write_error(Path(HydraConfig.get().runtime.output_dir), error)
        raise SystemExit(f"Error: {error}") from error


COMMANDS = ("train", "evaluate", "control", "gather", "check", "excite")
train, evaluate, control, gather, check, excite = (partial(main, name) for name in COMMANDS)
