"""Functions for files, and the comparison of a file with its function."""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import listed

if TYPE_CHECKING:
    from pinn_dyn.exports.program import Program
    from pinn_dyn.mechanics import ContinuousPredictor

Real = Literal["double", "float"]
Call = Callable[..., Sequence[np.ndarray]]
"""Function from K values of each input, ``(K, *shape)``, to K values of each output."""
Calls = Mapping[str, Call]
"""Functions of a written file, by name."""

Ranges = Mapping[str, tuple[Tensor, Tensor]]
"""Smallest and largest values of inputs by name, for the states of the comparison."""

TOLERANCES = {"double": 1e-9, "float": 1e-4}
DTYPES = {"double": np.float64, "float": np.float32}
STATES = 200
_WRITERS = {
    ".c": "pinn_dyn.exports.c_file:write_c",
    ".onnx": "pinn_dyn.exports.onnx_file:write_onnx",
    ".casadi": "pinn_dyn.exports.casadi_function:write_casadi",
}
ENDINGS = tuple(_WRITERS)


class ExportedFunction:
    """A function of a single state, and the states at which its file is compared with it.

    Args:
        name: name of the function in the file.
        function: function that takes the inputs by position, and returns a tensor per output.
        inputs: values of each input by name, ``(200, *shape)``, float64.
        outputs: names of the outputs.
        about: units and meaning, for the file.
        model: a model with a part that the function calls several times, or None. The function
            takes a copy of the model with a shared part as ``model=``.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Tensor | tuple[Tensor, ...]],
        inputs: Mapping[str, Tensor],
        outputs: Sequence[str],
        about: str = "",
        model: ContinuousPredictor | None = None,
    ):
        self.name, self.function, self.about = name, function, about
        self._model = model
        self.inputs, self.outputs = dict(inputs), list(outputs)

    @cached_property
    def program(self) -> Program:
        """Operations of the function."""
        from pinn_dyn.exports.program import trace

        example = {name: values[0] for name, values in self.inputs.items()}
        return trace(self.function, example, self.outputs)

    def programs(self) -> dict[str, Program]:
        """Return the operations of the called parts and of the function, by name."""
        from pinn_dyn.exports.repeated import programs, sharing

        example = {name: values[0] for name, values in self.inputs.items()}
        function = self.function
        if self._model is not None:
            function = partial(function, model=sharing(self._model))
        return programs(self.name, function, example, self.outputs)

    def compare(self, call: Call, real: Real) -> None:
        """Compare the function with that of a file with numbers of the type ``real``.

        A difference is relative to the scale in :func:`errors_of_rows`.

        Raises:
            RuntimeError: if a difference exceeds the tolerance of the type, the file returns
                another type, or the function has no finite value.
        """
        tolerance = TOLERANCES[real]
        states = [*zip(*self.inputs.values(), strict=True)]
        with torch.no_grad():
            rows = [self.function(*state) for state in states]
        outputs = [(row,) if isinstance(row, Tensor) else row for row in rows]
        columns = call(*(x.numpy() for x in self.inputs.values()))
        for output, expected, column in zip(
            self.outputs, zip(*outputs, strict=True), columns, strict=True
        ):
            values = torch.stack(expected).reshape(len(states), -1)
            results = np.reshape(column, values.shape)
            count = int(values.isfinite().all(-1).sum())
            if results.dtype != DTYPES[real] or not count:
                raise RuntimeError(
                    f"{self.name}: {output} has {count} finite values of {len(values)} and is "
                    f"{results.dtype} in the file, expected {real}: no file is written; check "
                    "the constants of the model and the writer of this format"
                )
            errors, scales = errors_of_rows(torch.from_numpy(results), values)
            if not (errors <= tolerance * scales).all():
                relative = errors / scales.where(scales > 0, 1.0)
                worst = int(relative.nan_to_num(torch.inf).argmax())
                at = ", ".join(
                    f"{name} = {np.round(x.numpy(), 4).tolist()}"
                    for name, x in zip(self.inputs, states[worst], strict=True)
                )
                raise RuntimeError(
                    f"{self.name}: {output} differs from the original by {relative[worst]:.1e} "
                    f"(relative, expected {tolerance:g}) at {at}: no file is written; check the "
                    "condition numbers of M(q) and A(q) there, or export with real='double'"
                )


def errors_of_rows(results: Tensor, expected: Tensor) -> tuple[Tensor, Tensor]:
    """Return the norms of the errors of rows ``(K, ...)``, and their scales, ``(K,)`` each.

    A scale is the norm of the expected row, or the RMS of all norms if this is larger. An expected
    row that is not finite has the error 0 if the result is not finite either, and else infinity.
    """
    rows, truth = results.flatten(1), expected.flatten(1)
    finite = truth.isfinite().all(-1)
    norms = torch.linalg.vector_norm(torch.where(finite[:, None], truth, 0.0), dim=-1)
    typical = (norms.square().sum() / finite.sum().clamp_min(1)).sqrt()
    differences = torch.linalg.vector_norm(rows - truth, dim=-1)
    broken = torch.where(rows.isfinite().all(-1), torch.inf, 0.0)
    return torch.where(finite, differences, broken), norms.clamp_min(typical)


def write(
    functions: Sequence[ExportedFunction],
    path: Path,
    info: Mapping[str, Any],
    real: Real = "double",
) -> Path:
    """Write functions to a file in the format of its ending, and compare the file with them.

    Args:
        functions: the functions. Only C files can contain several functions.
        path: ``.c``, ``.onnx`` or ``.casadi``. With a ``.c``, a ``.h`` is written.
        info: names, gains and sizes, which the file contains as JSON, with the version.
        real: type of the numbers.

    Raises:
        RuntimeError: if the file differs from the functions by a relative error of more than 1e-9
            (double) or 1e-4 (float). The file is deleted.
        TypeError: if the format lacks an operation.
    """
    module, writer = _WRITERS[path.suffix].split(":")
    path.parent.mkdir(parents=True, exist_ok=True)
    version = importlib.import_module("pinn_dyn").__version__
    text = json.dumps({"pinn_dyn": version, "real": real, **info}, default=listed)
    # Write to a temporary folder and move the file: after a failure, the old file is unchanged.
    with TemporaryDirectory(dir=path.parent, prefix=".export-") as folder:
        partial = Path(folder) / path.name
        calls: Calls = getattr(importlib.import_module(module), writer)(
            functions, partial, text, real
        )
        for function in functions if calls else ():
            function.compare(calls[function.name], real)
        for file in (partial.with_suffix(".h"), partial):
            if file.exists():
                os.replace(file, path.parent / file.name)
    return path


def drawn_states(
    sizes: Mapping[str, int | None], ranges: Ranges | None = None
) -> dict[str, Tensor]:
    """Return 200 values of inputs by name, ``(200, size)``, or ``(200,)`` for the size None.

    The values are uniform within the range of the input, by default [-1, 1], with a fixed seed.
    ``q_ref`` and ``u_next`` have the ranges of ``q`` and ``u``. ``q_past`` repeats that of ``q``.
    """
    generator = torch.Generator().manual_seed(0)
    unit = torch.ones((), dtype=torch.float64)
    values = {}
    for name, size in sizes.items():
        low, high = (ranges or {}).get(name.partition("_")[0], (-unit, unit))
        shape = (STATES,) if size is None else (STATES, size)
        if low.ndim and size is not None:
            times = size // max(len(low), 1)
            low, high = low.repeat(times), high.repeat(times)
        share = torch.rand(shape, generator=generator, dtype=torch.float64)
        values[name] = low + (high - low) * share
    return values


def identifier(text: str) -> str:
    """Convert a name to an identifier in C."""
    return re.sub(r"^(?=\d)", "_", re.sub(r"\W", "_", text, flags=re.ASCII))
