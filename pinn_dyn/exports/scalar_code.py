"""C functions for programs without loops, with a statement per number."""

from __future__ import annotations

import collections
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, fx

from pinn_dyn.exports.c_code import (
    ELEMENTWISE,
    REDUCTIONS,
    CFunction,
    ConstantArrays,
    is_mask_as_number,
)
from pinn_dyn.exports.program import MOVES, Program, moved, operation, unsupported

_KNOWN: dict[str, Callable[..., float]] = {
    "mul": lambda a, b: a * b,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "neg": lambda a: -a,
    "logical_not": lambda a: not a,
}
"""Operations that are evaluated during the export if all operands are known."""
_LONGEST = 80  # longest expression that is written into another expression, in characters
_MOST_WEIGHTS = 64  # learned numbers of a matrix, beyond which a loop is faster
_MOST_WORK = 150_000  # operations with zeros, beyond which compilers take long

Term = int
"""Index of an entry in the list of terms."""


class ScalarTerms:
    """Terms: operations on earlier terms. Equal operations are the same term.

    Products with 0 or 1 and sums with 0 are simplified, which is exact for finite numbers.
    """

    def __init__(self) -> None:
        self.entries: list[tuple[Any, ...]] = []
        self._numbers: dict[tuple[Any, ...], Term] = {}

    def term(self, *entry: Any) -> Term:
        """Return the term of an operation and its operands, or of a leaf."""
        number = self._numbers.setdefault(entry, len(self.entries))
        if number == len(self.entries):
            self.entries.append(entry)
        return number

    def known(self, value: float) -> Term:
        """Return the term of a constant number in the code."""
        return self.term("known", value)

    def value(self, term: Term) -> float | None:
        """Return the number of a constant term, or None for any other term."""
        name, *operands = self.entries[term]
        return operands[0] if name == "known" else None

    def apply(self, name: str, *terms: Term) -> Term:
        """Return the term of an elementwise operation."""
        values = [self.value(x) for x in terms]
        if name in _KNOWN and None not in values:
            return self.known(_KNOWN[name](*values))
        rule = getattr(self, f"_{name}", None)
        return self.term(name, *terms) if rule is None else rule(*terms)

    def _mul(self, a: Term, b: Term) -> Term:
        for x, y in ((a, b), (b, a)):
            if self.value(x) == 0:
                return x
            if self.value(x) == 1:
                return y
            if self.value(x) == -1:
                return self.apply("neg", y)
        return self.term("mul", *sorted((a, b)))

    def _add(self, a: Term, b: Term) -> Term:
        for x, y in ((a, b), (b, a)):
            if self.value(x) == 0:
                return y
        return self.term("add", *sorted((a, b)))

    def _sub(self, a: Term, b: Term) -> Term:
        if self.value(b) == 0:
            return a
        if self.value(a) == 0:
            return self.apply("neg", b)
        return self.term("sub", a, b)

    def _div(self, a: Term, b: Term) -> Term:
        if self.value(a) == 0 or self.value(b) == 1:
            return a
        return self.term("div", a, b)

    def _where(self, mask: Term, a: Term, b: Term) -> Term:
        value = self.value(mask)
        if a == b or value:
            return a
        return self.term("where", mask, a, b) if value is None else b

    # Masks that are constant are numbers, which C cannot combine with flags.

    def _logical_and(self, a: Term, b: Term) -> Term:
        for x, y in ((a, b), (b, a)):
            if self.value(x) is not None:
                return y if self.value(x) else x
        return self.term("logical_and", a, b)

    def _logical_or(self, a: Term, b: Term) -> Term:
        for x, y in ((a, b), (b, a)):
            if self.value(x) is not None:
                return x if self.value(x) else y
        return self.term("logical_or", a, b)

    def _clone(self, a: Term) -> Term:
        return a

    def _pow(self, a: Term, b: Term) -> Term:
        if self.value(b) == 2:
            return self.apply("mul", a, a)
        return self.term("sqrt", a) if self.value(b) == 0.5 else self.term("pow", a, b)


class ScalarFunction:
    """Body of a C function that evaluates a program number by number.

    Operations with structural zeros are left out, and equal numbers are computed once.

    Args:
        program: the operations. :func:`c_function` selects programs for which this pays off.
        constants: constant arrays of the file.

    Attributes:
        lines: the statements.
        stack: upper bound of the bytes on the stack, with an optimization of ``-O1`` or more.
    """

    def __init__(self, program: Program, constants: ConstantArrays):
        self._constants, self._terms = constants, ScalarTerms()
        self._of: dict[fx.Node, Any] = {}
        graph, results = program.graph_module.graph, program.results()
        for name, node in zip(program.inputs, graph.find_nodes(op="placeholder"), strict=True):
            self._of[node] = self._leaves(name, node.meta["val"].shape)
        for node in graph.nodes:
            if node.op == "get_attr":
                self._of[node] = self._constant(node.meta["val"])
            elif node.op == "call_function":
                self._of[node] = self._evaluated(node)
        self.lines: list[str] = []
        self._texts: dict[Term, str] = {}
        self._write_all([self._of[node].ravel().tolist() for node in results], program.outputs)
        width = 8 if constants.real == "double" else 4
        self.stack = 4 * width * _most_live(self.lines) + 1024

    def _leaves(self, name: str, shape: torch.Size) -> np.ndarray:
        if not shape:
            return np.array(self._terms.term("leaf", name))
        leaves = [self._terms.term("leaf", f"{name}[{k}]") for k in range(shape.numel())]
        return np.array(leaves, dtype=int).reshape(shape)

    def _constant(self, values: Tensor) -> np.ndarray:
        terms = [
            self._terms.term("leaf", x) if isinstance(x, str) else self._terms.known(x)
            for x in self._constants.elements(values.flatten())
        ]
        return np.array(terms, dtype=int).reshape(values.shape)

    def _evaluated(self, node: fx.Node) -> Any:
        name, value = operation(node), node.meta["val"]
        arguments: Any = node.args
        if name == "getitem":
            return self._of[arguments[0]][arguments[1]]
        if name in MOVES.split():
            return self._moved(node)
        if name in ELEMENTWISE:
            operands = [self._operand(node, k) for k in range(len(node.args))]
            return self._each(name, [x for x in operands if x is not None], value.shape)
        if name in REDUCTIONS:
            return self._reduced(name, node)
        if name == "mm":
            return self._product(*(self._of[x] for x in arguments))
        if name == "call":
            return self._called(node)
        raise unsupported(node, "C code")

    def _operand(self, node: fx.Node, k: int) -> np.ndarray | None:
        """Return the terms of an operand, or None. A boolean in arithmetic becomes 0 or 1."""
        source = node.args[k]
        if isinstance(source, bool | int | float):
            return np.array(self._terms.known(float(source)))
        if not isinstance(source, fx.Node):
            return None
        terms: np.ndarray = self._of[source]
        if not is_mask_as_number(node, k):
            return terms
        numbers = [np.array(self._terms.known(x)) for x in (1.0, 0.0)]
        return self._each("where", [terms, *numbers], terms.shape)

    def _each(self, name: str, operands: Sequence[np.ndarray], shape: Sequence[int]) -> np.ndarray:
        rows = [np.broadcast_to(x, shape).ravel().tolist() for x in operands]
        terms = [self._terms.apply(name, *entry) for entry in zip(*rows, strict=True)]
        return np.array(terms, dtype=int).reshape(shape)

    def _moved(self, node: fx.Node) -> Any:
        sources, positions = moved(node)
        numbers = [self._of[source].ravel() for source in sources]
        pool = np.concatenate(numbers) if numbers else np.zeros(0, dtype=int)
        if isinstance(positions, Tensor):
            return pool[positions.numpy()]
        return [pool[part.numpy()] for part in positions]

    def _reduced(self, name: str, node: fx.Node) -> np.ndarray:
        (source, *_), value = node.all_input_nodes, node.meta["val"]
        terms = self._of[source]
        argument: Any = node.args[1] if len(node.args) > 1 else None
        dims: Sequence[int] = argument or range(terms.ndim)
        axes = sorted(d % terms.ndim for d in dims)
        rows = np.moveaxis(terms, axes, range(len(axes))).reshape(-1, value.numel())
        step = {"sum": "add", "amin": "minimum", "amax": "maximum"}[name]
        total = rows[0] if len(rows) else np.full(value.numel(), self._terms.known(0.0))
        for row in rows[1:]:
            total = self._each(step, [total, row], total.shape)
        return total.reshape(value.shape)

    def _product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        total = np.full((a.shape[0], b.shape[1]), self._terms.known(0.0))
        for k in range(a.shape[1]):
            part = self._each("mul", [a[:, k : k + 1], b[k : k + 1]], total.shape)
            total = self._each("add", [total, part], total.shape)
        return total

    def _called(self, node: fx.Node) -> np.ndarray:
        node_arguments: Any = node.args
        function, *sources, size = node_arguments
        arguments = tuple(tuple(self._of[x].ravel().tolist()) for x in sources)
        call = self._terms.term("call", function, arguments, len(sources[1].meta["val"]), size)
        return np.array([self._terms.term("element", call, k) for k in range(size)], dtype=int)

    # Statements.

    def _write_all(self, ends: Sequence[Sequence[Term]], names: Iterable[str]) -> None:
        entries = self._terms.entries
        uses = [0] * len(entries)
        for term in itertools.chain(*ends):
            uses[term] += 2  # a result gets a variable, since inputs and outputs may overlap
        for term in reversed(range(len(entries))):
            for operand in _operands(entries[term]) if uses[term] else ():
                uses[operand] += 1
        results = set(itertools.chain(*ends))
        for term, (name, *operands) in enumerate(entries):
            if not uses[term]:
                continue
            if name == "call":
                self._write_call(term, *operands)
            else:
                self._texts[term] = self._written(term, uses[term] > 1, term in results)
        for name, terms in zip(names, ends, strict=True):
            values = map(self._value, terms)
            self.lines += [f"{name}[{k}] = {value};" for k, value in enumerate(values)]

    def _written(self, term: Term, is_shared: bool, is_result: bool) -> str:
        """Return a term as an operand. Write a statement with a variable for a long expression."""
        name, *operands = self._terms.entries[term]
        if name == "known":
            return self._constants.number(operands[0])
        if name == "element":
            return f"{self._texts[operands[0]]}[{operands[1]}]"
        if name == "leaf":
            text, is_operand = operands[0], not is_result
        else:
            text = ELEMENTWISE[name].format(*(self._texts[x] for x in operands))
            is_operand = not is_shared and len(text) <= _LONGEST
        if not is_operand:
            kind = "flag" if name in _MASKS else "real"
            value = text if name in _MASKS else self._constants.spread(text)
            self.lines.append(f"const {kind} t{term} = {value};")
            return f"t{term}"
        is_closed = name == "leaf" or ELEMENTWISE[name].endswith(")")
        return text if is_closed else f"({text})"

    def _write_call(
        self,
        term: Term,
        function: str,
        arguments: Sequence[Sequence[Term]],
        count: int,
        size: int,
    ) -> None:
        """Write y <- x, then y <- function(y, row) for each row."""
        x, rows, result = f"t{term}_0", f"t{term}_1", f"t{term}"
        for name, terms in zip((x, rows), arguments, strict=True):
            values = ", ".join(map(self._value, terms)) or "0"
            self.lines.append(f"real {name}[{len(terms) or 1}] = {{{values}}};")
        loop = ""
        if count > 1:
            loop, result = f"for (int k = 0; k < {count}; k++) ", x
            rows += f" + {len(arguments[1]) // count} * k"
        else:
            self.lines.append(f"real {result}[{size}];")
        names = [*self._constants.arguments, x, rows, result]
        self.lines.append(f"{loop}{function}({', '.join(names)});")
        self._texts[term] = result

    def _value(self, term: Term) -> str:
        return self._constants.spread(self._texts[term])


_VARIABLE = re.compile(r"\bt\d+(?:_\d+)?\b")
_ARRAY = re.compile(r"real \w+\[(\d+)\]")
_MASKS = {"gt", "ge", "lt", "le", "eq", "logical_and", "logical_or", "logical_not"}


def _operands(entry: tuple[Any, ...]) -> Sequence[Term]:
    name, *operands = entry
    if name in ("leaf", "known"):
        return ()
    if name == "element":
        return operands[:1]
    return [*itertools.chain(*operands[1])] if name == "call" else operands


def _most_live(lines: Sequence[str]) -> int:
    """Return the largest count of numbers that are live, over all lines."""
    last = {name: k for k, line in enumerate(lines) for name in _VARIABLE.findall(line)}
    live, peak, ends = 0, 0, collections.Counter(last.values())
    seen: set[str] = set()
    for k, line in enumerate(lines):
        new = set(_VARIABLE.findall(line)) - seen
        seen |= new
        array = _ARRAY.match(line)
        live += int(array[1]) if array else len(new)
        peak = max(peak, live)
        live -= ends[k]
    return peak


CBody = CFunction | ScalarFunction


def c_function(program: Program, constants: ConstantArrays) -> CBody:
    """Return a C function, without loops if the program has no large matrix of learned numbers."""
    kind = ScalarFunction if _is_scalar(program) else CFunction
    return kind(program, constants)


def c_functions(
    programs: Mapping[str, Program], constants: ConstantArrays
) -> dict[str, tuple[Program, CBody]]:
    """Return programs and their C functions by name."""
    return {name: (x, c_function(x, constants)) for name, x in programs.items()}


def _is_scalar(program: Program) -> bool:
    work = 0
    for node in program.graph_module.graph.nodes:
        value = node.meta["val"]
        if operation(node) == "mm":
            shapes = [x.meta["val"].shape for x in node.args]
            work += shapes[0].numel() * shapes[1][1]
            weights = [x.meta["val"] for x in node.args if x.op == "get_attr"]
            learned = [x for x in weights if int(((x != 0) & (x.abs() != 1)).sum()) > _MOST_WEIGHTS]
            if learned:
                return False
        elif isinstance(value, Tensor):
            work += value.numel()
    return work <= _MOST_WORK
