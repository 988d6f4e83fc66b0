"""C99 files of functions, compared with Python if a C compiler is installed."""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pinn_dyn.exports.c_code import PRELUDE, ConstantArrays
from pinn_dyn.exports.escaping import c_text
from pinn_dyn.exports.exported_function import DTYPES, Calls, ExportedFunction, Real, identifier
from pinn_dyn.exports.program import Program
from pinn_dyn.exports.scalar_code import CBody, c_functions

log = logging.getLogger(__name__)

STATUS = "status"
"""Name of the output that the C function returns as an int."""


def write_c(functions: Sequence[ExportedFunction], path: Path, info: str, real: Real) -> Calls:
    """Write ``NAME.c`` and ``NAME.h`` with a function ``NAME_<function>`` each.

    The functions are reentrant, need only libm, and allocate no memory. ``NAME_info()`` returns the
    text of ``info`` with the SHA-256 of the code.
    """
    name = identifier(path.stem)
    constants = ConstantArrays(real)
    parts: dict[str, tuple[Program, CBody]] = {}
    bodies, calls = [], []
    for function in functions:
        inner = c_functions(function.programs(), constants)
        calls.append(len(inner) > 1)
        bodies.append(inner.pop(function.name))
        parts |= inner
    code = [f"typedef {real} real;", PRELUDE, *constants.definitions(), *static_functions(parts)]
    declarations, deepest = [], max((body.stack for _, body in parts.values()), default=0)
    for function, (program, body), has_calls in zip(functions, bodies, calls, strict=True):
        stack = body.stack + deepest * has_calls
        signature = _signature(function.name, program, name, real)
        declarations += [
            f"/* {function.about} Stack: at most {stack} bytes. */".replace("/*  ", "/* "),
            f"{signature};",
        ]
        unused = [f"(void){x};" for x in function.inputs]
        status = [f"real {STATUS}[1];"] * (STATUS in function.outputs)
        returned = [f"return (int){STATUS}[0];"] * (STATUS in function.outputs)
        lines = [*status, *unused, *body.lines, *returned]
        code += [f"\n{signature}", "{", *(f"  {line}" for line in lines), "}"]
    digest = hashlib.sha256("\n".join(code).encode()).hexdigest()
    fields = {**json.loads(info), "sha256": digest}
    sizes = {key: n for key, n in fields.items() if isinstance(n, int)}
    header = [
        "/* SPDX-License-Identifier: MIT",
        "   Written by pinn_dyn. SI units and radians. Arrays may overlap. Compile without",
        "   -ffast-math, which removes the tests for numbers that are not finite. */",
        f"#ifndef {name}_H",
        f"#define {name}_H",
        *(f"#define {name}_{identifier(key.upper())} {n:d}" for key, n in sizes.items()),
        f'#define {name}_INFO "{c_text(json.dumps(fields))}"',
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        f"const char *{name}_info(void); /* {name}_INFO of the compiled code */",
        *declarations,
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "#endif",
    ]
    path.with_suffix(".h").write_text("\n".join([*header, ""]))
    about = f"const char *{name}_info(void) {{ return {name}_INFO; }}"
    path.write_text("\n".join([f'#include "{path.stem}.h"', *code, "", about, ""]))
    compiler = find_compiler()
    if compiler is None:
        log.warning(
            "%s was not compared with the model: no C compiler is installed, set CC to one",
            path.name,
        )
        return {}
    flags = ["-std=gnu99", "-O1", "-fPIC", "-shared"]  # c99 would replace trigraphs
    library = ctypes.CDLL(str(compile_c(compiler, flags, path)))
    return {
        function.name: _call(library[f"{name}_{function.name}"], program, real)
        for function, (program, _) in zip(functions, bodies, strict=True)
    }


def static_functions(
    parts: Mapping[str, tuple[Program, CBody]], arguments: Sequence[str] = ()
) -> list[str]:
    """Return the lines of static functions, which other functions of the file call.

    ``arguments`` are declarations of additional arguments.
    """
    code, qualifier = [], "restrict" if arguments else ""
    for name, (program, body) in parts.items():
        kinds = {x: "const real *" if len(n) else "double " for x, n in program.inputs.items()}
        kinds |= dict.fromkeys(program.outputs, f"real *{qualifier} ")
        names = [*arguments, *(f"{kind}{x}" for x, kind in kinds.items())]
        unused = [f"(void){x};" for x in program.inputs]
        code += [f"\nstatic void {name}({', '.join(names)})"]
        code += ["{", *(f"  {line}" for line in [*unused, *body.lines]), "}"]
    return code


def _signature(function: str, program: Program, name: str, real: Real) -> str:
    parameters = [
        f"const {real} {x}[{shape.numel()}]" if len(shape) else f"{real} {x}"
        for x, shape in program.inputs.items()
    ]
    results = {x: n for x, n in program.outputs.items() if x != STATUS}
    parameters += [f"{real} {x}[{shape.numel()}]" for x, shape in results.items()]
    kind = "int" if STATUS in program.outputs else "void"
    return f"{kind} {name}_{function}({', '.join(parameters)})"


def find_compiler() -> list[str] | None:
    """Return the command of the C compiler, or None. CC may set the command with options."""
    names = [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]
    commands = map(shlex.split, names)
    return next((command for command in commands if shutil.which(command[0])), None)


def compile_c(compiler: Sequence[str], flags: Sequence[str], source: Path) -> Path:
    """Compile a C file to a ``.so`` beside it.

    Raises:
        RuntimeError: if the compiler fails.
    """
    library = source.with_suffix(".so")
    command = [*compiler, *flags, "-o", library.name, f"./{source.name}", "-lm"]
    result = subprocess.run(command, cwd=source.parent, capture_output=True, text=True)
    if result.returncode:
        lines = [*result.stderr.splitlines(), "no message"]
        problem = next((line for line in lines if "error" in line), lines[0])
        name = shlex.join(compiler)
        raise RuntimeError(
            f"{name} does not compile {source.name}: {problem}; set CC to another compiler"
        )
    return library


def _call(function: Any, program: Program, real: Real) -> Callable[..., Sequence[np.ndarray]]:
    """Return a compiled function for K values of each input, see :data:`Calls`."""
    dtype, number = DTYPES[real], {"double": ctypes.c_double, "float": ctypes.c_float}[real]

    def call(*inputs: np.ndarray) -> Sequence[np.ndarray]:
        results = {x: np.empty((len(inputs[0]), *n), dtype) for x, n in program.outputs.items()}
        arrays = [np.ascontiguousarray(x, dtype) for x in inputs]
        arrays += [x for name, x in results.items() if name != STATUS]
        for k in range(len(inputs[0])):
            rows = [x[k] for x in arrays]
            status = function(*(x.ctypes if x.ndim else number(x) for x in rows))
            if STATUS in results:
                results[STATUS][k] = status
        return [*results.values()]

    return call
