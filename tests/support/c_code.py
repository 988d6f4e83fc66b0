"""Exported C files, compiled with all warnings as errors, and called from Python."""

import ctypes
import itertools
import re
import subprocess

import numpy as np

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
_number = itertools.count()


def compiled(path):
    """The library of a C file; a path is loaded only once, so each gets its own."""
    library = path.with_name(f"{path.stem}{next(_number)}.so")
    flags = [*STRICT, "-O1", "-shared", "-fPIC", "-o", str(library), str(path), "-lm"]
    subprocess.run(["cc", *flags], check=True)
    return ctypes.CDLL(str(library))


def function_of(path, name, library=None):
    """A function of the file, by its declaration in the header: from arrays to its outputs."""
    text = path.with_suffix(".h").read_text()
    result, parameters = re.search(rf"(\w+) {name}\(([^)]*)\);", text).groups()
    pointer = getattr(library or compiled(path), name)
    kinds = {"double": np.float64, "float": np.float32}
    parts = [re.fullmatch(r"(const )?(\w+) \w+(?:\[(\d+)\])?", x) for x in parameters.split(", ")]

    def call(*arguments):
        values, outputs, inputs = [], [], list(arguments)
        for constant, kind, size in (part.groups() for part in parts):
            if not size:
                values.append(
                    {"double": ctypes.c_double, "float": ctypes.c_float}[kind](inputs.pop(0))
                )
                continue
            array = np.full(int(size), np.nan, kinds[kind])
            if constant:
                array[:] = np.ravel(inputs.pop(0))
            else:
                outputs.append(array)
            values.append(array.ctypes.data_as(ctypes.c_void_p))
            values[-1].array = array
        assert not inputs
        status = pointer(*values)
        return [*outputs, status] if result == "int" else outputs

    return call
