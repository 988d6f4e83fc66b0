"""C functions for programs, with loops over arrays of fixed size on the stack."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, fx

from pinn_dyn.exports.program import Program, operation, unsupported

PRELUDE = """\
#include <tgmath.h>

typedef int flag;
#define choose(mask, a, b) ((mask) ? (a) : (b))
static inline real square(real x) { return x * x; }
static inline real larger(real a, real b) { return a > b || a != a ? a : b; }
static inline real smaller(real a, real b) { return a < b || a != a ? a : b; }
static inline real sign(real x) { return (real)((x > 0) - (x < 0)); }
"""
"""Functions of the code, after a ``typedef`` of real. NaN passes, as in PyTorch."""

_FUNCTIONS = "sqrt exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh erf floor"
_OPERATORS = {"mul": "*", "div": "/", "add": "+", "sub": "-", "gt": ">", "ge": ">=", "lt": "<"}
_OPERATORS |= {"le": "<=", "eq": "==", "logical_and": "&", "logical_or": "|"}
ELEMENTWISE = {
    **{name: f"{name}({{0}})" for name in [*_FUNCTIONS.split(), "sign"]},
    **{name: f"{{0}} {sign} {{1}}" for name, sign in _OPERATORS.items()},
    **{name: f"{name}({{0}}, {{1}})" for name in ("atan2", "pow", "fmod")},
    "neg": "-{0}",
    "reciprocal": "1 / {0}",
    "abs": "fabs({0})",
    "logical_not": "{0} == 0",
    "clone": "{0}",
    "copy": "{1}",
    "_to_copy": "{0}",
    "maximum": "larger({0}, {1})",
    "minimum": "smaller({0}, {1})",
    "where": "choose({0}, {1}, {2})",
}
REDUCTIONS = {
    "sum": ("0", "{0} + {1}"),
    "amin": ("INFINITY", "smaller({0}, {1})"),
    "amax": ("-INFINITY", "larger({0}, {1})"),
}
Index = Sequence[str]


class ConstantArrays:
    """Constant arrays of a C file. Equal arrays are stored once.

    Args:
        real: type of the numbers, ``double`` or ``float``.

    Attributes:
        block: rows and columns of a matrix product that are summed at once.
        arguments: names of arguments that the functions of the file pass to each other.
    """

    block = 32, 4
    arguments: tuple[str, ...] = ()

    def __init__(self, real: str):
        self.real = real
        self._arrays: dict[tuple[str, bytes], tuple[str, Tensor]] = {}

    def name(self, values: Tensor) -> str:
        """Return the name of the array with the given values."""
        values = values.flatten()
        kind = self.real if values.dtype.is_floating_point else "int"
        key = kind, values.numpy().tobytes()
        return self._arrays.setdefault(key, (f"c{len(self._arrays)}", values))[0]

    def number(self, value: Any) -> str:
        """Return a number as an operand."""
        if isinstance(value, int):  # int or bool
            return f"{value:d}"
        if math.isnan(value):
            return "NAN"
        text = f"{abs(value)!r}{'f' * (self.real == 'float')}"
        text = text if math.isfinite(value) else "INFINITY"
        return f"(-{text})" if value < 0 else text

    def elements(self, values: Tensor) -> list[float | str]:
        """Return the numbers of an array, or expressions for numbers that may change."""
        numbers: list[float | str] = values.tolist()
        return numbers

    def common(self, values: Tensor) -> float | None:
        """Return the integer that is equal to all numbers of an array, or None."""
        first = values.flatten()[0]
        is_common = float(first).is_integer() and bool((values == first).all())
        return first.item() if is_common else None

    def spread(self, text: str) -> str:
        """Return an expression as a ``real``. An expression of constants may have another type."""
        return text

    def definitions(self) -> list[str]:
        """Return the lines that define the arrays."""
        return [
            self._definition(kind, name, values)
            for (kind, _), (name, values) in self._arrays.items()
        ]

    def _definition(self, kind: str, name: str, values: Tensor) -> str:
        numbers = ", ".join(self.number(x) for x in values.tolist())
        return f"static const {kind} {name}[{len(values)}] = {{{numbers}}};"


def is_mask_as_number(node: fx.Node, k: int) -> bool:
    """Return true if operand k is a boolean and the result of the operation is a number."""
    source = node.args[k]
    return (
        isinstance(source, fx.Node)
        and source.meta["val"].dtype == torch.bool
        and node.meta["val"].dtype != torch.bool
        and (operation(node), k) != ("where", 0)
    )


class _Buffers:
    """Names of arrays on the stack. An array is reused when its values are no longer needed."""

    def __init__(self) -> None:
        self.sizes: dict[str, tuple[str, int]] = {}
        self._free: list[str] = []

    def take(self, kind: str, size: int) -> str:
        fitting = [x for x in self._free if self.sizes[x] >= (kind, size) and kind in self.sizes[x]]
        if fitting:
            name = min(fitting, key=self.sizes.__getitem__)
            self._free.remove(name)
            return name
        name = f"x{len(self.sizes)}"
        self.sizes[name] = kind, size
        return name

    def release(self, name: str) -> None:
        if name in self.sizes:
            self._free.append(name)


def _storage(value: Tensor) -> int:
    return value.untyped_storage().data_ptr()


class CFunction:
    """Body of a C function that evaluates a program.

    An elementwise operation with a single use is written into the loop that uses it. A view is only
    another index of its array.

    Args:
        program: the operations.
        constants: constant arrays of the file.

    Attributes:
        lines: the statements.
        stack: upper bound of the bytes on the stack, for an optimization of ``-O1`` or more. The
            bound is twice the size of the arrays, since GCC adds up to 1.1 times their size at
            ``-O3``, and 1 kB, also for libm.
    """

    def __init__(self, program: Program, constants: ConstantArrays):
        self.constants = constants
        self.lines: list[str] = []
        self._arrays: dict[int, str] = {}
        self._buffers = _Buffers()
        self._kept: list[Tensor] = []
        graph = program.graph_module.graph
        results = program.results()
        for name, node in zip(program.inputs, graph.find_nodes(op="placeholder"), strict=True):
            scalar = node.meta["val"].ndim == 0
            self._arrays[_storage(node.meta["val"])] = f"(&{name})" if scalar else name
        nodes = [node for node in graph.nodes if node.op == "call_function"]
        self._inlined = {node for node in nodes if self._has_one_use(node) and node not in results}
        statements = [node for node in nodes if node not in self._inlined]
        last = {pointer: k for k, node in enumerate(statements) for pointer in self._reads(node)}
        results_of = {pointer for node in results for pointer in self._reads(node)}
        for k, node in enumerate(statements):
            self._write(node)
            for pointer in self._reads(node):
                if last[pointer] == k and pointer not in results_of and pointer in self._arrays:
                    self._buffers.release(self._arrays.pop(pointer))
        for name, node in zip(program.outputs, results, strict=True):
            value = torch.empty(node.meta["val"].shape)
            self._kept.append(value)
            self._arrays[_storage(value)] = name
            self._assign(value, node)
        sizes = self._buffers.sizes
        self.lines[:0] = [f"{kind} {name}[{size}];" for name, (kind, size) in sizes.items()]
        width = 8 if constants.real == "double" else 4
        arrays = sum(size * (width if kind == "real" else 4) for kind, size in sizes.values())
        self.stack = 2 * arrays + 1024

    def _has_one_use(self, node: fx.Node) -> bool:
        if operation(node) not in ELEMENTWISE or len(node.users) != 1:
            return False
        (user,) = node.users
        if operation(user) in REDUCTIONS:
            return True
        same = operation(user) in ELEMENTWISE
        return same and user.meta["val"].numel() == node.meta["val"].numel()

    def _reads(self, node: fx.Node) -> list[int]:
        """Return the arrays of a node: its result, and the arrays that its loop reads."""
        value = node.meta["val"]
        pointers = []
        if isinstance(value, Tensor) and node not in self._inlined:
            pointers.append(_storage(value))
        if node.op == "call_function" and operation(node) != "getitem":
            for operand in node.all_input_nodes:
                if operand in self._inlined:
                    pointers += self._reads(operand)
                elif isinstance(operand.meta["val"], Tensor):
                    pointers.append(_storage(operand.meta["val"]))
        return pointers

    # Operands and expressions.

    def _element(self, value: Tensor, index: Index, constant: bool = False) -> str:
        strides, offset = value.stride(), value.storage_offset()
        if constant:
            array = self.constants.name(value)
            strides, offset = torch.empty(value.shape, device="meta").stride(), 0
        else:
            array = self._arrays[_storage(value)]
        terms = [
            i if stride == 1 else f"{stride} * {i}"
            for i, stride, size in zip(index, strides, value.shape, strict=True)
            if stride and size > 1 and i != "0"
        ]
        return f"{array}[{' + '.join([*terms, *([str(offset)] if offset else [])]) or 0}]"

    def _operand(self, operand: Any, index: Index) -> str:
        """Return an operand, broadcast to the result, at an index of the result."""
        if not isinstance(operand, fx.Node):
            return self.constants.number(operand)
        value = operand.meta["val"]
        index = index[len(index) - value.ndim :]
        index = ["0" if size == 1 else i for i, size in zip(index, value.shape, strict=True)]
        constant = operand.op == "get_attr"
        number = self.constants.common(value) if constant else None
        if number is not None:
            return self.constants.number(number)
        if operand in self._inlined:
            return f"({self._expression(operand, index)})"
        return self._element(value, index, constant)

    def _expression(self, node: fx.Node, index: Index) -> str:
        name, arguments = operation(node), node.args
        operands = [
            self._number(node, k, index)
            for k, x in enumerate(arguments)
            if isinstance(x, fx.Node | int | float)
        ]
        if name == "pow" and arguments[1] in (2, 0.5):
            return f"{'square' if arguments[1] == 2 else 'sqrt'}({operands[0]})"
        return ELEMENTWISE[name].format(*operands)

    def _number(self, node: fx.Node, k: int, index: Index) -> str:
        """Return an operand of an elementwise operation. A boolean in arithmetic becomes 0 or 1."""
        text = self._operand(node.args[k], index)
        return f"choose({text}, 1, 0)" if is_mask_as_number(node, k) else text

    # Statements.

    def _loops(self, sizes: dict[str, int], body: list[str]) -> None:
        """Write statements inside loops over indices, from the outer to the inner loop."""
        loops = [f"for (int {i} = 0; {i} < {n}; {i}++)" for i, n in sizes.items() if n > 1]
        if len(body) > 1:
            loops.append("{")
        self.lines += [*("  " * k + line for k, line in enumerate(loops))]
        self.lines += ["  " * len(loops) + line for line in body]
        if len(body) > 1:
            self.lines.append("  " * (len(loops) - 1) + "}")

    def _indices(self, value: Tensor) -> tuple[list[str], dict[str, int]]:
        """Return an index for each dimension, and the sizes of indices in the order of memory."""
        index = [f"i{k}" if n > 1 else "0" for k, n in enumerate(value.shape)]
        strides: Any = value.stride()
        order = sorted(range(value.ndim), key=lambda k: -strides[k])
        return index, {index[k]: value.shape[k] for k in order if value.shape[k] > 1}

    def _assign(self, value: Tensor, source: fx.Node | float) -> None:
        """Write a loop that copies a source."""
        if value.numel():
            index, sizes = self._indices(value)
            operand = self.constants.spread(self._operand(source, index))
            self._loops(sizes, [f"{self._element(value, index)} = {operand};"])

    def _declare(self, node: fx.Node) -> Tensor:
        value: Tensor = node.meta["val"]
        kind = "flag" if value.dtype == torch.bool else "real"
        size = value.untyped_storage().nbytes() // value.element_size()
        self._arrays[_storage(value)] = self._buffers.take(kind, size)
        return value

    def _write(self, node: fx.Node) -> None:
        value, name = node.meta["val"], operation(node)
        if not isinstance(value, Tensor) or not value.numel() or _storage(value) in self._arrays:
            return  # an operation with several results, an empty array, or a view
        if name in ELEMENTWISE:
            index, sizes = self._indices(self._declare(node))
            expression = self._expression(node, index)
            if value.dtype != torch.bool:
                expression = self.constants.spread(expression)
            self._loops(sizes, [f"{self._element(value, index)} = {expression};"])
            return
        write: Any = self._reduction if name in REDUCTIONS else getattr(self, f"_{name}", None)
        if write is None:
            raise unsupported(node, "C code")
        write(node, *node.args)

    def _mm(self, node: fx.Node, left: fx.Node, right: fx.Node) -> None:
        """Write a matrix product by blocks of rows and columns, with sums in registers."""
        out, weights = self._declare(node), left
        a, b = left.meta["val"], right.meta["val"]
        if left.op != "get_attr" and right.op == "get_attr":  # compute (B^T A^T)^T
            a, b, out, weights = b.mT, a.mT, out.mT, right
        constant, zero = weights.op == "get_attr", self.constants.spread("0")
        (rows, depth), columns = a.shape, b.shape[1]
        height, breadth = self.constants.block
        full = rows - rows % height
        for first, end, width in ((0, full, height), (full, rows, rows - full)):
            if first == end:
                continue
            block = a[first:end].unflatten(0, (-1, width)).transpose(1, 2)
            weight = self._element(block, ["b", "k", "i"], constant)  # constants in this order
            target = out[first:end].unflatten(0, (-1, width))
            row = f"for (int i = 0; i < {width}; i++)"
            for start in range(0, columns, breadth):
                numbers = range(start, min(start + breadth, columns))
                factors = [f"y{j} = {self._element(b, ['k', str(j)])}" for j in numbers]
                sums = [f"s{j}[i] += {weight} * y{j};" for j in numbers]
                copies = [
                    f"{self._element(target, ['b', 'i', str(j)])} = s{j}[i];" for j in numbers
                ]
                body = [
                    f"real {', '.join(f's{j}[{width}]' for j in numbers)};",
                    f"{row} {' = '.join(f's{j}[i]' for j in numbers)} = {zero};",
                    f"for (int k = 0; k < {depth}; k++) {{",
                    f"  const real {', '.join(factors)};",
                    f"  {row} {{ {' '.join(sums)} }}",
                    "}",
                    f"{row} {{ {' '.join(copies)} }}",
                ]
                self._loops({"b": len(block)}, body)

    def _call(self, node: fx.Node, name: str, start: fx.Node, rows: fx.Node, size: int) -> None:
        """Write x <- name(x, row) for each row. With a single row, the size of x may change."""
        y, (count, width) = self._declare(node), rows.meta["val"].shape
        x = y if count > 1 else start.meta["val"]
        if count > 1:
            self._assign(x, start)
        places = [f"&{self._element(a, ['0'] * a.ndim)}" for a in (x, rows.meta["val"], y)]
        places[1] += f" + {width} * k" * (count > 1)
        loop = f"for (int k = 0; k < {count}; k++) " * (count > 1)
        self.lines.append(f"{loop}{name}({', '.join([*self.constants.arguments, *places])});")

    def _reduction(self, node: fx.Node, source: fx.Node, dims: Any = None, keep: bool = False):
        start, step = REDUCTIONS[operation(node)]
        start = self.constants.spread(start)
        value, shape = self._declare(node), source.meta["val"].shape
        if not shape.numel():  # for example the force without inputs
            self._assign(value, 0.0)
            return
        dims = [d % len(shape) for d in dims] if dims else [*range(len(shape))]
        index, sizes = self._indices(value)
        free = iter(index if not keep else [i for d, i in enumerate(index) if d not in dims])
        full = [f"j{d}" if d in dims else next(free) for d in range(len(shape))]
        inner = {f"j{d}": shape[d] for d in dims if shape[d] > 1}
        target, operand = self._element(value, index), self._operand(source, full)
        if value.numel() < 8:
            loops = " ".join(f"for (int {i} = 0; {i} < {n}; {i}++)" for i, n in inner.items())
            add = f"{loops} s = {step.format('s', operand)};"
            self._loops(sizes, [f"real s = {start};", add, f"{target} = s;"])
        else:  # sums of different entries are independent and run in parallel
            self._loops(sizes, [f"{target} = {start};"])
            self._loops({**inner, **sizes}, [f"{target} = {step.format(target, operand)};"])

    def _cat(self, node: fx.Node, sources: Sequence[fx.Node], dim: int = 0) -> None:
        value, start = self._declare(node), 0
        for source in sources:
            if source.meta["val"].numel():
                size = source.meta["val"].shape[dim]
                self._assign(value.narrow(dim, start, size), source)
                start += size

    def _move(self, node: fx.Node, source: fx.Node, *arguments: Any) -> None:
        """Write a loop over a table of the positions of entries.

        The operation itself gives the positions.
        """
        if any(x.op != "get_attr" for x in node.all_input_nodes if x is not source):
            raise unsupported(node, "C code")
        x = source.meta["val"]
        size = x.untyped_storage().nbytes() // x.element_size()
        positions = torch.arange(size).as_strided(x.shape, x.stride(), x.storage_offset())
        arguments = fx.node.map_arg(arguments, lambda argument: argument.meta["val"])
        table = node.target(positions, *arguments)  # type: ignore[operator]
        value = self._declare(node)
        index, sizes = self._indices(value)
        entry = f"{self._arrays[_storage(x)]}[{self._element(table, index, constant=True)}]"
        self._loops(sizes, [f"{self._element(value, index)} = {entry};"])

    _repeat = _index = _index_select = _flip = _move

    def _scatter(self, node: fx.Node, base: fx.Node, source: fx.Node, *part: int) -> None:
        value = self._declare(node)
        self._assign(value, base)
        view = getattr(torch.ops.aten, operation(node).removesuffix("_scatter"))
        self._assign(view(value, *part), source)

    _slice_scatter = _select_scatter = _scatter
