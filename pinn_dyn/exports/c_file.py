"""C99 files of functions, compiled for a comparison where a C compiler is present."""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pinn_dyn.exports.c_code import PRELUDE, CFunction, Constants
from pinn_dyn.exports.exported import Calls, ExportedFunction, Real, identifier

log = logging.getLogger(__name__)

STATUS = "status"
"""Output that the C function returns, as an int."""


def write_c(functions: Sequence[ExportedFunction], path: Path, info: str, real: Real) -> Calls:
    """Write ``NAME.c`` and ``NAME.h`` with a function ``NAME_<function>`` each.

    The functions are reentrant, need libm alone, and allocate nothing. ``NAME_info()`` returns the
    text of ``info`` with the SHA-256 of the code.
    """
    name = identifier(path.stem)
    constants = Constants(real)
    bodies = [CFunction(function.program, constants) for function in functions]
    code = [f"typedef {real} real;", PRELUDE, *constants.definitions()]
    declarations = []
    for function, body in zip(functions, bodies, strict=True):
        signature = _signature(function, name, real)
        declarations += [
            f"/* {function.about} Stack: {body.stack} bytes. */".replace("/*  ", "/* "),
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
        "/* Written by pinn_dyn. SI units and radians. Arrays may overlap. Compile without",
        "   -ffast-math, which removes the tests for numbers that are not finite. */",
        f"#ifndef {name}_H",
        f"#define {name}_H",
        *(f"#define {name}_{key.upper()} {n}" for key, n in sizes.items()),
        f"#define {name}_INFO {json.dumps(json.dumps(fields))}",
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
    library = _compiled(path)
    if library is None:
        return {}
    return {
        function.name: _call(getattr(library, f"{name}_{function.name}"), function, real)
        for function in functions
    }


def _signature(function: ExportedFunction, name: str, real: Real) -> str:
    program = function.program
    parameters = [
        f"const {real} {x}[{shape.numel()}]" if len(shape) else f"{real} {x}"
        for x, shape in program.inputs.items()
    ]
    results = {x: n for x, n in program.outputs.items() if x != STATUS}
    parameters += [f"{real} {x}[{shape.numel()}]" for x, shape in results.items()]
    kind = "int" if STATUS in program.outputs else "void"
    return f"{kind} {name}_{function.name}({', '.join(parameters)})"


def find_compiler() -> list[str] | None:
    """Return the command of the C compiler, which CC may set with options, or None without one."""
    commands = [shlex.split(name) for name in _compilers()]
    return next((words for words in commands if shutil.which(words[0])), None)


def _compilers() -> list[str]:
    return [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]


def compile_c(compiler: Sequence[str], flags: Sequence[str], source: Path) -> Path:
    """Compile a C file to a library beside it.

    Raises:
        RuntimeError: if the compiler fails.
    """
    library = source.with_suffix(".so")
    command = [*compiler, *flags, "-o", library.name, source.name, "-lm"]
    result = subprocess.run(command, cwd=source.parent, capture_output=True, text=True)
    if result.returncode:
        lines = [*result.stderr.splitlines(), "no message"]
        problem = next((line for line in lines if "error" in line), lines[0])
        name = shlex.join(compiler)
        raise RuntimeError(f"{name} does not compile {source.name}: {problem}; set CC to another")
    return library


def _compiled(path: Path) -> ctypes.CDLL | None:
    """Compile a C file and load it; return None, with a warning, without a compiler."""
    compiler = find_compiler()
    if compiler is None:
        log.warning(
            "%s was not compared with the model: no C compiler (%s) is installed, set CC to one",
            path.name,
            ", ".join(_compilers()),
        )
        return None
    library = compile_c(compiler, ["-std=c99", "-O1", "-fPIC", "-shared"], path)
    loaded = ctypes.CDLL(str(library))
    library.unlink()
    return loaded


def _call(pointer: Any, function: ExportedFunction, real: Real) -> Callable[..., list[np.ndarray]]:
    dtype, number = (
        (np.float64, ctypes.c_double) if real == "double" else (np.float32, ctypes.c_float)
    )

    def call(*arguments: np.ndarray) -> list[np.ndarray]:
        inputs = [np.asarray(x, dtype, order="C") for x in arguments]
        results = {
            name: np.empty(tuple(shape), dtype) for name, shape in function.program.outputs.items()
        }
        arrays = [x for name, x in results.items() if name != STATUS]
        values = [number(float(x)) if x.ndim == 0 else _pointer(x) for x in inputs]
        status = pointer(*values, *map(_pointer, arrays))
        return [np.array(status) if name == STATUS else x for name, x in results.items()]

    return call


def _pointer(values: np.ndarray) -> ctypes.c_void_p:
    return values.ctypes.data_as(ctypes.c_void_p)
