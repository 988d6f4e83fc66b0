"""Settings drawn for a fair comparison: every model gets the same draws."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from scipy.stats import qmc

log = logging.getLogger(__name__)

T = TypeVar("T")
Activation = Literal["softplus", "silu", "tanh"]


@dataclass(frozen=True)
class EqualSearch:
    """One draw of the settings that matter, the same for all models.

    Draw k is point k of a scrambled Sobol sequence (:class:`scipy.stats.qmc.Sobol`), so that a few
    draws cover the ranges evenly and a larger budget continues the draws of a smaller one. Draw 0
    leaves the configuration as it is. ``hidden`` and ``activation`` are set in every network of a
    model, ``substeps`` in its integrator.

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
        """Return the configuration with the settings of the draw; of the search it keeps the draw.

        A fit by least squares has none of these settings, so that all draws are the same.
        """
        config = {**config, "search": {"draw": self.draw}}
        if self.draw == 0:
            return config
        if "lr" not in config["optimizer"]:
            log.info("search: draw %d changes nothing, there is no learning rate", self.draw)
            return config
        point = iter(qmc.Sobol(d=7, seed=0).random_base2(self.draw.bit_length())[self.draw])
        optimizer = dict(config["optimizer"])
        for name in ("lr", "weight_decay"):
            low, high = getattr(self, name)
            optimizer[name] = float(low * (high / low) ** next(point))
        width, depth = _choice(self.width, next(point)), _choice(self.depth, next(point))
        drawn = {
            "hidden": [width] * depth,
            "activation": _choice(self.activation, next(point)),
            "substeps": _choice(self.substeps, next(point)),
        }
        length = _choice(self.length, next(point))
        validations = config["trainer"]["validations"]
        between = max(round(config["trainer"]["steps"] / validations * length), 1)
        return {
            **config,
            "optimizer": optimizer,
            "model": _with(config["model"], drawn),
            "trainer": {**config["trainer"], "steps": validations * between},
        }


def _choice(choices: Sequence[T], share: float) -> T:
    """Return the choice at a relative position from 0 to 1."""
    return choices[int(share * len(choices))]


def _with(part: Any, drawn: dict[str, Any]) -> Any:
    """Return a part of a configuration with the drawn settings wherever it has such keys."""
    if not isinstance(part, dict):
        return part
    return {key: drawn.get(key, _with(value, drawn)) for key, value in part.items()}
