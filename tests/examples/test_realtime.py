"""The loop in C: built without a warning, without allocations, and the same twice."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.c_code import STRICT

EXAMPLE = Path(__file__).parents[2] / "examples" / "realtime"
NO_ALLOCATION = """
#include <stdlib.h>
void *__wrap_malloc(size_t n) { (void)n; abort(); }
void *__wrap_calloc(size_t n, size_t m) { (void)n; (void)m; abort(); }
void *__wrap_realloc(void *p, size_t n) { (void)p; (void)n; abort(); }
"""
MATH = {
    "sin",
    "sincos",
    "cos",
    "tan",
    "exp",
    "log",
    "log1p",
    "expm1",
    "sqrt",
    "pow",
    "tanh",
    "fabs",
}


@pytest.mark.slow
def test_the_loop_runs_the_law_without_allocations_and_repeats_itself(tmp_path):
    command = [sys.executable, str(EXAMPLE / "export.py"), "--folder", str(tmp_path)]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(EXAMPLE.parents[1])})
    shutil.copy(EXAMPLE / "loop.c", tmp_path)
    (tmp_path / "wrap.c").write_text(NO_ALLOCATION)
    sources = ["loop.c", "law.c", "plant.c", "wrap.c"]
    wrapped = [f"-Wl,--wrap={name}" for name in ("malloc", "calloc", "realloc")]
    subprocess.run(
        ["cc", *STRICT, "-O2", *wrapped, *sources, "-lm", "-o", "loop"], cwd=tmp_path, check=True
    )
    run = [tmp_path / "loop", "10000", "--as-fast-as-possible"]
    outputs = [subprocess.run(run, capture_output=True, text=True, check=True).stdout]
    outputs.append(subprocess.run(run, capture_output=True, text=True, check=True).stdout)
    first, second = (re.search(r"checksum (\w{16})", text)[1] for text in outputs)
    assert first == second
    assert "flags 0" in outputs[0]
    assert sum(map(int, re.findall(r"(?:us|more): +(\d+)", outputs[0]))) == 10000
    subprocess.run(["cc", "-c", "-O2", "law.c"], cwd=tmp_path, check=True)
    symbols = subprocess.run(["nm", "-u", tmp_path / "law.o"], capture_output=True, text=True)
    assert {line.split()[-1] for line in symbols.stdout.splitlines()} <= MATH
