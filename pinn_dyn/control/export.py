"""Compile a control law ahead of time into one file that PyTorch runs without this package."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.control.contracts import Controller
from pinn_dyn.control.laws import ModelBasedLaw, StateFeedback
from pinn_dyn.data.simulation import has_cpp_compiler
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
    to run (docs/realtime.md)::

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
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(path),
            inductor_configs={
                "cpp.threads": 1,
                "aot_inductor.metadata": {_KEY: json.dumps(_describe(controller, states, u))},
            },
        )
    try:
        load_law(path)
    except RuntimeError:
        path.unlink()
        raise
    return path


def load_law(path: str | Path) -> CompiledLaw:
    """Load a compiled law and check it against the values that it was exported with.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file was not written by :func:`export_law`.
        RuntimeError: if it was exported by another version of PyTorch, or misses the values that
            travel with it by more than 1e-5 of their norm.
    """
    path = Path(path)
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
    found = torch.stack([law(*state) for state in states])
    error = ((found - expected).norm(dim=-1) / expected.norm(dim=-1)).max()
    if not error <= TOLERANCE:
        raise RuntimeError(
            f"{path} misses the law it was exported from by {float(error):.1e} (relative), "
            f"expected at most {TOLERANCE:g}. Export it on the machine that runs it; if that does "
            "not help, look at the condition numbers of M(q) and A(q): where one of them is nearly "
            "singular, u hangs on rounding"
        )
    return law


class _LawModule(nn.Module):
    """The formula of a law as the module that torch.export asks for."""

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
    """What the file says about itself, read before any of its code is loaded."""
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                if name.endswith("_metadata.json"):
                    metadata = json.loads(archive.read(name))
                    if _KEY in metadata:
                        return json.loads(metadata[_KEY])
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path} is no exported law, or it is cut short: {error}") from error
    raise ValueError(
        f"{path} is a package, but no law that export_law wrote: it does not hold the entry {_KEY}"
    )
