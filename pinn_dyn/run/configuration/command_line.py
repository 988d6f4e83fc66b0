"""The program that runs: its command, and the messages that it leaves out."""

from __future__ import annotations

import logging
import shlex
import shutil
import sys
import warnings
from pathlib import Path


def command_line() -> str:
    """Return the command of this process, for a shell."""
    return shlex.join([*program(), *(word.removeprefix("++") for word in sys.argv[1:])])


def program() -> list[str]:
    """Return the words that start this program."""
    path = Path(sys.argv[0])
    if path.suffix == ".py":
        return ["python", str(path)]
    by_name = shutil.which(path.name)
    is_found = by_name is not None and Path(by_name).resolve() == path.resolve()
    return [path.name if is_found else str(path)]


def hush() -> None:
    """Suppress messages that users cannot act on: about hardware, and between our libraries."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", r".*isinstance\(treespec, LeafSpec\)")
    warnings.filterwarnings("ignore", r".*torch\._prims_common\.check")
    warnings.filterwarnings("ignore", r"The `srun` command is available")
