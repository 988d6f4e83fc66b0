"""Code in C from the first call on, in a cache folder of the test."""

from collections import defaultdict

import torch

from pinn_dyn.exports import compiled
from pinn_dyn.exports.c_library import QUICK, load_code
from pinn_dyn.exports.c_loop import SEVERAL_FROM, Loop, Steps
from pinn_dyn.exports.live_numbers import LiveNumbers


def build_at_once(monkeypatch, folder):
    """Build code in C at the first call, compiled quickly, in the cache of a folder."""
    monkeypatch.setenv("PINN_DYN_CACHE", str(folder))
    monkeypatch.setattr(compiled, "BUILD_SECONDS", 0.0)
    monkeypatch.setattr(compiled.Kind, "flags", ("-O0",))
    next_process(monkeypatch)


def next_process(monkeypatch):
    """Forget all code, as a new process has none."""
    monkeypatch.setattr(compiled, "_CODES", {})
    monkeypatch.setattr(compiled, "_SECONDS", defaultdict(float))


def codes():
    """Return the codes of this process."""
    return [*compiled._CODES.values()]


def loop_of(model, x, inputs, h, several):
    """Return the loop of a model without a cache of its numbers."""
    count = SEVERAL_FROM if several else 1
    steps = Steps(model, x.expand(count, -1), inputs.expand(count, 1, *inputs.shape), h[None])
    programs = steps.programs()
    constants = torch.cat([program.constants.evaluate() for program in programs.values()])
    numbers = LiveNumbers([*programs.values()], constants)
    library = load_code(steps.text(programs, numbers), QUICK)
    return Loop(library, torch.cat([constants[numbers.index], torch.zeros(1)]))
