"""The region that training data cover, and a guard for control laws outside this region."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from scipy.spatial import cKDTree
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.mechanics.arrays import require_last_dim

log = logging.getLogger(__name__)


class DataRegion:
    """Distance of a state from the data that a model was trained on.

    With x = (q, v) in units of the standard deviation of the data (an angle enters as its sine and
    cosine), and x_1 ... x_S states drawn from the training trajectories::

        distance(q, v) = min_i |x - x_i| / r

    r is the 99th percentile, over the drawn states, of the distance to the nearest drawn state of
    *another* trajectory: the distance that a new trajectory of the same kind keeps from the data.
    So 1 is the edge of the data, and states inside are below 1. With neighbors of the same
    trajectory, r would be as small as the sample time, and each new trajectory an outlier.

    Args:
        q: configurations of the training trajectories, ``(T_k, N)`` each.
        v: their velocities, ``(T_k, N)`` each.
        angles: indices of the coordinates that are angles of unlimited joints.
        samples: S, largest number of states that are drawn.
        seed: seed of the draw.

    A single trajectory is cut into ten pieces of equal length, which count as trajectories.

    Raises:
        ValueError: on states of a single trajectory, or trajectories that all hold the same states.
    """

    def __init__(
        self,
        q: Sequence[Tensor],
        v: Sequence[Tensor],
        *,
        angles: Sequence[NonNegativeInt] = (),
        samples: PositiveInt = 5000,
        seed: NonNegativeInt = 0,
    ):
        self.num_coordinates = int(q[0].shape[-1])
        self.angles = sorted(angles)
        states = np.concatenate([self._features(*pair) for pair in zip(q, v, strict=True)])
        spread = states.std(axis=0)
        if self.angles:  # sine and cosine in one unit, that of the angle where it moves little
            sine, cosine = np.split(spread[-2 * len(self.angles) :], 2)
            spread[-2 * len(self.angles) :] = np.tile(np.hypot(sine, cosine), 2)
        self._scale = np.where(spread > 1e-12, spread, 1.0)
        if len(q) == 1:
            trajectory = np.arange(len(states)) * 10 // len(states)
        else:
            trajectory = np.repeat(np.arange(len(q)), [len(x) for x in q])

        count = min(samples, len(states))
        drawn = np.random.default_rng(seed).choice(len(states), count, replace=False)
        states, trajectory = states[drawn] / self._scale, trajectory[drawn]
        self._tree = cKDTree(states)
        self.radius = _distance_between_trajectories(states, trajectory)

    def distance(self, q: Tensor, v: Tensor) -> Tensor:
        """Return the distance from the data, ``(*batch,)``, 1 at the edge; NaN for a NaN state.

        Raises:
            ValueError: on a last dimension that is not N.
        """
        require_last_dim("q", q, self.num_coordinates, "N")
        require_last_dim("v", v, self.num_coordinates, "N")
        states = self._features(q, v) / self._scale
        finite = np.asarray(np.isfinite(states).all(axis=-1))
        nearest, _ = self._tree.query(np.where(finite[..., None], states, 0.0))
        return torch.as_tensor(np.where(finite, nearest / self.radius, np.nan)).to(q)

    def _features(self, q: Tensor, v: Tensor) -> np.ndarray:
        x = torch.cat([q, v], dim=-1).detach().cpu().double().numpy()
        if not self.angles:
            return x
        angles = x[..., self.angles]
        return np.concatenate(
            [np.delete(x, self.angles, axis=-1), np.sin(angles), np.cos(angles)], axis=-1
        )


def _distance_between_trajectories(states: np.ndarray, trajectory: np.ndarray) -> float:
    """Return the 99th percentile of the distances to the nearest state of another trajectory."""
    if len(np.unique(trajectory)) < 2:
        raise ValueError(
            f"the {len(states)} states drawn come from one trajectory, expected two at least: give "
            "more data, or a larger number of samples"
        )
    distances = [
        cKDTree(states[trajectory != k]).query(states[trajectory == k])[0]
        for k in np.unique(trajectory)
    ]
    radius = float(np.percentile(np.concatenate(distances), 99))
    if not radius > 0:
        raise ValueError(
            "all trajectories hold the same states, expected different ones: the size of the "
            "region cannot be told from them"
        )
    return radius


class Guarded(Controller):
    """A law with a guard, which warns outside the training data and may use a fallback law there::

        u = fallback(t, q, v, reference)  if there is one and distance(q, v) > threshold
            law(t, q, v, reference)       otherwise

    Each instant is judged alone, without hysteresis: a state near the edge may switch back and
    forth. One warning is logged per run, at the first state outside.

    Args:
        law: the law to guard.
        fallback: the law outside, a PD law say; None for a guard that only warns.
        region: the training data of the law's model.
        threshold: distance from which a state is outside; 1 is the edge of the data.

    Raises:
        ValueError: on sizes that do not match.
    """

    def __init__(
        self,
        law: Controller,
        fallback: Controller | None,
        region: DataRegion,
        *,
        threshold: PositiveFloat = 2.0,
    ):
        super().__init__(law.num_coordinates, law.num_inputs)
        sizes = {"region": region.num_coordinates}
        if fallback is not None:
            sizes["fallback"] = fallback.num_coordinates
        for name, size in sizes.items():
            if size != self.num_coordinates:
                raise ValueError(
                    f"{name} has {size} coordinates, expected those of the law, "
                    f"{self.num_coordinates}"
                )
        self.law = law
        self.region = region
        self.threshold = threshold
        self._fallback = fallback
        self._distance: Tensor | None = None
        self._warned = False

    def reset(self) -> None:
        self.law.reset()
        if self._fallback is not None:
            self._fallback.reset()
        self._distance = None
        self._warned = False

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        u = self.law(t, q, v, reference)
        self._distance = self.region.distance(q, v)
        outside = self._distance > self.threshold
        if not outside.any():
            return u
        if not self._warned:
            self._warned = True
            self._warn(t, self._distance)
        if self._fallback is None:
            return u
        return torch.where(outside.unsqueeze(-1), self._fallback(t, q, v, reference), u)

    def diagnostics(self) -> dict[str, Tensor]:
        """Return those of the law, ``distance``, and ``outside`` and ``fallback`` as 0 or 1."""
        if self._distance is None:
            return {}
        guard = {
            "distance": self._distance,
            "outside": (self._distance > self.threshold).to(self._distance),
            "fallback": self._handed_over(self._distance).to(self._distance),
        }
        return self.law.diagnostics() | guard

    def faults(self) -> dict[str, Tensor]:
        """Return the faults of the law, and of the fallback where the fallback acts."""
        if self._distance is None:
            return {}
        handed = self._handed_over(self._distance)
        faults = {reason: mask & ~handed for reason, mask in self.law.faults().items()}
        if self._fallback is not None and handed.any():
            for reason, mask in self._fallback.faults().items():
                faults[reason] = faults.get(reason, torch.zeros_like(mask)) | (mask & handed)
        return faults

    def _handed_over(self, distance: Tensor) -> Tensor:
        outside = distance > self.threshold
        return torch.zeros_like(outside) if self._fallback is None else outside

    def _warn(self, t: float, distance: Tensor) -> None:
        flat = distance.nan_to_num(nan=0.0).flatten()
        farthest = int(flat.argmax())
        count = int((flat > self.threshold).sum())
        log.warning(
            "t = %.4g s: %d of %d states outside the training data, the farthest (index %d) at "
            "distance %.3g, with 1 the edge of the data and %g the limit; %s",
            t,
            count,
            flat.numel(),
            farthest,
            float(flat[farthest]),
            self.threshold,
            "the model is not to be trusted there, and the law goes on with it"
            if self._fallback is None
            else "the fallback law takes over there",
        )
