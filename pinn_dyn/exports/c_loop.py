"""Rollouts as a loop in C. Models with different numbers share the compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.exports.c_code import PRELUDE
from pinn_dyn.exports.c_file import static_functions
from pinn_dyn.exports.compiled import STATES, Compiled, Function, Kind, agree, spread_around
from pinn_dyn.exports.live_numbers import LiveNumbers
from pinn_dyn.exports.program import Program
from pinn_dyn.exports.repeated import programs, sharing
from pinn_dyn.exports.scalar_code import c_functions
from pinn_dyn.mechanics.integrators import Dynamics, Integrator, Wrapped
from pinn_dyn.mechanics.predictor import ContinuousPredictor
from pinn_dyn.mechanics.signal import Signal

NUMBERS = 2**21
"""Number of inputs that are computed at once, to limit the memory of large batches."""
SEVERAL_FROM = 4
"""Number of trajectories from which several trajectories are computed at once, in vectors."""
_STEP = "integration_step"  # name of the function in the code


class CLoop(Wrapped):
    """Integrator that computes paths by a loop in C, in float64 and without gradients.

    The states are those of the inner integrator up to rounding. The inner integrator computes a
    path if there is no loop in C, see :class:`~.compiled.Compiled`.

    Args:
        inner: the method.
        threads: number of threads that share the trajectories.
    """

    def __init__(self, inner: Integrator, threads: PositiveInt = 1):
        super().__init__(inner)
        self.threads = threads
        self._compiled: Compiled | None = None

    def ready(self, dynamics: ContinuousPredictor, x: Tensor, h: float) -> Function | None:
        """Return the loop for paths from states x ``(B, S)`` with steps of h s, or None.

        The loop always uses the current numbers of the model.
        """
        u = x.new_zeros(len(x), 1, len(self.nodes), dynamics.num_inputs)
        steps = Steps(dynamics, x, u, x.new_tensor([h]))
        self._compiled = self._compiled or Compiled(dynamics)
        return self._compiled.find(steps)

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        fits = start.dtype == torch.float64 and start.is_cpu and not torch.is_grad_enabled()
        if not start.numel() or not fits:
            return self.inner.path(dynamics, start, grid, signal)
        x = start.reshape(-1, start.shape[-1]).contiguous()

        def rows(inputs: Tensor) -> Tensor:
            return inputs.reshape(*inputs.shape[:2], len(x), -1).movedim(2, 0)

        u, lengths = next(self.blocks(grid, signal, STATES))
        steps = Steps(cast(nn.Module, dynamics), x, rows(u), lengths)
        code = self._compiled = self._compiled or Compiled(dynamics)
        loop = code.find(steps)
        if loop is None:
            with code.in_python(steps):
                return self.inner.path(dynamics, start, grid, signal)
        blocks = [torch.zeros_like(x)[:, None]]
        size = max(1, NUMBERS // max(1, u[0].numel()))
        for inputs, lengths in self.blocks(grid, signal, size):
            blocks.append(loop(blocks[-1][:, -1], x, rows(inputs), lengths, self.threads))
        return torch.cat(blocks, dim=1).movedim(0, 1).reshape(-1, *start.shape)


class Loop:
    """Compiled loop of a model over trajectories and their steps.

    Args:
        library: the compiled code.
        values: numbers of the model, the first argument of the code.
    """

    def __init__(self, library: ctypes.CDLL, values: Tensor):
        self._library, self._values = library, values
        pointer, size = ctypes.c_void_p, ctypes.c_long
        self._library.roll_out.argtypes = [pointer, size, size, *[pointer] * 4]
        self._lanes: int = self._library.number_of_lanes()

    def __call__(
        self,
        increment: Tensor,
        start: Tensor,
        inputs: Tensor,
        lengths: Tensor,
        threads: int = 1,
    ) -> Tensor:
        """Return the increments after the steps, ``(B, T, ...)``, of B trajectories."""
        count, steps = start.shape[0], lengths.shape[0]  # several times faster than len(x)
        path = start.new_empty(count, steps + 1, *start.shape[1:])
        path[:, 0] = increment
        rows = start.contiguous(), inputs.contiguous(), path
        lengths = lengths.contiguous()

        def roll_out(rows: Sequence[Tensor]) -> None:
            x, u, out = (y.data_ptr() for y in rows)
            sizes, values = (rows[0].shape[0], steps), self._values.data_ptr()
            self._library.roll_out(values, *sizes, x, u, lengths.data_ptr(), out)

        size = -(-count // (threads * self._lanes)) * self._lanes
        if size >= count:
            roll_out(rows)
        else:  # calls of the library release the interpreter, so threads run in parallel
            parts = [slice(k, k + size) for k in range(0, count, size)]
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(roll_out, ([x[part] for x in rows] for part in parts)))
        return path[:, 1:]


class Steps(Kind):
    """Steps of a path.

    Args:
        dynamics: the model.
        x: states at the start, ``(B, S)``.
        u: inputs of the first steps, ``(B, T, stages, M)``.
        lengths: lengths of the first steps, ``(T,)``, s.
    """

    def __init__(self, dynamics: Any, x: Tensor, u: Tensor, lengths: Tensor):
        self._dynamics, self._x, self._u, self._lengths = dynamics, x, u, lengths
        self._several = len(x) >= SEVERAL_FROM
        self.name = "paths" if self._several else "path"

    def programs(self) -> dict[str, Program]:
        x, dynamics = self._x[0], self._dynamics
        step = {"increment": torch.zeros_like(x), "start": x}
        step |= {"inputs": self._u[0, 0], "h": self._lengths[0]}
        if isinstance(dynamics, ContinuousPredictor):  # its steps have stages
            dynamics = sharing(dynamics)
        return programs(_STEP, dynamics.integration_step, step, ["end"])

    def text(self, programs: dict[str, Program], numbers: LiveNumbers) -> str:
        numbers.block = (8, 2) if self._several else numbers.block
        functions = static_functions(c_functions(programs, numbers), ["double *values"])
        shapes = programs[_STEP].inputs
        sizes = {"size": shapes["start"].numel(), "stages": shapes["inputs"].numel()}
        parts = [SEVERAL] if self._several else [ONE, PRELUDE]
        parts += ["#define VALUES values", *numbers.definitions(), *functions, LOOP.format(**sizes)]
        return "\n".join(parts)

    def loaded(self, library: ctypes.CDLL, values: Tensor) -> Function:
        return Loop(library, values)

    def agrees(self, function: Function) -> bool:
        """Compare steps at states and inputs on and near a path."""
        example, h = (self._x[0], self._u[0, 0]), self._lengths.mean()
        path = function(torch.zeros_like(self._x), self._x, self._u, self._lengths)
        states = torch.cat([self._x[:, None], self._x[:, None] + path[:, :-1]], dim=1)
        rows = torch.cat([states, self._u.flatten(2)], dim=-1).flatten(0, 1)
        rows = spread_around(rows[rows.isfinite().all(-1)])
        x, u = rows.split([value.numel() for value in example], dim=-1)
        x, u = x.reshape(STATES, *example[0].shape), u.reshape(STATES, *example[1].shape)
        steps = function(torch.zeros_like(x), x, u[:, None], h[None])[:, 0]
        expected = self._dynamics.integration_step(torch.zeros_like(x), x, u.movedim(0, 1), h)
        return agree(steps, expected)


ONE = """\
#include <string.h>
#define LANES 1
#define lanes(x) (x)
typedef double real;
"""
"""First lines of the code for a single trajectory at a time."""

SEVERAL = """\
#include <math.h>
#include <string.h>

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double real __attribute__((vector_size(8 * LANES)));
typedef long long flag __attribute__((vector_size(8 * LANES)));

#define LANEWISE(f) static inline real lanes_##f(real x) { \\
  double y[LANES]; memcpy(y, &x, sizeof x); \\
  for (int l = 0; l < LANES; l++) y[l] = f(y[l]); \\
  memcpy(&x, y, sizeof x); return x; }
#define PAIRWISE(f) static inline real lanes_##f(real x, real z) { \\
  double y[LANES], w[LANES]; memcpy(y, &x, sizeof x); memcpy(w, &z, sizeof z); \\
  for (int l = 0; l < LANES; l++) y[l] = f(y[l], w[l]); \\
  memcpy(&x, y, sizeof x); return x; }
@functions@

#define lanes(x) ((x) - (real){0})
static inline real chosen(flag mask, real a, real b)
{ return (real)((mask & (flag)a) | (~mask & (flag)b)); }
#define choose(mask, a, b) chosen((mask) != (flag){0}, lanes(a), lanes(b))
static inline real square(real x) { return x * x; }
static inline real larger(real a, real b) { return choose((a > b) | (a != a), a, b); }
static inline real smaller(real a, real b) { return choose((a < b) | (a != a), a, b); }
static inline real sign(real x) { return choose(x > 0, 1.0, 0.0) - choose(x < 0, 1.0, 0.0); }
#define square(x) square(lanes(x))
#define larger(a, b) larger(lanes(a), lanes(b))
#define smaller(a, b) smaller(lanes(a), lanes(b))
#define sign(x) sign(lanes(x))
"""
_OF_ONE = "sqrt exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh erf floor fabs"
_OF_TWO = "atan2 pow fmod"
_functions = [f"LANEWISE({f})\n#define {f}(x) lanes_{f}(lanes(x))" for f in _OF_ONE.split()]
_functions += [
    f"PAIRWISE({f})\n#define {f}(x, y) lanes_{f}(lanes(x), lanes(y))" for f in _OF_TWO.split()
]
SEVERAL = SEVERAL.replace("@functions@", "\n".join(_functions))
"""First lines of the code for several trajectories at a time, as many as fit into a vector."""

LOOP = """
#define LANE(x, l) (((double *)&(x))[l])

static void pack(real *to, const double *from, long stride, long size, long count)
{{
  for (long i = 0; i < size; i++)
    for (int l = 0; l < LANES; l++)
      LANE(to[i], l) = from[(l < count ? l : 0) * stride + i];
}}

static void unpack(double *to, const real *from, long stride, long size, long count)
{{
  for (int l = 0; l < LANES && l < count; l++)
    for (long i = 0; i < size; i++)
      to[l * stride + i] = LANE(from[i], l);
}}

int number_of_lanes(void) {{ return LANES; }}

/* The increments of path (count, steps + 1, {size}) after the first. */
void roll_out(double *values, long count, long steps, const double *start, const double *inputs,
              const double *lengths, double *path)
{{
  const long width = (steps + 1) * {size}, length = steps * {stages};
  for (long b = 0; b < count; b += LANES) {{
    real x[{size}], u[{stages} + 1], increment[{size}], next[{size}];
    double *now = path + b * width;
    pack(x, start + b * {size}, {size}, {size}, count - b);
    pack(increment, now, width, {size}, count - b);
    for (long k = 0; k < steps; k++) {{
      pack(u, inputs + b * length + k * {stages}, length, {stages}, count - b);
      integration_step(values, increment, x, u, lengths[k], next);
      memcpy(increment, next, sizeof next);
      now += {size};
      unpack(now, increment, width, {size}, count - b);
    }}
  }}
}}
"""
