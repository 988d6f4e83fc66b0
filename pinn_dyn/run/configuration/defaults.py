"""Defaults of a training by model and kind of data, for Python and the command line.

The keys are those of train.py, whose YAML files refer to them as ``${default:data.pairs}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_ALL: dict[str, Any] = {
    "data.pairs": 8000,
    "data.steps": 1,
    "data.stride": 10,
    "data.batch_size": 256,
    "loss.velocity_weight": 1.0,
    "optimizer.lr": 0.005,
    "optimizer.weight_decay": 1e-5,
    "optimizer.fused": True,
    "trainer.steps": 20_000,
    "trainer.validations": 4,
    "trainer.accelerator": "cpu",
    "trainer.devices": 1,
    "trainer.gradient_clip_val": 1.0,
}
_LOG: dict[str, Any] = {
    "data.pairs": 10_000,
    "data.steps": 10,
    "data.stride": "about 20 ms",
    "data.batch_size": 128,
    "trainer.steps": 5000,
    "trainer.validations": 25,
}
_COULOMB = {"_target_": "pinn_dyn.models.CoulombFriction", "_partial_": True}
_MODELS: dict[str, dict[str, Any]] = {
    "HamiltonianNetwork": {"model.state": "qp"},
    "KnownMechanics": {"model.friction": _COULOMB},
    "NextStateMLP": {"model.activation": "silu", "data.stride": "about 10 ms"},
    "SubspaceEncoder": {"data.steps": 20},
    "CoupledOscillators": {
        "model.history": 0.0,
        "data.pairs": 10_000,
        "data.steps": "auto",
        "data.stride": "auto",
        "data.batch_size": 128,
        "loss.velocity_weight": 0.1,  # v is derived from q
        "optimizer.lr": 0.012,
        "optimizer.weight_decay": 0.05,
    },
}
_MODELS_ON_LOGS: dict[str, dict[str, Any]] = {
    "HamiltonianNetwork": {"model.state": "qv"},  # a log has no momenta
    "NextStateMLP": {"data.stride": "about 20 ms"},
    "CoupledOscillators": {
        "model.history": 0.3,  # of a simulated motion, what came before is unknown
        "trainer.steps": 1200,
        "trainer.validations": 8,
    },
}
_LEAST_SQUARES = {"trainer.steps": 1, "trainer.validations": 1, "trainer.gradient_clip_val": None}
_LEAST_SQUARES_ON_LOGS = {"data.pairs": "auto"}


def defaults(model: str, *, on_log: bool, least_squares: bool = False) -> dict[str, Any]:
    """Return the defaults of a training by their keys in train.py.

    Args:
        model: name of the class of the model.
        on_log: true for a log, false for simulated data.
        least_squares: true for a fit of constants.
    """
    values = {**_ALL, **(_LOG if on_log else {}), **_MODELS.get(model, {})}
    values |= _MODELS_ON_LOGS.get(model, {}) if on_log else {}
    if least_squares:
        values |= {**_LEAST_SQUARES, **(_LEAST_SQUARES_ON_LOGS if on_log else {})}
    return values


def section(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the values of a section, such as ``data``, by their keys in it."""
    start = f"{name}."
    return {key.removeprefix(start): x for key, x in values.items() if key.startswith(start)}


def even_validations(steps: int, limit: int) -> int:
    """Return the largest number of validations, up to ``limit``, that divides the steps."""
    return max(count for count in range(1, limit + 1) if steps % count == 0)
