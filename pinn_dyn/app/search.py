"""Settings drawn for a fair comparison: every model gets the same draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from scipy.stats import qmc

Activation = Literal["softplus", "silu", "tanh"]


@dataclass(frozen=True)
class EqualSearch:
    """One draw of the settings that matter, the same for all models.

    Draw k is point k of a scrambled Sobol sequence (:class:`scipy.stats.qmc.Sobol`). Draw 0 leaves
    the configuration as it is. ``hidden`` and ``activation`` are set in every network of a model,
    ``substeps`` in its integrator.

    Args:
        draw: number of the draw.
        lr, weight_decay: smallest and largest value; the logarithm is drawn uniformly.
        width, depth: choices for the layers of every network.
        activation: choices.
        length: choices for the length of the training, relative to that of the configuration.
        substeps: choices.
    """

    draw: NonNegativeInt
    lr: tuple[PositiveFloat, PositiveFloat] = (5e-4, 1e-2)
    weight_decay: tuple[PositiveFloat, PositiveFloat] = (1e-4, 0.3)
    width: Sequence[PositiveInt] = (16, 32, 64, 128)
    depth: Sequence[PositiveInt] = (1, 2, 3, 4)
    activation: Sequence[Activation] = ("softplus", "silu", "tanh")
    length: Sequence[PositiveFloat] = (0.5, 1.0, 2.0)
    substeps: Sequence[PositiveInt] = (1, 2, 4)

    def applied(self, config: dict[str, Any]) -> dict[str, Any]:
        """Return the configuration with the settings of the draw.

        A fit by least squares has none of these settings, so that all draws are the same.
        """
        config = {**config, "search": {"draw": self.draw}}
        if self.draw == 0 or "lr" not in config["optimizer"]:
            return config
        point = iter(qmc.Sobol(d=7, seed=0).random_base2(self.draw.bit_length())[self.draw])

        def chosen(choices: Sequence[Any]) -> Any:
            return choices[int(next(point) * len(choices))]

        optimizer = {**config["optimizer"]}
        for name in ("lr", "weight_decay"):
            low, high = getattr(self, name)
            optimizer[name] = float(low * (high / low) ** next(point))
        width, depth = chosen(self.width), chosen(self.depth)
        drawn = {
            "hidden": [width] * depth,
            "activation": chosen(self.activation),
            "substeps": chosen(self.substeps),
        }
        trainer, length = config["trainer"], chosen(self.length)
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
