"""The commands: what train.py, check.py and the others, and the installed scripts call.

A command is the function of its name in the module of its name beside this one, and its
configuration is ``conf/<name>.yaml``.
"""

from __future__ import annotations

import errno
import importlib
import logging
import sys
import warnings
from functools import partial

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.app.config import ConfigError, completed, config_folder
from pinn_dyn.app.sweep import how_to_go_on

# Of a disk that is full, also by a quota or a limit on one file, or that may only be read.
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def main(command: str) -> None:
    """Run a command, as train, on the configuration that the command line asks for.

    A misspelt key ends the program before anything is written, with the keys that were probably
    meant; so does an error that the user can mend, without a traceback.
    """
    if not {"-sc", "--shell-completion"} & set(sys.argv):  # whose words are no overrides
        try:
            sys.argv[1:] = completed(command, sys.argv[1:])
        except ConfigError as error:
            raise SystemExit(f"Error: {error}") from error

    def run(cfg: DictConfig) -> object:
        # PyTorch and Lightning take seconds to import, which --help and a misspelt key do not need.
        from pinn_dyn.data import SimulationError
        from pinn_dyn.training import NonFiniteLossError

        task = getattr(importlib.import_module(f"pinn_dyn.app.{command}"), command)
        try:
            return task(cfg)
        except (ConfigError, NonFiniteLossError, SimulationError) as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # SweepCallback then goes on with the other jobs
            raise SystemExit(f"Error: {error}") from error
        except OSError as error:
            if error.errno not in _DISK or HydraConfig.get().mode == RunMode.MULTIRUN:
                raise
            place = error.filename or f"a file in {HydraConfig.get().runtime.output_dir}"
            raise SystemExit(
                f"Error: {place} cannot be written: {error.strerror}. What was written before is "
                "whole: free space, or choose another folder, and give the same command again"
            ) from error

    hush()
    try:
        folder = str(config_folder(command))
        hydra.main(version_base="1.3", config_path=folder, config_name=command)(run)()
    except KeyboardInterrupt:
        raise SystemExit("interrupted") from None
    finally:
        if hint := how_to_go_on():
            print(hint, file=sys.stderr)


def hush() -> None:
    """Keep from users what they cannot act on: hardware, and our libraries about each other."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r".*isinstance\(treespec, LeafSpec\)")
    warnings.filterwarnings("ignore", r".*torch\._prims_common\.check")


train = partial(main, "train")
evaluate = partial(main, "evaluate")
control = partial(main, "control")
gather = partial(main, "gather")
check = partial(main, "check")
