"""The region of the training data, and a guard that marks states outside this region."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import scipy
import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Stage, Step, Wrapper
from pinn_dyn.control.laws import Regulation
from pinn_dyn.exports.program import is_traced
from pinn_dyn.mechanics.arrays import require_last_dim

_COLUMN = 32  # states whose distances are compared side by side, see DataRegion.nearest
FallBack = Literal["hold", "regulation"]
"""Input outside the training data: hold the last input, or PD with gravity compensation."""


class DataRegion:
    """Distance of a state from the data that a model was trained on.

    With x = (q, v) in units of the standard deviation of the data (an angle enters as its sine and
    cosine), and x_1 ... x_S states drawn from the training trajectories::

        distance(q, v) = min_i |x - x_i| / r

    r is the 99th percentile, over the drawn states, of the distance to the nearest drawn state of
    another trajectory. A distance of 1 is therefore the edge of the data. A single trajectory is
    cut into ten.

    Args:
        q, v: configurations and velocities of the training trajectories, ``(T_k, N)`` each.
        angles: indices of the coordinates that are angles of unlimited joints.
        samples: largest number S of drawn states.

    Raises:
        ValueError: if all trajectories hold the same states.
    """

    def __init__(
        self,
        q: Sequence[Tensor],
        v: Sequence[Tensor],
        *,
        angles: Sequence[NonNegativeInt] = (),
        samples: PositiveInt = 5000,
    ):
        self.num_coordinates = int(q[0].shape[-1])
        self.angles = sorted(angles)
        pairs = zip(q, v, strict=True)
        states = torch.cat([self._features(*pair) for pair in pairs]).cpu().double().numpy()
        spread = states.std(axis=0)
        if self.angles:  # a common unit of sine and cosine, for small motions that of the angle
            sine, cosine = np.split(spread[-2 * len(self.angles) :], 2)
            spread[-2 * len(self.angles) :] = np.tile(np.hypot(sine, cosine), 2)
        self._scale = np.where(spread > 1e-12, spread, 1.0)
        if len(q) == 1:
            trajectory = np.arange(len(states)) * 10 // len(states)
        else:
            trajectory = np.repeat(np.arange(len(q)), [len(x) for x in q])

        count = min(samples, len(states))
        drawn = np.random.default_rng(0).choice(len(states), count, replace=False)
        states, trajectory = states[drawn] / self._scale, trajectory[drawn]
        self._tree = scipy.spatial.cKDTree(states)
        self._center = states.mean(axis=0)
        self._states = np.ascontiguousarray(states - self._center)
        self._halves = np.square(self._states).sum(axis=1) / 2
        distances = [
            scipy.spatial.cKDTree(states[trajectory != k]).query(states[trajectory == k])[0]
            for k in np.unique(trajectory)
        ]
        self.radius = float(np.percentile(np.concatenate(distances), 99))
        if not 0 < self.radius < np.inf:
            raise ValueError("a region needs two different trajectories: give more data or samples")

    def distance(self, q: Tensor, v: Tensor) -> Tensor:
        """Return the distance from the data, ``(*batch,)``; 1 at the edge, NaN for a NaN state."""
        require_last_dim("q", q, self.num_coordinates, "N")
        require_last_dim("v", v, self.num_coordinates, "N")
        states = self._features(q.double(), v.double()).detach().cpu().numpy() / self._scale
        finite = np.asarray(np.isfinite(states).all(axis=-1))
        nearest, _ = self._tree.query(np.where(finite[..., None], states, 0.0))
        return torch.as_tensor(np.where(finite, nearest / self.radius, np.nan)).to(q)

    def distance_of_state(self, q: np.ndarray, v: np.ndarray) -> float:
        """Return :meth:`distance` of a single finite state, ``(N,)`` each, quickly by NumPy."""
        x = np.concatenate([q, v])
        if self.angles:
            angles = x[self.angles]
            x = np.concatenate([np.delete(x, self.angles), np.sin(angles), np.cos(angles)])
        x = x / self._scale - self._center
        # |x - x_i|^2 / 2 without the constant |x|^2 / 2 finds the nearest state.
        offset = self._states[(self._halves - self._states @ x).argmin()] - x
        return math.sqrt(offset @ offset) / self.radius

    def nearest(self, q: Tensor, v: Tensor) -> Tensor:
        """Return :meth:`distance` ``()`` of a state ``(N,)`` by operations that can be exported."""
        features = self._features(q, v)
        states = np.resize(self._tree.data, (-(-self._tree.n // _COLUMN) * _COLUMN, len(features)))
        offset = (features / torch.from_numpy(self._scale)).unsqueeze(-1) - torch.tensor(states.T)
        squares = (offset * offset).sum(0).reshape(-1, _COLUMN)
        return squares.amin(0).amin(0).sqrt() / self.radius

    def _features(self, q: Tensor, v: Tensor) -> Tensor:
        x = torch.cat([q, v], dim=-1)
        linear = [k for k in range(x.shape[-1]) if k not in self.angles]
        angles = x[..., self.angles]
        return torch.cat([x[..., linear], angles.sin(), angles.cos()], dim=-1)


class Guarded(Wrapper):
    """A law with a guard that marks states far from the training data as ``outside``.

    The report has ``distance``, the distance from the training data.

    Args:
        law: the law to guard.
        region: the training data of the law's model.
        threshold: distance from which a state is outside; 1 is the edge of the data.
        fallback: input outside: ``hold`` for the last input, ``regulation`` for
            :class:`Regulation` by the gains of the law, None for the input of the law.

    Raises:
        ValueError: if ``fallback`` is ``regulation`` and the gains of the law are not stiffness and
            damping.
    """

    def __init__(
        self,
        law: Stage,
        region: DataRegion,
        *,
        threshold: PositiveFloat = 2.0,
        fallback: FallBack | None = None,
    ):
        super().__init__(law)
        self.region, self.threshold, self.fallback = region, threshold, fallback
        gains = law.stiffness()
        if fallback == "regulation":
            if gains is None:
                raise ValueError(
                    f"fallback regulation needs gains in Nm/rad, but the gains of "
                    f"{type(law).__name__} have other units: use fallback=hold"
                )
            self._regulation = Regulation(law.model, *gains)

    def about(self) -> dict[str, Any]:
        guard = {"threshold": self.threshold, "fallback": self.fallback}
        return {**self.law.about(), "guard": guard}

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        u, memory, report = Step(*self.law.step(q, v, reference, applied, memory))
        distance = self.region.nearest(q, v) if is_traced() else self.region.distance(q, v)
        outside = distance > self.threshold
        if self.fallback is not None:
            safe = applied
            if self.fallback == "regulation":
                safe = self._regulation.step(q, v, reference, applied, memory).u
            u = torch.where(outside.unsqueeze(-1), safe, u)
        return Step(u, memory, {**report, "distance": distance, "outside": outside})
