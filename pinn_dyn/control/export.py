"""Files of control laws for other programs, and the loader of those that PyTorch runs."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pinn_dyn.control.contracts import Controller
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import ModelBasedLaw
from pinn_dyn.control.region import Guarded
from pinn_dyn.control.safe_law import SafeLaw
from pinn_dyn.data.whole import write_whole
from pinn_dyn.exports.exported import (
    ENDINGS,
    ExportedFunction,
    Ranges,
    Real,
    drawn_states,
    write,
)

log = logging.getLogger(__name__)

INPUTS = ("q", "v", "q_ref", "v_ref", "a_ref")
TOLERANCE = 1e-5
_CHECKS = 10  # states that travel with the file
_KEY = "pinn_dyn_law"


class CompiledLaw:
    """A compiled law u = law(q, v, q_ref, v_ref, a_ref), for one state at a time.

    Attributes:
        info: sizes, gains and PyTorch version of the law, and ``check``, some states ``(K, 5, N)``
            with their u ``(K, M)`` before the compilation.
    """

    def __init__(self, run: Callable[[list[Tensor]], list[Tensor]], info: dict[str, Any]):
        self._run = run
        self.info = info

    def __call__(self, q: Tensor, v: Tensor, q_ref: Tensor, v_ref: Tensor, a_ref: Tensor) -> Tensor:
        """Return u ``(M,)`` from contiguous float64 tensors ``(N,)`` in SI units.

        Raises:
            ValueError: on another shape, type or memory layout, which compiled code would misread.
        """
        values = [q, v, q_ref, v_ref, a_ref]
        shape = (self.info["num_coordinates"],)
        for name, x in zip(INPUTS, values, strict=True):
            if x.shape != shape or x.dtype != torch.float64 or not x.is_contiguous():
                raise ValueError(
                    f"{name} has shape {tuple(x.shape)}, strides {x.stride()}, {x.dtype}: expected "
                    f"contiguous torch.float64 of shape {shape}"
                )
        return self._run(values)[0]


def export_law(
    controller: Controller,
    path: str | Path,
    *,
    actuator: Actuator | None = None,
    period: float | None = None,
    real: Real = "double",
    about: Mapping[str, Any] | None = None,
    ranges: Ranges | None = None,
) -> Path:
    """Write a law to a file for other programs, see docs/realtime.md.

    - ``.c`` (with ``.h``), ``.onnx`` and ``.casadi``: the :class:`~.safe_law.SafeLaw`, which is
      the law with its observer, its guard and the limits of the input, and explicit memory.
    - ``.pt2``: the law alone, by AOTInductor, for PyTorch without this package.

    Args:
        controller: a law of a model in float64 on the CPU, also with an observer or a guard.
        path: the file.
        actuator: limits of the input.
        period: time between two calls, s; limits of the rate and observers need it.
        real: type of the numbers of a ``.c`` or ``.onnx`` file.
        about: fields for the information in the file, such as names of coordinates.
        ranges: smallest and largest q, v and a of the states of the comparison, by name.

    Raises:
        ValueError: on another ending, or a missing period.
        TypeError: on a controller that is not a law of a model, or an operation that the format
            does not have.
        RuntimeError: if the file cannot be compiled or loaded, or does not repeat the law to 1e-9
            (``.pt2``: 1e-5, float: 1e-4).
    """
    path = Path(path).expanduser()
    if path.suffix == ".pt2":
        return _export_package(controller, path, limited=actuator not in (None, Actuator()))
    if path.suffix not in ENDINGS:
        endings = ", ".join([*ENDINGS, ".pt2"])
        raise ValueError(f"{path} ends in {path.suffix!r}, expected one of {endings}")
    safe = SafeLaw(controller, actuator, period)
    n = safe.law.num_coordinates
    inputs = drawn_states({**dict.fromkeys(INPUTS, n), "memory_in": safe.memory_size}, ranges)
    begin = safe.stored_inputs
    inputs["memory_in"][:, begin : begin + 1].round_()  # of an observer: called before or not
    info = {
        "law": type(safe.law).__name__,
        "observer": safe.observer and {"bandwidth": safe.observer.bandwidth},
        "guard": safe.guard
        and {key: getattr(safe.guard, key) for key in ("threshold", "fallback")},
        "limits": {key: getattr(safe.actuator, key) for key in ("low", "high", "rate")},
        "period": period,
        "reference_ahead": safe.compensation.ahead if safe.compensation else 0.0,
        "num_coordinates": n,
        "num_inputs": safe.law.num_inputs,
        "memory_size": safe.memory_size,
        **{key: getattr(safe.law, key).tolist() for key in ("position_gain", "velocity_gain")},
        **(about or {}),
    }
    text = (
        "Input u of the law. Returns the sum of 1 (limited), 2 (outside the training data) and 4 "
        "(not finite: the last input). Zero memory_in before the first call, then memory_out."
    )
    if safe.compensation:
        text += f" q_ref, v_ref and a_ref are the reference {safe.compensation.ahead:g} s ahead."
    law = ExportedFunction("control", safe, inputs, ("u", "status", "memory_out"), text)
    return write([law], path, info, real)


def _export_package(controller: Controller, path: Path, limited: bool) -> Path:
    """Compile u = law(q, v, q_ref, v_ref, a_ref) for one state and write it to a ``.pt2`` file.

    The file holds machine code of torch.export and AOTInductor for the processor and PyTorch
    version of the export, and runs on one thread. ``<path>.sha256`` holds its checksum.
    """
    if limited or isinstance(controller, Guarded):
        log.warning("%s holds no limits and no guard of the input: use .c or .onnx", path.name)
    controller = controller.law if isinstance(controller, Guarded) else controller
    if not isinstance(controller, ModelBasedLaw) or not controller.model.input_affine:
        raise TypeError(f"{type(controller).__name__} has a memory: export it to .c or .onnx")
    generator = torch.Generator().manual_seed(0)
    shape = (_CHECKS, len(INPUTS), controller.num_coordinates)
    states = 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1
    path.parent.mkdir(parents=True, exist_ok=True)
    # Written beside its place and then moved: a kill leaves the previous law, or none.
    partial = path.with_name(f"{path.stem}.partial.pt2")
    with torch.no_grad():
        info = {
            "law": type(controller).__name__,
            "num_coordinates": controller.num_coordinates,
            "num_inputs": controller.num_inputs,
            "position_gain": controller.position_gain.tolist(),
            "velocity_gain": controller.velocity_gain.tolist(),
            "torch": torch.__version__,
            "check": {
                "states": states.tolist(),
                "u": [controller.law(*state).tolist() for state in states],
            },
        }
        settings = {"cpp.threads": 1, "aot_inductor.metadata": {_KEY: json.dumps(info)}}
        try:
            torch._inductor.aoti_compile_and_package(
                torch.export.export(_LawModule(controller), tuple(states[0])),
                package_path=str(partial),
                inductor_configs=settings,
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

    Loading runs the machine code of the file: load only files from people you trust, and give the
    checksum of the export.

    Args:
        path: the ``.pt2`` file.
        sha256: the 64 hexadecimal digits of ``<path>.sha256``, compared before loading.

    Raises:
        ValueError: if the file has another checksum.
        RuntimeError: if the law misses the values of the export by more than 1e-5 of their norm.
    """
    path = Path(path)
    if sha256 is not None and (digest := _digest(path)) != sha256.strip().lower():
        raise ValueError(f"{path} has the SHA-256 {digest}, expected {sha256}: do not load it")
    loader = torch._inductor.aoti_load_package(str(path), run_single_threaded=True).loader
    law = CompiledLaw(loader.run, json.loads(loader.get_metadata()[_KEY]))
    states, expected = (
        torch.tensor(law.info["check"][name], dtype=torch.float64) for name in ("states", "u")
    )
    u = torch.stack([law(*state) for state in states])
    error = ((u - expected).norm(dim=-1) / expected.norm(dim=-1)).max()
    if not error <= TOLERANCE:
        raise RuntimeError(
            f"{path} misses the law it was exported from by {float(error):.1e}: export it "
            "on the machine that runs it, and check the condition numbers of M(q) and A(q)"
        )
    return law


class _LawModule(nn.Module):
    def __init__(self, controller: ModelBasedLaw):
        super().__init__()
        self.law = controller.law
        # Registered, so that the model's weights become constants of the compiled file.
        self.model = controller.model

    def forward(self, *state: Tensor) -> Tensor:
        return self.law(*state)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
