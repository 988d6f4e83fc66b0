"""Rollouts as a loop in C. Models that differ only in their numbers share the compiled code."""

from __future__ import annotations

import ctypes
import logging
import pickle
from io import BytesIO
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.exports.c_code import PRELUDE, CFunction, Constants
from pinn_dyn.exports.c_file import find_compiler
from pinn_dyn.exports.c_library import QUICK, load_code
from pinn_dyn.exports.program import trace
from pinn_dyn.mechanics.compilation import Wrapped
from pinn_dyn.mechanics.integrators import Dynamics, Integrator
from pinn_dyn.mechanics.signal import Signal

log = logging.getLogger(__name__)

STEPS = 3000
"""Number of steps from which a loop pays off at its first use. A step in Python takes 4 to 10 ms.
Building a loop takes up to 12 s, and 1 to 4 s from the cache folder (benchmarks/long_rollout.py).
"""
NUMBERS = 2**21
"""Number of inputs that are computed at once, to limit the memory of large batches."""
_LOOP = """
void roll_out(real *values, long count, long steps, real *start, real *inputs, real *lengths,
              real *path)
{{
  for (long b = 0; b < count; b++, start += {size}, path += {size})
    for (long k = 0; k < steps; k++, path += {size}, inputs += {stages})
      integration_step(values, path, start, inputs, lengths[k], path + {size});
}}
"""


class CLoop(Wrapped):
    """Integrator that runs long paths as a loop in C, in float64 and without gradients.

    The states are those of the inner integrator up to rounding. The loop is compiled once for each
    kind of model and kept in the cache folder. The inner integrator computes short paths, and all
    paths where there is no C compiler or no C code for an operation of the model.

    Args:
        inner: the method.
        members: number of leading dimensions of the state for members: 1 for an ensemble, or 0.
    """

    def __init__(self, inner: Integrator, members: int = 0):
        super().__init__(inner)
        self.members = members

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        if not start.numel():
            return self.inner.path(dynamics, start, grid, signal)
        leading, batch = start.shape[: self.members], start.shape[self.members : -1]
        x = start.reshape(*leading, -1, start.shape[-1]).movedim(self.members, 0).contiguous()
        u = signal.u[..., 0, :].reshape(*leading, len(x), -1)[..., 0, :]
        u = u.expand(len(self.nodes), *u.shape).contiguous()
        fits = start.dtype == torch.float64 and start.is_cpu and not torch.is_grad_enabled()
        loop = _loop_of(dynamics, self, x[0], u, grid) if fits else None
        if loop is None:
            return self.inner.path(dynamics, start, grid, signal)
        blocks = [torch.zeros_like(x)[:, None]]
        steps = max(1, NUMBERS // max(1, u.numel() * len(x)))
        for inputs, lengths in self.blocks(grid, signal, steps):
            rows = inputs.reshape(*inputs.shape[: 2 + self.members], len(x), -1)
            rows = rows.movedim(2 + self.members, 0)
            blocks.append(loop(blocks[-1][:, -1], x, rows, lengths))
        path = torch.cat(blocks, dim=1).movedim(0, 1 + self.members)
        return path.reshape(-1, *leading, *batch, start.shape[-1])


class _Loop:
    """Compiled loop of a model over the steps of one trajectory after another."""

    def __init__(self, dynamics: Any, x: Tensor, inputs: Tensor, h: Tensor):
        step = {"increment": torch.zeros_like(x), "start": x, "inputs": inputs, "h": h}
        programs, derivative = {}, dynamics.state_derivative
        if x.ndim == 1:
            rate = {"x": x, "input": inputs[0]}
            programs["state_derivative"] = trace(derivative, rate, ["rate"], lines=False)
            dynamics.state_derivative = lambda *values: _rate(*(y.contiguous() for y in values))
        try:
            function = dynamics.integration_step
            programs["integration_step"] = trace(function, step, ["end"], lines=False)
        finally:
            vars(dynamics).pop("state_derivative", None)
        constants, code = _Values("double"), []
        for name, program in programs.items():
            parameters = ["values", *program.inputs, *program.outputs]
            text = ", ".join("real h" if x == "h" else f"real *restrict {x}" for x in parameters)
            lines = CFunction(program, constants).lines
            code += [f"static void {name}({text})", "{", *lines, "}"]
        definitions = ["typedef double real;", PRELUDE, *constants.definitions()]
        loop = _LOOP.format(size=x.numel(), stages=inputs.numel())
        self._function = load_code("\n".join([*definitions, *code, loop]), QUICK).roll_out
        self._values = torch.cat([*constants.values, x.new_zeros(1)])

    def __call__(self, increment: Tensor, start: Tensor, inputs: Tensor, lengths: Tensor) -> Tensor:
        """Return the increments after the steps, ``(B, T, ...)``, of B trajectories."""
        path = start.new_empty(len(start), len(lengths) + 1, *start.shape[1:])
        path[:, 0] = increment
        arrays = [self._values, start, inputs.contiguous(), lengths.contiguous(), path]
        values, *pointers = [ctypes.c_void_p(array.data_ptr()) for array in arrays]
        self._function(values, ctypes.c_long(len(start)), ctypes.c_long(len(lengths)), *pointers)
        return path[:, 1:]


@torch.library.custom_op("pinn_dyn::state_derivative", mutates_args=())
def _rate(x: Tensor, u: Tensor) -> Tensor:
    """Stand for a call of the state derivative in a program."""
    return torch.empty_like(x)


class _Values(Constants):
    """Constants that are arguments of the code."""

    def definitions(self) -> list[str]:
        self.values: list[Tensor] = []
        return super().definitions()

    def _definition(self, kind: str, name: str, values: Tensor) -> str:
        if kind == "int":
            return super()._definition(kind, name, values)
        offset = sum(map(len, self.values))
        self.values.append(values)
        return f"#define {name} (values + {offset})"


class _Content(pickle.Pickler):
    """Pickler that writes a tensor as its type, shape and numbers."""

    def persistent_id(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            array = value.detach().numpy()
            return str(array.dtype), array.shape, array.tobytes()
        return None


_LOOPS: dict[bytes, _Loop | None] = {}
"""Loops of this process by the content of their models; None for a model without a loop."""
_MOST_LOOPS = 64


def _loop_of(
    dynamics: Dynamics, integrator: CLoop, x: Tensor, u: Tensor, grid: Tensor
) -> _Loop | None:
    """Return the loop of a model, or None where it does not pay off or is not possible."""
    try:
        content = BytesIO()
        _Content(content).dump((dynamics, integrator))
        key = content.getvalue()
        if key not in _LOOPS:
            if len(grid) <= STEPS or find_compiler() is None:
                return None
            if len(_LOOPS) >= _MOST_LOOPS:
                _LOOPS.clear()
            _LOOPS[key] = None
            _LOOPS[key] = _compared(dynamics, x, u, grid[1] - grid[0])
        return _LOOPS[key]
    except Exception:  # from a head that cannot be traced, a compiler or a full disk
        log.debug("no loop in C for %s", type(dynamics).__name__, exc_info=True)
        return None


def _compared(dynamics: Dynamics, x: Tensor, u: Tensor, h: Tensor) -> _Loop:
    """Return a loop whose first step is that of the model."""
    loop = _Loop(dynamics, x, u, h)
    zero = torch.zeros_like(x)
    step = loop(zero[None], x[None], u[None, None], h[None])[0, 0]
    expected = dynamics.integration_step(zero, x, u, h)
    torch.testing.assert_close(step, expected, rtol=1e-9, atol=1e-12, equal_nan=True)
    return loop
