"""Export control laws to files for other programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.control.contracts import Stage
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.observer import MomentumObserver, rest_speeds
from pinn_dyn.control.pipeline import Pipeline
from pinn_dyn.exports.exported_function import (
    ENDINGS,
    ExportedFunction,
    Ranges,
    Real,
    drawn_states,
    write,
)
from pinn_dyn.mechanics import MechanicalSystem

INPUTS = ("q", "v", "q_ref", "v_ref", "a_ref")


def export_law(
    law: Stage | Pipeline,
    path: str | Path,
    *,
    actuator: Actuator | None = None,
    period: float | None = None,
    real: Real = "double",
    run: Any = None,
    about: Mapping[str, Any] | None = None,
    ranges: Ranges | None = None,
) -> Path:
    """Write a law to a ``.c`` (with ``.h``), ``.onnx`` or ``.casadi`` file, see docs/realtime.md.

    The file holds the :class:`~.pipeline.Pipeline` of the law, the same function as in a closed
    loop: all stages, the dead time of the model's run, the limits, and the memory as an argument.

    Args:
        law: a law of a model in float64 on the CPU, with or without stages around it, or a
            pipeline.
        path: the file.
        actuator: limits of the input of a law.
        period: time between two calls of a law, s; required for limits of the rate, a dead time,
            and stages with a memory.
        real: type of the numbers of a ``.c`` or ``.onnx`` file.
        run: run that gives the dead time and the names for a law on ``run.model``. A law on
            ``run.system`` needs no run.
        about: entries for the description in the file.
        ranges: smallest and largest q, v and a, by name, of the states at which the file is
            compared with the law.

    Raises:
        ValueError: if the ending is unknown or the period is missing.
        TypeError: if the law runs in Python only, or the format lacks an operation of the law.
        RuntimeError: if the file cannot be compiled or loaded, or differs from the law by more than
            1e-9 (float: 1e-4).
    """
    path = Path(path).expanduser()
    if path.suffix not in ENDINGS:
        endings = ", ".join(ENDINGS)
        raise ValueError(f"{path} ends in {path.suffix!r}, expected one of {endings}")
    names = {} if run is None else {"q": run.labels, "u": run.input_labels}
    if isinstance(law, Pipeline):
        pipeline = law
    else:
        dead_time = None if run is None else run.input_delay
        pipeline = Pipeline(law, period, actuator=actuator, dead_time=dead_time)
    if pipeline.law.is_python:
        raise TypeError(
            f"{pipeline.law.about()['law']} runs in Python and cannot be exported, expected a law "
            "such as Tracking or LatentLaw"
        )
    n = pipeline.num_coordinates
    inputs = drawn_states({**dict.fromkeys(INPUTS, n), "memory_in": pipeline.memory_size}, ranges)
    model, limits = pipeline.law.model, pipeline.actuator
    if not names and model.labels:
        names = {"q": [*model.labels], "u": [*model.input_labels]}
    info = {
        **pipeline.law.about(),
        "limits": {key: getattr(limits, key) for key in ("low", "high", "rate")},
        "period": None if math.isnan(pipeline.period) else pipeline.period,
        "dead_time": pipeline.dead_time,
        "reference_ahead": pipeline.ahead[0],
        "num_coordinates": n,
        "num_inputs": pipeline.num_inputs,
        "memory_size": pipeline.memory_size,
        **names,
        **(about or {}),
    }
    text = (
        "Input u of the law. Returns the sum of 1 (limited), 2 (outside the training data), 4 "
        "(not finite: the last input), 8 (singular input matrix) and 16 (no input gives the "
        "force). Zero memory_in before the first call, then memory_out."
    )
    if pipeline.ahead[0]:
        text += f" q_ref, v_ref and a_ref are the reference {pipeline.ahead[0]:g} s ahead."
    outputs = ("u", "status", "memory_out")
    return write([ExportedFunction("control", pipeline, inputs, outputs, text)], path, info, real)


NAME = "external_torque"


def external_torque_function(
    model: MechanicalSystem, ranges: Ranges | None = None
) -> ExportedFunction:
    """Return ``external_torque(q, v, u, bandwidth, h, memory_in)`` -> tau_ext, memory_out.

    The function is one call of :class:`~.observer.MomentumObserver`, h seconds after the previous
    call, with the measured state and the input that acts at the same instant.

    Args:
        model: the model, in float64.
        ranges: smallest and largest q, v, u, bandwidth and h at which the exported function is
            compared with Python. The defaults are 20 to 100 1/s and 0.5 to 1.5 ms.
    """
    n, m = model.num_coordinates, model.num_inputs
    speeds, double = rest_speeds(model), torch.float64

    def external_torque(q: Tensor, v: Tensor, *values: Tensor) -> tuple[Tensor, Tensor]:
        *inputs, bandwidth, h, memory = values
        u = inputs[0] if inputs else q.new_zeros(0)
        observer = MomentumObserver(model, bandwidth, rest=speeds)
        driven = observer.driven(q, v, u)
        residual, memory = observer.estimate(q, v, torch.zeros_like(q), driven, memory, h)
        # The force of this input is also that at the start of the next period.
        before, force, band = memory.tensor_split([1 + 2 * n, 1 + 3 * n])
        return residual, torch.cat([before, force + driven, band])

    usual = {
        "bandwidth": (torch.tensor(20.0, dtype=double), torch.tensor(100.0, dtype=double)),
        "h": (torch.tensor(5e-4, dtype=double), torch.tensor(1.5e-3, dtype=double)),
    }
    memory_size = MomentumObserver(model, 1.0, rest=speeds).memory_size
    sizes = {"q": n, "v": n, "u": m, "bandwidth": None, "h": None, "memory_in": memory_size}
    states = drawn_states({k: x for k, x in sizes.items() if x != 0}, {**usual, **(ranges or {})})
    about = (
        "External torque of the joints, h seconds after the previous call, through a low-pass of "
        "the bandwidth in 1/s. Zero memory_in before the first call, then memory_out."
    )
    return ExportedFunction(NAME, external_torque, states, ("tau_ext", "memory_out"), about)
