"""Settings drawn for a fair comparison: every model gets the same draws."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scipy.stats import qmc

_RANGES = {"lr": (5e-4, 1e-2), "weight_decay": (1e-4, 0.3)}
"""Smallest and largest value; the logarithm is drawn uniformly."""
_WIDTHS, _DEPTHS = (16, 32, 64, 128), (1, 2, 3, 4)
_ACTIVATIONS, _SUBSTEPS = ("softplus", "silu", "tanh"), (1, 2, 4)
_LENGTHS = (0.5, 1.0, 2.0)
"""Length of the training, relative to that of the configuration."""


def with_draw(config: dict[str, Any], draw: int) -> dict[str, Any]:
    """Return the configuration with the settings of a draw, the same for all models.

    Draw k is point k of a scrambled Sobol sequence (:class:`scipy.stats.qmc.Sobol`). Draw 0 leaves
    the configuration as it is, and so do all draws for a fit by least squares. ``hidden`` and
    ``activation`` are set in every network of a model, ``substeps`` in its integrator.
    """
    if draw == 0 or "lr" not in config["optimizer"]:
        return config
    point = iter(qmc.Sobol(d=7, seed=0).random_base2(draw.bit_length())[draw])

    def chosen(choices: Sequence[Any]) -> Any:
        return choices[int(next(point) * len(choices))]

    optimizer = {**config["optimizer"]}
    for name, (low, high) in _RANGES.items():
        optimizer[name] = float(low * (high / low) ** next(point))
    width, depth = chosen(_WIDTHS), chosen(_DEPTHS)
    drawn = {"hidden": [width] * depth, "activation": chosen(_ACTIVATIONS)}
    drawn["substeps"] = chosen(_SUBSTEPS)
    trainer, length = config["trainer"], chosen(_LENGTHS)
    between = max(round(trainer["steps"] / trainer["validations"] * length), 1)
    return {
        **config,
        "optimizer": optimizer,
        "model": _with(config["model"], drawn),
        "trainer": {**trainer, "steps": trainer["validations"] * between},
    }


def _with(part: Any, drawn: dict[str, Any]) -> Any:
    """Return a part of a configuration with the drawn settings wherever it has such keys."""
    if not isinstance(part, dict):
        return part
    return {key: drawn.get(key, _with(value, drawn)) for key, value in part.items()}
