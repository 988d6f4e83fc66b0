"""Files of control laws for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from pinn_dyn.control.contracts import Controller
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.safe_law import SafeLaw
from pinn_dyn.exports.exported import (
    ENDINGS,
    ExportedFunction,
    Ranges,
    Real,
    drawn_states,
    write,
)

INPUTS = ("q", "v", "q_ref", "v_ref", "a_ref")


def export_law(
    controller: Controller,
    path: str | Path,
    *,
    actuator: Actuator | None = None,
    period: float | None = None,
    real: Real = "double",
    about: Mapping[str, Any] | None = None,
    ranges: Ranges | None = None,
) -> Path:
    """Write a law to a ``.c`` (with ``.h``), ``.onnx`` or ``.casadi`` file, see docs/realtime.md.

    The file holds the :class:`~.safe_law.SafeLaw`, which is the law with its observer, its guard
    and the limits of the input, and explicit memory. That of a LatentLaw includes its estimate.

    Args:
        controller: a law of a model in float64 on the CPU, also with an observer or a guard.
        path: the file.
        actuator: limits of the input.
        period: time between two calls, s; limits of the rate and observers need it.
        real: type of the numbers of a ``.c`` or ``.onnx`` file.
        about: fields for the information in the file. Names and units of coordinates and inputs are
            those of the model of a run.
        ranges: smallest and largest q, v and a of the states of the comparison, by name.

    Raises:
        ValueError: on another ending, or a missing period.
        TypeError: on a controller that is not a law of a model, or an operation that the format
            does not have.
        RuntimeError: if the file cannot be compiled or loaded, or does not repeat the law to 1e-9
            (float: 1e-4).
    """
    path = Path(path).expanduser()
    if path.suffix not in ENDINGS:
        endings = ", ".join(ENDINGS)
        raise ValueError(f"{path} ends in {path.suffix!r}, expected one of {endings}")
    safe = SafeLaw(controller, actuator, period)
    model, n = safe.law.model, safe.law.num_coordinates
    inputs = drawn_states({**dict.fromkeys(INPUTS, n), "memory_in": safe.memory_size}, ranges)
    begin = safe.stored_inputs
    if safe.observer or safe.latent:
        inputs["memory_in"][:, begin : begin + 1].round_()  # called before or not
    info = {
        "law": type(safe.law).__name__,
        "observer": safe.observer and {"bandwidth": safe.observer.bandwidth},
        "guard": safe.guard
        and {key: getattr(safe.guard, key) for key in ("threshold", "fallback")},
        "limits": {key: getattr(safe.actuator, key) for key in ("low", "high", "rate")},
        "period": period,
        "reference_ahead": safe.compensation.ahead if safe.compensation else 0.0,
        "num_coordinates": n,
        "num_inputs": safe.law.num_inputs,
        "memory_size": safe.memory_size,
        **{key: _listed(getattr(safe.law, key)) for key in ("position_gain", "velocity_gain")},
        **({"dead_time": safe.latent.dead_time} if safe.latent else {}),
        **({"q": [*model.labels], "u": [*model.input_labels]} if model.labels else {}),
        **(about or {}),
    }
    text = (
        "Input u of the law. Returns the sum of 1 (limited), 2 (outside the training data) and 4 "
        "(not finite: the last input). Zero memory_in before the first call, then memory_out."
    )
    if safe.compensation:
        text += f" q_ref, v_ref and a_ref are the reference {safe.compensation.ahead:g} s ahead."
    law = ExportedFunction("control", safe, inputs, ("u", "status", "memory_out"), text)
    return write([law], path, info, real)


def _listed(gain: Tensor | float) -> float | list[float]:
    return gain.tolist() if isinstance(gain, Tensor) else gain
