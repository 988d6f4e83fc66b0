"""A model as code in C that uses the current numbers and attributes of the model."""

from __future__ import annotations

import abc
import ctypes
import hashlib
import logging
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pinn_dyn.exports.c_code import PRELUDE
from pinn_dyn.exports.c_file import find_compiler, static_functions
from pinn_dyn.exports.c_library import QUICK, load_code, recall, remember
from pinn_dyn.exports.exported_function import errors_of_rows
from pinn_dyn.exports.live_numbers import LiveNumbers
from pinn_dyn.exports.program import Constants, Program
from pinn_dyn.exports.repeated import programs
from pinn_dyn.exports.scalar_code import c_functions
from pinn_dyn.exports.watch import Watch

log = logging.getLogger(__name__)

BUILD_SECONDS = 1.0
"""Processor time in Python after which code is built, s; about the time of building."""
STATES = 20
"""Number of states at which code is compared with Python before it is used."""
_TOLERANCE = 1e-9

Function = Callable[..., Tensor]


class Code(NamedTuple):
    """Code of a kind of model, and the source of its numbers.

    Attributes:
        text: the code.
        constants: operations and results of the constants of each program, see :class:`Constants`.
        leaves: tensors that the constants of each program read: the index of a watched tensor, or a
            tensor that does not belong to a model.
        order: positions of the arguments of the code among all constants, ``(n,)``.
        places, numbers: positions of the constants that the code contains, and their values.
    """

    text: str
    constants: list[Any]
    leaves: list[list[int | Tensor]]
    order: Tensor
    places: Tensor
    numbers: Tensor

    def values(self, tensors: Sequence[Tensor]) -> Tensor | None:
        """Return the arguments of the code, or None if the code contains other numbers.

        Args:
            tensors: the watched tensors of the model.
        """
        values = []
        for packed, sources in zip(self.constants, self.leaves, strict=True):
            leaves = [x if isinstance(x, Tensor) else tensors[x] for x in sources]
            values.append(Constants(leaves, *packed).evaluate())
        constants = torch.cat(values)
        if not torch.equal(constants[self.places], self.numbers):
            return None
        return torch.cat([constants[self.order], constants.new_zeros(1)])  # never empty


class Kind(abc.ABC):
    """A function of a model that can run in C.

    Attributes:
        name: name of the function, including settings that are not part of the model.
        flags: flags of the compiler for the optimization.
    """

    name: str
    flags: Sequence[str] = QUICK

    @abc.abstractmethod
    def programs(self) -> dict[str, Program]:
        """Record the function as a program, after programs of the parts that it calls."""

    @abc.abstractmethod
    def text(self, programs: dict[str, Program], numbers: LiveNumbers) -> str:
        """Return the C code."""

    @abc.abstractmethod
    def loaded(self, library: ctypes.CDLL, values: Tensor) -> Function:
        """Return the function of a loaded library."""

    @abc.abstractmethod
    def agrees(self, function: Function) -> bool:
        """Return true if a function agrees with Python at many states and inputs."""


class Compiled:
    """Functions of a model in C, for the current numbers and attributes of the model.

    Numbers come from the tensors of the model. A change of a number or attribute is detected at the
    next call (:class:`Watch`). Code, also from the cache folder, is used only after it agrees with
    Python at :data:`STATES` states. If the folder has no code, it is built after Python has used
    :data:`BUILD_SECONDS`. Python computes the function if there is no C compiler or no C code for
    an operation, and while another thread builds the code.

    Args:
        roots: the model, and all other objects that the functions read.
    """

    is_unwatched = True

    def __init__(self, *roots: Any):
        self._roots = roots
        self._watch: Watch | None = None
        self._digest = ""
        self._functions: dict[str, Function] = {}
        self._lock = threading.Lock()

    def __deepcopy__(self, memo: Any) -> None:
        """Return None: the copy of a model has no code, since it is another model."""

    def __reduce__(self) -> Any:
        return type(None), ()

    def find(self, kind: Kind) -> Function | None:
        """Return a function in C, or None if Python must compute it."""
        watch = self._watch
        if watch is not None and not watch.changed():
            function = self._functions.get(kind.name)
            if function is not None:
                return function
        if not self._lock.acquire(blocking=False):
            return None
        try:
            return self._found(kind)
        finally:
            self._lock.release()

    def rows(self, name: str, function: Callable[[Tensor], Tensor], rows: Tensor) -> Tensor:
        """Evaluate a function of rows, in C if possible.

        Args:
            name: name of the function, unique among the functions of this object.
            function: function that maps ``(*batch, n)`` to ``(*batch, m)`` row by row. It must read
                only the roots.
            rows: argument of the function.
        """
        if not rows.numel() or rows.dtype != torch.float64 or not rows.is_cpu:
            return function(rows)
        kind = _Rows(name, function, rows)
        compiled = self.find(kind)
        if compiled is not None:
            return compiled(rows)
        with self.in_python(kind):
            return function(rows)

    @contextmanager
    def in_python(self, kind: Kind) -> Iterator[None]:
        """Count the processor time of a context in which Python computes a function."""
        start = time.thread_time()
        try:
            yield
        finally:
            _SECONDS[self._key(kind)] += time.thread_time() - start

    def _key(self, kind: Kind) -> str:
        return hashlib.sha256(f"{self._digest} {kind.name}".encode()).hexdigest()

    def _found(self, kind: Kind) -> Function | None:
        if self._watch is None or self._watch.changed():
            self._functions = {}
            self._watch = Watch(*self._roots)
            self._digest = self._watch.digest()
        key = self._key(kind)
        try:
            function = self._known(key, kind) or self._built(key, kind)
        except Exception:  # a head that cannot be traced, an error of the compiler, a full disk
            log.debug("no code in C for %s", kind.name, exc_info=True)
            _SECONDS[key] = -float("inf")
            return None
        if function is not None:
            self._functions = {**self._functions, kind.name: function}
        return function

    def _known(self, key: str, kind: Kind) -> Function | None:
        """Return the function from code in this process or in the cache folder, or None."""
        code = _CODES.get(key)
        if code is None and key not in _SECONDS:
            _SECONDS[key] = 0.0
            content = recall(key)
            code = None if content is None else Code(*content)
        return None if code is None else self._loaded(key, code, kind)

    def _built(self, key: str, kind: Kind) -> Function | None:
        if _SECONDS[key] < BUILD_SECONDS or find_compiler() is None:
            return None
        programs = kind.programs()
        code = self._code(programs, kind)
        function = self._loaded(key, code, kind)
        if function is None:
            _SECONDS[key] = -float("inf")
        else:
            remember(key, [*code])
        return function

    def _code(self, programs: dict[str, Program], kind: Kind) -> Code:
        constants = [program.constants for program in programs.values()]
        numbers = LiveNumbers([*programs.values()], torch.cat([x.evaluate() for x in constants]))
        text = kind.text(programs, numbers)
        assert self._watch is not None
        addresses = {_identity(x): k for k, x in enumerate(self._watch.tensors)}
        leaves = []
        for item in constants:
            leaves.append([addresses.get(_identity(x), x.detach().clone()) for x in item.leaves])
        return Code(
            text,
            [[item.operations, item.results] for item in constants],
            leaves,
            torch.tensor(numbers.index, dtype=torch.int64),
            torch.tensor([*numbers.fixed], dtype=torch.int64),
            torch.tensor([*numbers.fixed.values()], dtype=torch.float64),
        )

    def _loaded(self, key: str, code: Code, kind: Kind) -> Function | None:
        """Return the function of code with the current numbers, or None if Python disagrees."""
        assert self._watch is not None
        values = code.values(self._watch.tensors)
        if values is None:
            return None
        function = kind.loaded(load_code(code.text, kind.flags), values)
        if not kind.agrees(function):
            return None
        _CODES[key] = code
        return function


_CODES: dict[str, Code] = {}
"""Code in this process, by the digest of a kind of model."""
_SECONDS: defaultdict[str, float] = defaultdict(float)
"""Processor time of Python, by the digest of a kind of model; -inf if C is not possible."""


def _identity(value: Tensor) -> tuple[Any, ...]:
    return value.data_ptr(), value.shape, value.stride(), value.dtype


def agree(results: Tensor, expected: Tensor) -> bool:
    """Return true if results ``(K, ...)`` equal the expected results up to rounding."""
    errors, scales = errors_of_rows(results, expected)
    return bool((errors <= _TOLERANCE * scales + 1e-12).all())


def spread_around(rows: Tensor) -> Tensor:
    """Return :data:`STATES` rows: one half from ``rows`` ``(K, n)``, one half near them."""
    picked = rows[torch.linspace(0, len(rows) - 1, STATES // 2).round().long()]
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, *picked.shape, generator=generator, dtype=rows.dtype)
    spread = rows.std(0) if len(rows) > 1 else torch.zeros_like(rows[0])
    beside = picked * (1 + 0.3 * noise[0]) + (spread + 0.3) * noise[1]
    return torch.cat([picked, beside])


class _Rows(Kind):
    """A function that maps the rows of a tensor independently."""

    def __init__(self, name: str, function: Callable[[Tensor], Tensor], rows: Tensor):
        self.name, self._function = name, function
        self._rows = rows.reshape(-1, rows.shape[-1])

    def programs(self) -> dict[str, Program]:
        return programs("row", self._function, {"x": self._rows[0]}, ["y"])

    def text(self, programs: dict[str, Program], numbers: LiveNumbers) -> str:
        functions = static_functions(c_functions(programs, numbers), ["double *values"])
        return _ROWS.format(
            prelude=PRELUDE,
            definitions="\n".join(numbers.definitions()),
            functions="\n".join(functions),
            n=programs["row"].inputs["x"].numel(),
            m=programs["row"].outputs["y"].numel(),
        )

    def loaded(self, library: ctypes.CDLL, values: Tensor) -> Function:
        function, n, m = self._function, self._rows.shape[-1], library.outputs()
        pointer = ctypes.c_void_p
        library.rows.argtypes = [pointer, ctypes.c_long, pointer, pointer]

        def call(rows: Tensor) -> Tensor:
            if rows.shape[-1] != n or rows.dtype != torch.float64 or not rows.is_cpu:
                return function(rows)  # raises errors for wrong shapes
            rows = rows.contiguous()
            result = rows.new_empty(*rows.shape[:-1], m)
            library.rows(values.data_ptr(), rows.numel() // n, rows.data_ptr(), result.data_ptr())
            return result

        return call

    def agrees(self, function: Function) -> bool:
        rows = spread_around(self._rows[self._rows.isfinite().all(-1)])
        return agree(function(rows), self._function(rows))


_ROWS = """\
#define lanes(x) (x)
typedef double real;
{prelude}
#define VALUES values
{definitions}
{functions}
int outputs(void) {{ return {m}; }}
void rows(double *values, long count, const real *x, real *y)
{{ for (; count > 0; count--, x += {n}, y += {m}) row(values, x, y); }}
"""
