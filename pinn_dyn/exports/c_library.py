"""Compile C code and load it into this process."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from pinn_dyn.exports.c_file import compile_c, find_compiler

log = logging.getLogger(__name__)

_FLAGS = ["-std=gnu99", "-march=native", "-fno-math-errno", "-fPIC", "-shared"]
_FLAGS += ["-D__FAST_MATH__"]  # makes glibc declare exp, tanh and so on of vectors, nothing else
QUICK = ("-O2", "-ftree-vectorize", "-fvect-cost-model")
"""Flags of an optimization with a third of the compilation time of ``-O3``, for a rigid chain with
sticking joints. The code has 0.7 to 0.8 of the speed (benchmarks/long_rollout.py)."""


def load_code(code: str, optimization: Sequence[str] = ("-O3",)) -> ctypes.CDLL:
    """Load C code as a library; compile it for this processor if the cache folder has none.

    Loading a library runs its code. A file in the cache is therefore loaded only if no other user
    owns it or may write it, and its content has the SHA-256 in its name. ``optimization`` is a list
    of compiler flags.

    Raises:
        FileNotFoundError: if no C compiler is installed.
        RuntimeError: if the compiler fails.
    """
    compiler = find_compiler()
    if compiler is None:
        raise FileNotFoundError("no C compiler is installed: set CC to one")
    flags, folder = [*_FLAGS, *optimization], _folder()
    digest = hashlib.sha256((code + _target(*compiler, *flags)).encode()).hexdigest()
    for library in _unchanged(digest, "so"):
        return ctypes.CDLL(str(library))
    is_cache = _is_safe(folder) and os.access(folder, os.W_OK)
    with TemporaryDirectory(dir=folder if is_cache else None) as name:
        source = Path(name) / "code.c"
        source.write_text(code)
        compiled = compile_c(compiler, flags, source)
        compiled.chmod(0o700)
        loaded = ctypes.CDLL(str(compiled))
        if is_cache:
            os.replace(compiled, folder / f"{digest}-{_sha256(compiled)}.so")
    return loaded


def remember(key: str, content: Any) -> None:
    """Store tensors and plain values in the cache folder, for :func:`recall` in later processes."""
    folder = _folder()
    if not _is_safe(folder):
        return
    with suppress(OSError), TemporaryDirectory(dir=folder) as name:
        path = Path(name) / "code.pt"
        torch.save(content, path)
        path.chmod(0o600)
        earlier = [*folder.glob(f"{key}-*.pt")]
        os.replace(path, folder / f"{key}-{_sha256(path)}.pt")
        for old in earlier:
            old.unlink(missing_ok=True)


def recall(key: str) -> Any:
    """Return the content that :func:`remember` has stored, or None."""
    for path in _unchanged(key, "pt"):
        with suppress(Exception):  # of another version of PyTorch
            return torch.load(path, weights_only=True)
    return None


def _folder() -> Path:
    """Return the cache folder. Only this user may write to it."""
    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser() / "compiled"
    with suppress(OSError):  # with a read-only folder, a library is for this process only
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.is_dir() and not _is_safe(folder):
        log.warning(
            "%s is not used, since other users own it or may write to it: run chmod -R go-w there",
            folder,
        )
    return folder


def _unchanged(key: str, ending: str) -> list[Path]:
    """Return the file of a key in the cache folder whose content has the SHA-256 in its name."""
    folder = _folder()
    paths = folder.glob(f"{key}-*.{ending}") if _is_safe(folder) else []
    return [x for x in paths if _is_safe(x) and x.name == f"{key}-{_sha256(x)}.{ending}"]


def _is_safe(path: Path) -> bool:
    """Return true for a file or folder that this user owns and no other user may write."""
    try:
        status = path.stat()
    except OSError:
        return False
    return status.st_uid == os.getuid() and not status.st_mode & 0o022


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def _target(*compiler: str) -> str:
    """Return the version of a compiler, and all its flags for this processor."""
    command = [*compiler, "-###", "-E", "-x", "c", "-"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stderr
