"""C99 files of functions, compared with Python if a C compiler is installed."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch

from pinn_dyn.exports.c_code import PRELUDE, ConstantArrays
from pinn_dyn.exports.escaping import c_text
from pinn_dyn.exports.exported_function import DTYPES, Calls, ExportedFunction, Real, identifier
from pinn_dyn.exports.program import Program
from pinn_dyn.exports.scalar_code import CBody, c_function

log = logging.getLogger(__name__)

STATUS = "status"
"""Name of the output that the C function returns as an int."""
TIME_LIMIT = 60.0
"""Longest time of the comparison of a function, s."""
_LOOP = """\
  if (strcmp(words[1], "{function}") == 0) {{
    {real} x[{inputs}], y[{outputs}];
    while (fread(x, sizeof x, 1, stdin) == 1) {{
      {call};
      fwrite(y, sizeof y, 1, stdout);
    }}
  }}
"""


def write_c(functions: Sequence[ExportedFunction], path: Path, info: str, real: Real) -> Calls:
    """Write ``NAME.c`` and ``NAME.h`` with a function ``NAME_<function>`` each.

    The functions are reentrant, need only libm, and allocate no memory. ``NAME_info()`` returns the
    text of ``info`` with the SHA-256 of the code.
    """
    name = identifier(path.stem)
    constants = ConstantArrays(real)
    parts: dict[str, tuple[Program, CBody]] = {}
    programs, bodies, calls = [], [], []
    for function in functions:
        inner = function.programs()
        calls.append(len(inner) > 1)
        programs.append(inner.pop(function.name))
        bodies.append(c_function(programs[-1], constants))
        parts |= {x: (p, c_function(p, constants)) for x, p in inner.items()}
    code = [f"typedef {real} real;", PRELUDE, *constants.definitions(), *static_functions(parts)]
    declarations, deepest = [], max((body.stack for _, body in parts.values()), default=0)
    for function, program, body, has_calls in zip(functions, programs, bodies, calls, strict=True):
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
    named = {function.name: x for function, x in zip(functions, programs, strict=True)}
    compiled = _compiled(path, [_loop(x, program, name, real) for x, program in named.items()])
    if compiled is None:
        return {}
    return {x: _call(compiled, x, program, real) for x, program in named.items()}


def static_functions(
    parts: Mapping[str, tuple[Program, CBody]], arguments: Sequence[str] = ()
) -> list[str]:
    """Return the lines of static functions, which other functions of the file call.

    ``arguments`` are declarations of additional arguments.
    """
    code = []
    for name, (program, body) in parts.items():
        names = [*arguments, *(f"const real *{x}" for x in program.inputs), "real *result"]
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
    try:
        commands = [shlex.split(name) for name in _compilers()]
    except ValueError as error:
        text = f"CC is {os.environ['CC']!r}, expected the command of a C compiler: {error}"
        raise ValueError(text) from error
    return next((command for command in commands if shutil.which(command[0])), None)


def _compilers() -> list[str]:
    return [os.environ["CC"]] if os.environ.get("CC") else ["cc", "gcc", "clang"]


def compile_c(compiler: Sequence[str], flags: Sequence[str], source: Path, code: str = "") -> Path:
    """Compile a C file to a ``.so`` beside it. With the flag ``-``, compile ``code`` with it.

    Raises:
        RuntimeError: if the compiler fails.
    """
    library = source.with_suffix(".so")
    command = [*compiler, *flags, "-o", library.name, f"./{source.name}", "-lm"]
    result = subprocess.run(command, cwd=source.parent, input=code, capture_output=True, text=True)
    if result.returncode:
        lines = [*result.stderr.splitlines(), "no message"]
        problem = next((line for line in lines if "error" in line), lines[0])
        name = shlex.join(compiler)
        raise RuntimeError(
            f"{name} does not compile {source.name}: {problem}; set CC to another compiler"
        )
    return library


def _compiled(path: Path, loops: Sequence[str]) -> Path | None:
    """Compile a C file to a program that calls its functions.

    Without a compiler, log a warning and return None. The program runs in a separate process, so an
    error in the file cannot end this process.
    """
    compiler = find_compiler()
    if compiler is None:
        log.warning(
            "%s was not compared with the model: no C compiler (%s) is installed, set CC to one",
            path.name,
            ", ".join(_compilers()),
        )
        return None
    main = [
        f'#include <stdio.h>\n#include <string.h>\n#include "{path.stem}.h"',
        "int main(int count, char **words)\n{\n  (void)count;",
        *loops,
        "  return 0;\n}\n",
    ]
    flags = ["-std=gnu99", "-O1", "-x", "c", "-", "-x", "none"]  # c99 would replace trigraphs
    return compile_c(compiler, flags, path, "\n".join(main))


def _loop(function: str, program: Program, name: str, real: Real) -> str:
    """Return C code that calls a function for all states in the standard input."""
    shapes = program.inputs, program.outputs
    x, y = _pointers("x", shapes[0]), _pointers("y", shapes[1])
    arguments = [pointer if len(shapes[0][key]) else f"*{pointer}" for key, pointer in x.items()]
    status = y.pop(STATUS, None)
    call = f"{name}_{function}({', '.join([*arguments, *y.values()])})"
    return _LOOP.format(
        function=function,
        real=real,
        inputs=sum(map(torch.Size.numel, shapes[0].values())),
        outputs=sum(map(torch.Size.numel, shapes[1].values())),
        call=f"*{status} = {call}" if status else call,
    )


def _pointers(array: str, shapes: Mapping[str, torch.Size]) -> dict[str, str]:
    """Return a pointer to the numbers of each input or output in a common array."""
    starts = accumulate(map(torch.Size.numel, shapes.values()), initial=0)
    return {name: f"&{array}[{start}]" for name, start in zip(shapes, starts, strict=False)}


def _call(
    path: Path, function: str, program: Program, real: Real
) -> Callable[..., Sequence[np.ndarray]]:
    dtype = DTYPES[real]
    ends = [*accumulate(map(torch.Size.numel, program.outputs.values()))]

    def call(*inputs: np.ndarray) -> Sequence[np.ndarray]:
        states = np.concatenate([x.reshape(len(x), -1) for x in inputs], axis=1, dtype=dtype)
        command = [str(path), function]
        try:
            result = subprocess.run(
                command,
                input=states.tobytes(),
                stdout=subprocess.PIPE,
                timeout=TIME_LIMIT,
                check=True,
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise RuntimeError(f"{function} cannot be compared: {error}") from error
        values = np.frombuffer(result.stdout, dtype).reshape(len(states), -1)
        return np.split(values, ends[:-1], axis=1)

    return call
