"""Settings drawn for a fair comparison: every model gets the same draws."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from scipy.stats import qmc

from pinn_dyn.app.keys import Count, Index, Range
from pinn_dyn.app.schema import ConfigError

log = logging.getLogger(__name__)

PositiveNumber = Annotated[float, Range(0, above=True)]
T = TypeVar("T")
Activation = Literal["softplus", "silu", "tanh"]


@dataclass(frozen=True)
class EqualSearch:
    """One draw of the settings that matter, whatever the model.

    Draw k is point k of a scrambled Sobol sequence (:class:`scipy.stats.qmc.Sobol`), so that few
    draws cover the ranges evenly, and those of a larger budget go on from those of a smaller one.
    Draw 0 leaves the configuration as it is. A model takes of a draw what it has: ``hidden`` and
    ``activation`` of every network in it, ``substeps`` of its integrator.

    Args:
        draw: number of the draw.
        lr, weight_decay: smallest and largest value, between which the logarithm is uniform.
        width, depth: choices for the layers of every network.
        activation: choices.
        length: choices for the length of the training, times that of the configuration.
        substeps: choices.

    Raises:
        ConfigError: on a range that is none, or no choices.
    """

    draw: Index
    lr: Sequence[PositiveNumber]
    weight_decay: Sequence[PositiveNumber]
    width: Sequence[Count]
    depth: Sequence[Count]
    activation: Sequence[Activation]
    length: Sequence[PositiveNumber]
    substeps: Sequence[Count]

    def __post_init__(self) -> None:
        for name in ("lr", "weight_decay"):
            ends = getattr(self, name)
            if len(ends) != 2 or not ends[0] <= ends[1]:
                raise ConfigError(
                    f"{name} is {list(ends)}, expected the smallest and the largest value"
                )
        for name in ("width", "depth", "activation", "length", "substeps"):
            if not getattr(self, name):
                raise ConfigError(f"{name} is empty, expected at least one choice")

    def applied(self, config: dict[str, Any]) -> dict[str, Any]:
        """The configuration with the settings of the draw, and of the search its number alone.

        A fit by least squares has none of these settings: it is the same at every draw.
        """
        config = {**config, "search": {"draw": self.draw}}
        if self.draw == 0:
            return config
        if "lr" not in config["optimizer"]:
            log.info(
                "search: draw %d changes nothing, as the optimizer has no learning rate", self.draw
            )
            return config
        point = iter(qmc.Sobol(d=7, seed=0).random_base2(self.draw.bit_length())[self.draw])
        optimizer = dict(config["optimizer"])
        for name in ("lr", "weight_decay"):
            low, high = getattr(self, name)
            optimizer[name] = float(low * (high / low) ** next(point))
        width, depth = _one_of(self.width, next(point)), _one_of(self.depth, next(point))
        drawn = {
            "hidden": [width] * depth,
            "activation": _one_of(self.activation, next(point)),
            "substeps": _one_of(self.substeps, next(point)),
        }
        length = _one_of(self.length, next(point))
        validations = config["trainer"]["validations"]
        between = max(round(config["trainer"]["steps"] / validations * length), 1)
        return {
            **config,
            "optimizer": optimizer,
            "model": _with(config["model"], drawn),
            "trainer": {**config["trainer"], "steps": validations * between},
        }


def _one_of(choices: Sequence[T], share: float) -> T:
    """The choice that lies that far, from 0 to 1, in the list."""
    return choices[int(share * len(choices))]


def _with(part: Any, drawn: dict[str, Any]) -> Any:
    """A part of a configuration with the drawn settings wherever it has them, at any depth."""
    if not isinstance(part, dict):
        return part
    return {key: drawn.get(key, _with(value, drawn)) for key, value in part.items()}
