"""The commands: what train.py, check.py and the others, and the installed scripts call.

A command is the function of its name in the module of its name beside this one, and its
configuration is ``conf/<name>.yaml``.
"""

from __future__ import annotations

import errno
import importlib
import io
import logging
import os
import sys
import traceback
import warnings
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pinn_dyn.app import words
from pinn_dyn.app.config import ConfigError, completed, config_folder
from pinn_dyn.app.flags import in_order
from pinn_dyn.app.sweep import how_to_go_on, write_error

# Of a disk that is full, also by a quota or a limit on one file, or that may only be read.
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
# What takes less memory.
_LESS = {
    "train": "lower data.batch_size or ensemble",
    "evaluate": "give fewer runs, or lower horizon",
    "control": "lower runs or duration",
}


def main(command: str) -> None:
    """Run a command, as train, on the configuration that the command line asks for.

    A misspelt key ends the program before anything is written, with the keys that were probably
    meant; so does an error that the user can mend, without a traceback.
    """
    try:
        sys.argv[1:] = in_order(command, sys.argv[1:])
        if not {"-sc", "--shell-completion"} & set(sys.argv):  # whose words are no overrides
            sys.argv[1:] = completed(command, sys.argv[1:])
    except ConfigError as error:
        raise SystemExit(f"Error: {error}") from error
    began = False

    def run(cfg: DictConfig) -> object:
        nonlocal began
        began = True
        # PyTorch and Lightning take seconds to import, which --help and a misspelt key do not need.
        from pinn_dyn.data import SimulationError
        from pinn_dyn.training import NonFiniteLossError

        module = importlib.import_module(f"pinn_dyn.app.{command}")
        task = getattr(module, "main", None) or getattr(module, command)
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.FileHandler):
                handler.handleError = partial(_raise, handler)  # type: ignore[method-assign]
        try:
            return task(cfg)
        except Exception as error:
            known = isinstance(error, (ConfigError, NonFiniteLossError, SimulationError))
            said = str(error) if known else _in_a_line(command, error)
            if said is None or HydraConfig.get().mode == RunMode.MULTIRUN:
                raise  # SweepCallback then goes on with the other jobs
            write_error(Path(HydraConfig.get().runtime.output_dir), error)
            raise SystemExit(f"Error: {said}") from error

    hush()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises what it would print a traceback of
    try:
        folder = str(config_folder(command))
        hydra.main(version_base="1.3", config_path=folder, config_name=command)(run)()
    except KeyboardInterrupt:
        raise SystemExit("interrupted") from None
    except BrokenPipeError:  # of head, say, which has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except Exception as error:
        said = _in_a_line(command, error)
        if said is None and not began and any("hydra" in word for word in sys.argv[1:]):
            said = words.refused(sys.argv[1:], error)
        if said is None:
            raise
        raise SystemExit(f"Error: {said}") from error
    finally:
        if hint := how_to_go_on():
            print(hint, file=sys.stderr)


def _in_a_line(command: str, error: BaseException) -> str | None:
    """What Hydra or the system says that a user can mend; None of what looks like a bug."""
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return words.said(config_folder(command), error)
    # torch.OutOfMemoryError, of a GPU, goes by its name: --help does without torch.
    full = isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"
    if full or "can't allocate memory" in str(error):
        less = _LESS.get(command, "give fewer runs or shorter logs")
        return f"there is not enough memory ({error}): {less}"
    if isinstance(error, ValueError) and isinstance(error.__cause__, OSError):
        error = error.__cause__  # logging says so of a file that it cannot open
    if isinstance(error, OSError) and error.errno in _DISK:
        return (
            f"{error.filename or _place(error)} cannot be written: {error.strerror}. What was "
            "written before is whole: free space, or choose another folder, and give the same "
            "command again"
        )
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return None


def _place(error: OSError) -> str:
    """What could not be written: the system names no file of a write, but somebody has it open."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    for value in (value for frame in reversed(frames) for value in frame.f_locals.values()):
        if isinstance(value, io.IOBase) and isinstance(name := getattr(value, "name", 0), str):
            return name
    folder = HydraConfig.get().runtime.output_dir if HydraConfig.initialized() else "the run folder"
    return f"a file in {folder}"


def _raise(handler: logging.FileHandler, record: logging.LogRecord) -> None:
    """Let an error of the disk through, of which logging prints a traceback for each message."""
    error = sys.exc_info()[1]
    if not isinstance(error, OSError):
        return logging.Handler.handleError(handler, record)
    error.filename = handler.baseFilename
    raise error


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
