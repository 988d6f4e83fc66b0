"""ONNX files of functions, compared with Python by ONNX Runtime."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, fx

from pinn_dyn.exports.exported_function import DTYPES, Calls, ExportedFunction, Real
from pinn_dyn.exports.program import MOVES, moved, operation, unsupported

OPSET = 18
_SAME = "sqrt exp log sin cos tan asin acos atan sinh cosh tanh erf floor sign"
_SAME += " neg reciprocal abs add sub mul div pow"
_ELEMENTWISE = {
    **{name: name.capitalize() for name in _SAME.split()},
    **{"maximum": "Max", "minimum": "Min", "where": "Where", "logical_not": "Not"},
    **{"gt": "Greater", "ge": "GreaterOrEqual", "lt": "Less", "le": "LessOrEqual", "eq": "Equal"},
    **{"logical_and": "And", "logical_or": "Or", "mm": "MatMul", "clone": "Identity"},
}
_COMPOSED: dict[str, Callable[..., str]] = {
    "log1p": lambda node, x, unit: node("Log", [node("Add", [x, unit])]),
    "expm1": lambda node, x, unit: node("Sub", [node("Exp", [x]), unit]),
}
_REDUCTIONS = {"sum": "ReduceSum", "amin": "ReduceMin", "amax": "ReduceMax"}


def write_onnx(functions: Sequence[ExportedFunction], path: Path, info: str, real: Real) -> Calls:
    """Write a function to an ONNX file of opset 18, with the names of its inputs and outputs.

    Inputs and outputs have a leading batch dimension, ``(batch, *shape)``.

    ``metadata_props`` contain the fields of ``info`` and the SHA-256 of the graph.

    Raises:
        ImportError: if onnx or onnxruntime is not installed.
        ValueError: if there are several functions.
    """
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise ImportError(
            f"{path.name} needs {error.name}: pip install 'pinn_dyn[onnx]'"
        ) from error
    (function,) = functions
    writer = _OnnxWriter(onnx.helper, DTYPES[real])
    graph = writer.graph(function)
    opset = onnx.helper.make_opsetid("", OPSET)
    model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=8)
    model.doc_string = function.about
    fields = {**json.loads(info), "sha256": hashlib.sha256(graph.SerializeToString()).hexdigest()}
    onnx.helper.set_model_props(
        model, {key: x if isinstance(x, str) else json.dumps(x) for key, x in fields.items()}
    )
    onnx.checker.check_model(model)
    onnx.save(model, path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(str(path), options, ["CPUExecutionProvider"])
    except Exception as error:
        remedy = "export with real='float'" if real == "double" else "export to .c"
        raise RuntimeError(
            f"ONNX Runtime does not load {path.name} with {real} numbers: {error}: {remedy}"
        ) from error

    def call(*inputs: np.ndarray) -> list[np.ndarray]:
        values = [x.astype(writer.dtype) for x in inputs]
        return list(session.run(None, dict(zip(function.inputs, values, strict=True))))

    return {function.name: call}


def _single(name: str) -> str:
    """Return the name of an input or output in the graph of a single state."""
    return f"{name} of a state"


class _OnnxWriter:
    """Nodes of a program as nodes of ONNX, with their names."""

    def __init__(self, helper: Any, dtype: Any):
        self.helper, self.dtype = helper, dtype
        self.nodes: list[Any] = []
        self.initializers: dict[str, Any] = {}
        self.names: dict[fx.Node, Any] = {}

    def graph(self, function: ExportedFunction) -> Any:
        """Return a graph that applies the graph of a single state to a batch."""
        program = function.program
        placeholders = program.graph_module.graph.find_nodes(op="placeholder")
        self.names = dict(zip(placeholders, map(_single, program.inputs), strict=True))
        for node in program.graph_module.graph.nodes:
            if node.op == "get_attr":
                self.names[node] = self.constant(node.meta["val"])
            elif node.op == "call_function":
                self.names[node] = self._write(node)
        for name, node in zip(program.outputs, program.results(), strict=True):
            self.node("Identity", [self.names[node]], _single(name))
        used = {name for node in self.nodes for name in node.input}
        constants = [x for x in self.initializers.values() if x.name in used]
        shapes = (program.inputs, program.outputs)
        ends = [[self.value(_single(x), y) for x, y in part.items()] for part in shapes]
        state = self.helper.make_graph(self.nodes, "state", *ends, constants)
        batches = [[self.value(x, ["batch", *y]) for x, y in part.items()] for part in shapes]
        scan = self.helper.make_node(
            "Scan", [*program.inputs], [*program.outputs], body=state, num_scan_inputs=len(ends[0])
        )
        return self.helper.make_graph([scan], function.name, *batches)

    def value(self, name: str, shape: Sequence[int | str]) -> Any:
        """Return the description of an input or output."""
        kind = self.helper.np_dtype_to_tensor_dtype(np.dtype(self.dtype))
        return self.helper.make_tensor_value_info(name, kind, [*shape])

    def constant(self, value: Any, dtype: Any = None) -> str:
        """Return the name of a constant. Equal constants are stored once."""
        array = np.asarray(value.detach() if isinstance(value, Tensor) else value)
        if dtype is None and array.dtype not in (np.bool_, np.int64):
            dtype = self.dtype
        array = array.astype(dtype or array.dtype)
        key = f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
        if key not in self.initializers:
            kind = self.helper.np_dtype_to_tensor_dtype(array.dtype)
            name = f"c{len(self.initializers)}"
            self.initializers[key] = self.helper.make_tensor(
                name, kind, array.shape, array.tobytes(), raw=True
            )
        return str(self.initializers[key].name)

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:
        """Add a node, and return the name of its output."""
        output = output or f"x{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(kind, inputs, [output], **attributes))
        return output

    def operand(self, x: Any, dtype: Any = None) -> str:
        return self.names[x] if isinstance(x, fx.Node) else self.constant(x, dtype or self.dtype)

    def real(self, x: Any) -> str:
        """Return an operand as a number; convert booleans and integers."""
        name = self.operand(x)
        if isinstance(x, fx.Node) and x.meta["val"].dtype in (torch.bool, torch.int64):
            kind = self.helper.np_dtype_to_tensor_dtype(np.dtype(self.dtype))
            return self.node("Cast", [name], to=kind)
        return name

    def _write(self, node: fx.Node) -> Any:
        name, arguments = operation(node), cast(tuple[Any, ...], node.args)
        if name == "getitem":
            return self.names[arguments[0]][arguments[1]]
        if name in MOVES.split():
            return self._move(node)
        if name in _COMPOSED:
            return _COMPOSED[name](self.node, self.real(arguments[0]), self.operand(1.0))
        if name in _REDUCTIONS:
            x, dims, keep, *_ = (*arguments, None, False)
            axes = [self.constant(list(dims), np.int64)] if dims else []
            return self.node(_REDUCTIONS[name], [self.real(x), *axes], keepdims=int(bool(keep)))
        if name == "_to_copy":
            is_real = node.meta["val"].is_floating_point()
            return self.real(arguments[0]) if is_real else self.operand(arguments[0])
        if name not in _ELEMENTWISE:
            raise unsupported(node, "ONNX")
        kind = _ELEMENTWISE[name]
        logical = {"And": 2, "Or": 2, "Not": 1, "Where": 1}.get(kind, 0)
        operands = [
            self.operand(x) if k < logical else self.real(x) for k, x in enumerate(node.args)
        ]
        return self.node(kind, operands)

    def _move(self, node: fx.Node) -> Any:
        """Write an operation that gathers the numbers of a result from its sources."""
        sources, index = moved(node)
        shape = self.constant([-1], np.int64)
        flat = [self.node("Reshape", [self.operand(x), shape]) for x in sources]
        source = self.node("Concat", flat, axis=0) if len(flat) > 1 else flat[0]
        if isinstance(index, Tensor):
            return self.node("Gather", [source, self.constant(index)])
        return [self.node("Gather", [source, self.constant(x)]) for x in index]
