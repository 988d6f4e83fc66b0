"""Compile a control law ahead of time into one file that PyTorch runs without this package."""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.control.contracts import Controller
from pinn_dyn.control.laws import ModelBasedLaw, StateFeedback
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.data.whole import write_whole
from pinn_dyn.mechanics.arrays import require_finite

INPUTS = ("q", "v", "q_ref", "v_ref", "a_ref")
TOLERANCE = 1e-5
_CHECKS = 10  # states that travel with the file
_KEY = "pinn_dyn_law"


class CompiledLaw:
    """A compiled law u = law(q, v, q_ref, v_ref, a_ref), for one state at a time.

    Attributes:
        info: what the file says about the law: ``law``, ``num_coordinates``, ``num_inputs``,
            ``position_gain``, ``velocity_gain``, ``dtype``, ``inputs``, ``torch`` (version), and
            ``check``, states ``(K, 5, N)`` with the u ``(K, M)`` of the law before it was compiled.
    """

    def __init__(self, run: Any, info: dict[str, Any]):
        self._run = run
        self.info = info
        self._shape = (info["num_coordinates"],)

    def __call__(self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, a_ref: Tensor) -> Tensor:
        """The input u ``(M,)``; q, v and the reference ``(N,)`` each, float64, SI units.

        Raises:
            ValueError: on another shape, type or memory layout, which compiled code would misread.
        """
        values = [q, v, q_ref, v_ref, a_ref]
        for name, x in zip(INPUTS, values, strict=True):
            if x.shape != self._shape or x.dtype != torch.float64 or not x.is_contiguous():
                layout = "contiguous" if x.is_contiguous() else "strided"
                raise ValueError(
                    f"{name} is {layout}, {x.dtype}, of shape {tuple(x.shape)}: expected "
                    f"contiguous, torch.float64, {self._shape}; a compiled law takes one state"
                )
        return self._run(values)[0]


def export_law(controller: Controller, path: str | Path) -> Path:
    """Compile u = law(q, v, q_ref, v_ref, a_ref) for one state and write it to a ``.pt2`` file.

    The file holds machine code from torch.export and AOTInductor, and needs nothing but PyTorch
    to run; the SHA-256 of the file stands beside it in ``<path>.sha256``, to be given to
    :func:`load_law`, or to ``sha256sum --check`` (docs/realtime.md)::

        law = torch._inductor.aoti_load_package("law.pt2").loader
        (u,) = law.run([q, v, q_ref, v_ref, a_ref])

    Inputs are ``(N,)``, u is ``(M,)``, all float64: for a law as small as that of an arm the
    calls cost more than the arithmetic, so float32 gains next to nothing, and where A(q) is nearly
    singular it misses 1e-5 by far. The kernels are compiled for one thread, for the processor and
    PyTorch version of the export. Before it returns, the file is loaded and compared with the law.

    Args:
        controller: a law without memory, its model in float64 on the CPU.
        path: the file to write; an existing one is replaced.

    Raises:
        TypeError: on a controller that has no such formula.
        ValueError: if the path does not end in .pt2, the law gives NaN or infinity where it is
            checked (entries of q, v and the reference in [-1, 1]), or it cannot be traced.
        RuntimeError: without a C++ compiler, or if the file does not repeat the law to 1e-5.
    """
    path = Path(path)
    if path.suffix != ".pt2":
        raise ValueError(f"path is {path}, expected a name that ends in .pt2, such as law.pt2")
    if not isinstance(controller, StateFeedback):
        raise TypeError(
            f"controller is a {type(controller).__name__}, expected a law "
            "u = law(q, v, q_ref, v_ref, a_ref) without memory, such as Tracking or Regulation"
        )
    if not has_cpp_compiler():
        raise RuntimeError(
            "export_law needs a C++ compiler and found none: install g++ (Debian, Ubuntu: apt "
            "install g++). Only the export needs it, not the machine that runs the law"
        )
    module = _LawModule(controller)
    generator = torch.Generator().manual_seed(0)
    shape = (_CHECKS, len(INPUTS), controller.num_coordinates)
    states = 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1
    with torch.no_grad():
        u = torch.stack([controller.law(*state) for state in states])
        require_finite(f"u of the {type(controller).__name__} law", u)
        try:
            program = torch.export.export(module, tuple(states[0]))
        except Exception as error:  # the tracer raises nearly anything
            raise ValueError(
                f"the {type(controller).__name__} law cannot be exported: torch.export cannot "
                "trace it. Export a law on a learned model (model=lnn or model=hnn), not on a "
                f"simulator; the cause: {error}"
            ) from error
        path.parent.mkdir(parents=True, exist_ok=True)
        # Beside its place and then moved there: a kill leaves the law of before, or none.
        partial = path.with_name(f"{path.stem}.partial.pt2")
        try:
            torch._inductor.aoti_compile_and_package(
                program,
                package_path=str(partial),
                inductor_configs={
                    "cpp.threads": 1,
                    "aot_inductor.metadata": {_KEY: json.dumps(_describe(controller, states, u))},
                },
            )
            load_law(partial)
            digest = _digest(partial)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    write_whole(path.with_name(f"{path.name}.sha256"), f"{digest}  {path.name}\n")
    return path


def load_law(path: str | Path, sha256: str | None = None) -> CompiledLaw:
    """Load a compiled law and check it against the values that it was exported with.

    The file is machine code: loading it runs whatever its author wrote, with your rights. Load
    files from people you trust only, and give the checksum that the export wrote, which you got on
    another way than the file, so that nobody can have exchanged it.

    Args:
        path: the ``.pt2`` file.
        sha256: the 64 hexadecimal digits of ``<path>.sha256``, compared before anything is loaded.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file has another checksum, holds entries that lead out of the folder that
            it is unpacked in, or was not written by :func:`export_law`.
        RuntimeError: if it was exported by another version of PyTorch, or misses the values that
            travel with it by more than 1e-5 of their norm.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file, expected one that export_law wrote")
    if sha256 is not None and (digest := _digest(path)) != sha256.strip().lower():
        raise ValueError(
            f"{path} has the SHA-256 {digest}, expected {sha256}: it is not the file that was "
            "exported, do not load it"
        )
    info = _read_info(path)
    if info["torch"] != torch.__version__:
        raise RuntimeError(
            f"{path} was exported with torch {info['torch']}, this is torch {torch.__version__}: "
            "compiled code is only sure to run on the version it was made with; export it again"
        )
    loader = torch._inductor.aoti_load_package(str(path), run_single_threaded=True).loader
    law = CompiledLaw(loader.run, info)
    states = torch.tensor(info["check"]["states"], dtype=torch.float64)
    expected = torch.tensor(info["check"]["u"], dtype=torch.float64)
    u = torch.stack([law(*state) for state in states])
    error = ((u - expected).norm(dim=-1) / expected.norm(dim=-1)).max()
    if not error <= TOLERANCE:
        raise RuntimeError(
            f"{path} misses the law it was exported from by {float(error):.1e} (relative), "
            f"expected at most {TOLERANCE:g}. Export it on the machine that runs it; if that does "
            "not help, look at the condition numbers of M(q) and A(q): if one is large, the "
            "computed input is dominated by rounding errors"
        )
    return law


class _LawModule(nn.Module):
    """The formula of a law as a module for torch.export."""

    def __init__(self, controller: StateFeedback):
        super().__init__()
        self.law = controller.law
        # Registered here, the model's weights become constants of the compiled file.
        self.model = controller.model if isinstance(controller, ModelBasedLaw) else None

    def forward(self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, a_ref: Tensor) -> Tensor:
        return self.law(q, v, q_ref, v_ref, a_ref)


def _describe(controller: StateFeedback, states: Tensor, u: Tensor) -> dict[str, Any]:
    return {
        "law": type(controller).__name__,
        "num_coordinates": controller.num_coordinates,
        "num_inputs": controller.num_inputs,
        "position_gain": controller.position_gain.tolist(),
        "velocity_gain": controller.velocity_gain.tolist(),
        "dtype": "float64",
        "inputs": INPUTS,
        "torch": torch.__version__,
        "check": {"states": states.tolist(), "u": u.tolist()},
    }


def _read_info(path: Path) -> dict[str, Any]:
    """Read the description of the law before any code of the file is loaded."""
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                _check_entry(path, entry.orig_filename)
            if damaged := archive.testzip():
                raise zipfile.BadZipFile(f"{damaged} has another checksum")
            described = [
                archive.read(entry)
                for entry in archive.infolist()
                if entry.filename.endswith("_metadata.json")
            ]
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:  # or encrypted
        raise ValueError(f"{path} is no exported law, or it is cut short: {error}") from error
    for text in described:
        try:
            info: dict[str, Any] = json.loads(json.loads(text)[_KEY])
        except (ValueError, TypeError, KeyError):
            continue
        return info
    raise ValueError(
        f"{path} is a package, but no law that export_law wrote: it does not hold the entry {_KEY}"
    )


def _check_entry(path: Path, name: str) -> None:
    """Check that an entry is unpacked inside its folder.

    Raises:
        ValueError: naming the entry.
    """
    parts = re.split(r"[/\\]", name)
    if ".." in parts or parts[0] == "" or ":" in parts[0] or "\0" in name:
        raise ValueError(
            f"{path} holds the entry {name!r}, expected names inside the archive, without '..' and "
            "not absolute: it is no file that export_law wrote, do not load it"
        )


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
