"""Rollouts as a loop in C. Models that differ only in their numbers share the compiled code."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import pickle
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from weakref import WeakKeyDictionary

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.exports.c_code import PRELUDE, ConstantArrays
from pinn_dyn.exports.c_file import find_compiler
from pinn_dyn.exports.c_lanes import LOOP, ONE, SEVERAL
from pinn_dyn.exports.c_library import QUICK, compiled_rows, load_code, recall, remember
from pinn_dyn.exports.program import Program, calling_part, trace
from pinn_dyn.exports.scalar_code import c_function
from pinn_dyn.mechanics.compilation import Wrapped
from pinn_dyn.mechanics.integrators import Dynamics, Integrator
from pinn_dyn.mechanics.predictor import ContinuousPredictor
from pinn_dyn.mechanics.signal import Signal

log = logging.getLogger(__name__)

STEPS = 1500
"""Number of steps in Python after which a loop is built. A step of a trajectory takes 4 to 15 ms,
and building a loop up to 12 s (benchmarks/long_rollout.py)."""
TRAJECTORIES = 100
"""Number of trajectories with which a step in Python takes twice as long as with one."""
BUILD_SECONDS = 1.0
"""Time that functions of rows must take in Python, s, for code in C before :data:`STEPS` calls."""
NUMBERS = 2**21
"""Number of inputs that are computed at once, to limit the memory of large batches."""
SEVERAL_FROM = 4
"""Number of trajectories from which they are computed side by side in vectors."""


class CLoop(Wrapped):
    """Integrator that runs long paths as a loop in C, in float64 and without gradients.

    The states are those of the inner integrator up to rounding. The loop is compiled once for each
    kind of model and kept in the cache folder, where later processes find it. Until a model has
    taken :data:`STEPS` steps without a loop, the inner integrator computes its paths, and also
    where there is no C compiler or no C code for an operation of the model.

    Args:
        inner: the method.
        members: number of leading dimensions of the state for members: 1 for an ensemble, or 0.
        threads: number of threads that share the trajectories.
    """

    def __init__(self, inner: Integrator, members: int = 0, threads: PositiveInt = 1):
        super().__init__(inner)
        self.members, self.threads = members, threads

    def ready(self, dynamics: ContinuousPredictor, x: Tensor, h: float) -> Loop | None:
        """Return the loop for paths from states x ``(B, S)`` with steps of h s, if there is one.

        It stays the loop of the present numbers of the model.
        """
        u = x.new_zeros(len(self.nodes), 1, dynamics.num_inputs)
        return loop_of(dynamics, self, x, u, x.new_tensor([0.0, h]))

    def path(self, dynamics: Dynamics, start: Tensor, grid: Tensor, signal: Signal) -> Tensor:
        if not start.numel():
            return self.inner.path(dynamics, start, grid, signal)
        leading, batch = start.shape[: self.members], start.shape[self.members : -1]
        x = start.reshape(*leading, -1, start.shape[-1]).movedim(self.members, 0).contiguous()
        u = signal.u[..., 0, :].reshape(*leading, len(x), -1)[..., :1, :].movedim(-2, 0)
        u = u.expand(len(self.nodes), *u.shape).contiguous()
        fits = start.dtype == torch.float64 and start.is_cpu and not torch.is_grad_enabled()
        loop = loop_of(cast(nn.Module, dynamics), self, x, u, grid) if fits else None
        if loop is None:
            return self.inner.path(dynamics, start, grid, signal)
        blocks = [torch.zeros_like(x)[:, None]]
        steps = max(1, NUMBERS // max(1, u.numel() * len(x)))
        for inputs, lengths in self.blocks(grid, signal, steps):
            rows = inputs.reshape(*inputs.shape[: 2 + self.members], len(x), -1)
            rows = rows.movedim(2 + self.members, 0)
            blocks.append(loop(blocks[-1][:, -1], x, rows, lengths, self.threads))
        path = torch.cat(blocks, dim=1).movedim(0, 1 + self.members)
        return path.reshape(-1, *leading, *batch, start.shape[-1])


class Loop:
    """Compiled loop of a model over the steps of one trajectory after another.

    Args:
        code: the code in C, which may be compiled already.
        values: numbers of the model, the first argument of the code.
    """

    def __init__(self, code: str, values: Tensor):
        self._library, self._values = load_code(code, QUICK), values
        pointer, size = ctypes.c_void_p, ctypes.c_long
        self._library.roll_out.argtypes = [pointer, size, size, *[pointer] * 4]
        self._lanes: int = self._library.number_of_lanes()

    def _values_of(self, part: slice) -> Tensor:
        """Return the numbers of a part of the trajectories, which starts with a vector of them."""
        return self._values

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
        rows = start, inputs.contiguous(), path
        lengths = lengths.contiguous()

        def roll_out(part: slice, rows: Sequence[Tensor]) -> None:
            x, u, out = (y.data_ptr() for y in rows)
            sizes, values = (rows[0].shape[0], steps), self._values_of(part)
            self._library.roll_out(values.data_ptr(), *sizes, x, u, lengths.data_ptr(), out)

        size = -(-count // (threads * self._lanes)) * self._lanes
        if size >= count:
            roll_out(slice(0, count), rows)
        else:  # the calls release the interpreter
            parts = [slice(k, k + size) for k in range(0, count, size)]
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(roll_out, parts, ([x[part] for x in rows] for part in parts)))
        return path[:, 1:]


def traced(dynamics: Any, x: Tensor, inputs: Tensor, h: Tensor) -> dict[str, Program]:
    """Return the programs of a step of a model, and of the part that it calls."""
    step = {"increment": torch.zeros_like(x), "start": x, "inputs": inputs, "h": h}
    end = functools.partial(trace, dynamics.integration_step, step, ["end"], lines=False)
    if x.ndim > 1 or not isinstance(dynamics, ContinuousPredictor):  # an ensemble, or no stages
        return {"integration_step": end()}
    with calling_part(dynamics, x, inputs[0]) as part:
        return {"part": part, "integration_step": end()}


def loop_code(
    programs: dict[str, Program], several: bool, numbers: Numbers | None = None
) -> tuple[str, Tensor]:
    """Return the code of the loop of a model, and the numbers of the model.

    ``several`` is true for trajectories side by side. ``numbers`` may be those of each trajectory.
    """
    numbers = numbers or Numbers("double")
    functions = []
    numbers.block = (8, 2) if several else numbers.block
    for name, program in programs.items():
        parameters = ["values", *program.inputs, *program.outputs]
        kinds = {"values": "double *", "h": "double "}
        text = ", ".join(f"{kinds.get(x, 'real *restrict ')}{x}" for x in parameters)
        lines = c_function(program, numbers).lines
        functions += [f"static void {name}({text})", "{", *lines, "}"]
    values = torch.cat([*numbers.values, numbers.padding()], dim=-1)
    shapes = programs["integration_step"].inputs
    sizes = {"size": shapes["start"].numel(), "stages": shapes["inputs"].numel()}
    loop = LOOP.format(values=numbers.address.format(values.shape[-1]), **sizes)
    parts = [SEVERAL] if several else [ONE, PRELUDE]
    parts += [f"#define VALUES {numbers.read}", *numbers.definitions(), *functions, loop]
    return "\n".join(parts), values


class Numbers(ConstantArrays):
    """Constants that are arguments of the code.

    Attributes:
        read: expression of the array of numbers.
        address: expression of its start for trajectory b, with a field for its length.
    """

    arguments = ("values",)
    read, address = "values", "values"

    def __init__(self, real: str):
        super().__init__(real)
        self.values: list[Tensor] = []
        self._starts: dict[str, int] = {}

    def name(self, values: Tensor) -> str:
        name = super().name(values)
        if values.dtype.is_floating_point and name not in self._starts:
            self._starts[name] = sum(map(len, self.values))
            self.values.append(values.flatten())
        return name

    def elements(self, values: Tensor) -> list[float | str]:
        if not values.dtype.is_floating_point:
            return super().elements(values)
        start = self._starts[self.name(values)]
        # Zeros and ones follow from the structure. Other numbers may be learned.
        return [
            x if abs(x) in (0, 1) else f"VALUES[{start + k}]" for k, x in enumerate(values.tolist())
        ]

    def padding(self) -> Tensor:
        """Return a number more, since an array may not be empty."""
        return torch.zeros(1, dtype=torch.float64)

    def spread(self, text: str) -> str:
        return f"lanes({text})"

    def _definition(self, kind: str, name: str, values: Tensor) -> str:
        if kind == "int":
            return super()._definition(kind, name, values)
        return f"#define {name} (VALUES + {self._starts[name]})"


class _Content(pickle.Pickler):
    """Pickler that writes tensors as their numbers, sets in order, and classes with their files."""

    def persistent_id(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            array = value.detach().numpy()
            return str(array.dtype), array.shape, array.tobytes()
        if isinstance(value, type):
            return _origin(value)
        return sorted(map(str, value)) if isinstance(value, set) else None


@functools.cache
def _origin(kind: type) -> str:
    """Return the names of a class and its bases, and the size and time of their files.

    Raises:
        TypeError: for a class without a file, as in a notebook, whose changes nothing tells.
    """
    parts = [kind.__qualname__]
    for module in dict.fromkeys(base.__module__ for base in kind.__mro__):
        file = getattr(sys.modules.get(module), "__file__", None)
        if file is None and module not in sys.builtin_module_names:
            raise TypeError(f"{kind} has no file")
        own = module.startswith("pinn_dyn.")
        parts.append(f"{module} {_package() if own else _state(file)}")
    return "; ".join(parts)


@functools.cache
def _package() -> str:
    """Return the sizes and times of the files of this package."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    return hashlib.sha256("".join(map(_state, files)).encode()).hexdigest()


def _state(file: str | Path | None) -> str:
    """Return the size and the time of change of a file; "" of a module that is built in."""
    if file is None:
        return ""
    status = Path(file).stat()
    return f"{status.st_size} {status.st_mtime_ns};"


_LOOPS: dict[str, Loop | None] = {}
"""Loops of this process by the content of their models; None for a model without a loop."""
_PROGRAMS: dict[str, dict[str, Program]] = {}
"""Traced models of this process, for loops over one and over several trajectories."""
_ROWS: dict[str, Callable[[Tensor], Tensor]] = {}
"""Functions of rows of this process."""
_WITHOUT: Counter[str] = Counter()
"""Steps that were taken without a loop."""
_KEYS: WeakKeyDictionary[nn.Module | CLoop, tuple[list[Any], str]] = WeakKeyDictionary()
_MOST_LOOPS = 64
_EXPECTED = SimpleNamespace(count=0)
"""Number of calls of each function of rows that will follow, 0 if unknown."""


def loop_of(
    dynamics: nn.Module,
    integrator: CLoop | None,
    x: Tensor,
    u: Tensor,
    grid: Tensor,
    *,
    share: float = 1.0,
) -> Loop | None:
    """Return the loop of a model, or None where it does not pay off yet or is not possible.

    Args:
        dynamics: the model, with an ``integration_step``.
        integrator: its integrator, if any.
        x, u: states ``(B, S)`` and inputs of the first step ``(stages, B, M)``.
        grid: times of the path.
        share: time of a step in Python, in that of a step of a mechanical system.
    """
    try:
        model = _key_of(dynamics, integrator)
    except Exception:  # from a class that cannot be pickled, or without a file
        log.debug("no loop in C for %s", type(dynamics).__name__, exc_info=True)
        return None
    several = len(x) >= SEVERAL_FROM
    key = f"{model}{'s' * several}"
    if key not in _LOOPS:
        steps = (len(grid) - 1) * (1 + len(x) // TRAJECTORIES)
        is_new, _WITHOUT[key] = key not in _WITHOUT, _WITHOUT[key] + steps
        known = recall(key) if is_new else None
        if (known is None and share * _WITHOUT[key] < STEPS) or find_compiler() is None:
            return None
        if len(_LOOPS) >= _MOST_LOOPS:
            _LOOPS.clear()
            _PROGRAMS.clear()
        _LOOPS[key] = None
        try:
            example = x[0], u[:, 0], grid[1] - grid[0]
            loop = None if known is None else _checked(*known, dynamics, *example)
            if loop is None:
                _PROGRAMS[model] = _PROGRAMS.get(model) or traced(dynamics, *example)
                new = loop_code(_PROGRAMS[model], several)
                loop = _checked(*new, dynamics, *example)
                if loop is not None:
                    remember(key, *new)
            _LOOPS[key] = loop
        except Exception:  # from a head that cannot be traced, a compiler or a full disk
            log.debug("no loop in C for %s", type(dynamics).__name__, exc_info=True)
    return _LOOPS[key]


@contextmanager
def expected_calls(count: int) -> Iterator[None]:
    """Tell :func:`rows_in_c` within a context how many calls of each function will follow."""
    before = _EXPECTED.count
    _EXPECTED.count = count
    try:
        yield
    finally:
        _EXPECTED.count = before


def rows_in_c(
    model: nn.Module,
    name: str,
    function: Callable[[Tensor], Tensor],
    rows: Tensor,
    calls: PositiveInt = 1,
) -> Callable[[Tensor], Tensor]:
    """Return a function of a model for rows, in C if that pays off, see :func:`compiled_rows`.

    Args:
        model: the model of the function.
        name: name of the function, also of the settings that are not in the model.
        function: takes ``(*batch, n)`` and returns ``(*batch, m)``, rows independently.
        rows: the next argument of the function, ``(*batch, n)``.
        calls: number of calls until this question is asked again.
    """
    if not rows.numel() or rows.dtype != torch.float64 or not rows.is_cpu:
        return function
    try:
        key = f"{_key_of(model)}{name}"
    except Exception:  # from a class that cannot be pickled, or without a file
        log.debug("no code in C for %s", type(model).__name__, exc_info=True)
        return function
    if key not in _ROWS:
        is_new, count = key not in _WITHOUT, rows.shape[:-1].numel()
        _WITHOUT[key] += calls * (1 + count // TRAJECTORIES)
        is_worth = _WITHOUT[key] >= STEPS
        if is_new and not is_worth and _EXPECTED.count:
            function(rows)  # the first call may import and build
            start = time.thread_time()
            function(rows)
            seconds = (time.thread_time() - start) * calls * _EXPECTED.count
            is_worth = seconds > BUILD_SECONDS
        is_worth = is_worth or (is_new and recall(key) is not None)
        if not is_worth or find_compiler() is None:
            return function
        if len(_ROWS) >= _MOST_LOOPS:
            _ROWS.clear()
        _ROWS[key] = compiled_rows(function, rows.reshape(-1, rows.shape[-1])[0], key)
    return _ROWS[key]


def versions_of(module: nn.Module) -> list[tuple[int, int]]:
    """Return the address and the version of each tensor of a module."""
    versions, modules = [], [module]
    for inner in modules:  # grows meanwhile; module.state_dict() takes ten times as long
        if inner._modules:
            modules += [x for x in inner._modules.values() if x is not None]
        for table in (inner._parameters, inner._buffers):
            if table:
                versions += [(x.data_ptr(), x._version) for x in table.values() if x is not None]
    return versions


def _key_of(model: nn.Module, integrator: CLoop | None = None) -> str:
    """Return a digest of all that a path or a function depends on, anew for a changed tensor."""
    owner, versions = integrator or model, [id(model), *versions_of(model)]
    known, key = _KEYS.get(owner, (None, ""))
    if known != versions:
        content = BytesIO()
        _Content(content).dump((model, integrator and integrator.inner))
        key = hashlib.sha256(content.getvalue()).hexdigest()
        _KEYS[owner] = versions, key
    return key


def _checked(
    code: str, values: Tensor, dynamics: Any, x: Tensor, u: Tensor, h: Tensor
) -> Loop | None:
    """Return a loop if its first step is that of the model."""
    zero, loop = torch.zeros_like(x), Loop(code, values)
    expected = dynamics.integration_step(zero, x, u, h)
    step = loop(zero[None], x[None], u[None, None], h[None])[0, 0]
    is_equal = torch.allclose(step, expected, rtol=1e-9, atol=1e-12, equal_nan=True)
    return loop if is_equal else None
