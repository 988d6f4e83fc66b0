"""The region that training data cover, and a guard that warns outside this region."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy
import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion, Reference
from pinn_dyn.control.laws import ComputedTorque, ModelBasedLaw, Regulation
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.mechanics.arrays import require_last_dim

log = logging.getLogger(__name__)

_COLUMN = 32  # states whose distances are compared side by side, see DataRegion.nearest
FallBack = Literal["hold", "regulation"]
"""Input outside the training data: the last input, or PD with gravity compensation."""


class DataRegion:
    """Distance of a state from the data that a model was trained on.

    With x = (q, v) in units of the standard deviation of the data (an angle enters as its sine and
    cosine), and x_1 ... x_S states drawn from the training trajectories::

        distance(q, v) = min_i |x - x_i| / r

    r is the 99th percentile, over the drawn states, of the distance to the nearest drawn state of
    another trajectory, so 1 is the edge of the data. A single trajectory is cut into ten.

    Args:
        q, v: configurations and velocities of the training trajectories, ``(T_k, N)`` each.
        angles: indices of the coordinates that are angles of unlimited joints.
        samples: S, largest number of states that are drawn.

    Raises:
        ValueError: if the trajectories hold the same states.
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
        if self.angles:  # sine and cosine in one unit, that of the angle where it moves little
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
        """Return the distance from the data, ``(*batch,)``, 1 at the edge; NaN for a NaN state."""
        require_last_dim("q", q, self.num_coordinates, "N")
        require_last_dim("v", v, self.num_coordinates, "N")
        states = self._features(q.double(), v.double()).detach().cpu().numpy() / self._scale
        finite = np.asarray(np.isfinite(states).all(axis=-1))
        nearest, _ = self._tree.query(np.where(finite[..., None], states, 0.0))
        return torch.as_tensor(np.where(finite, nearest / self.radius, np.nan)).to(q)

    def distance_of_state(self, q: np.ndarray, v: np.ndarray) -> float:
        """Return :meth:`distance` of one state, ``(N,)`` each, as a number and without tensors."""
        with np.errstate(over="ignore", invalid="ignore"):
            x = np.concatenate([q, v])
            if self.angles:
                angles = x[self.angles]
                x = np.concatenate([np.delete(x, self.angles), np.sin(angles), np.cos(angles)])
            x = x / self._scale - self._center
            # |x - x_i|^2 / 2 without the constant |x|^2 / 2 finds the nearest state.
            offset = self._states[(self._halves - self._states @ x).argmin()] - x
            distance = math.sqrt(offset @ offset) / self.radius
        is_finite = math.isfinite(distance)
        return distance if is_finite else float(self.distance(*map(torch.from_numpy, (q, v))))

    def nearest(self, q: Tensor, v: Tensor) -> Tensor:
        """Return the distance ``()`` of a state ``(N,)`` by tensor operations, for exports."""
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


class Guarded(Controller):
    """A law with a guard, which warns once per run if a state is far from the training data.

    Args:
        law: the law to guard.
        region: the training data of the law's model.
        threshold: distance from which a state is outside; 1 is the edge of the data.
        fallback: input outside: ``hold`` for the last input, ``regulation`` for
            :class:`Regulation` by the gains of the law, None for the input of the law.

    Raises:
        ValueError: on ``regulation`` for a law whose gains are no stiffness and damping.
    """

    def __init__(
        self,
        law: Controller,
        region: DataRegion,
        *,
        threshold: PositiveFloat = 2.0,
        fallback: FallBack | None = None,
    ):
        super().__init__(law.num_coordinates, law.num_inputs)
        self.law, self.region, self.threshold, self.fallback = law, region, threshold, fallback
        self._observer = law if isinstance(law, DisturbanceObserver) else None
        law = self._observer.law if self._observer else law
        if fallback == "regulation":
            if not isinstance(law, ModelBasedLaw) or isinstance(law, ComputedTorque):
                raise ValueError(
                    f"fallback regulation needs gains in Nm/rad, and those of "
                    f"{type(law).__name__} have other units: use the fallback hold"
                )
            self._regulation = Regulation(law.model, law.position_gain, law.velocity_gain)
        self.reset()

    def reset(self) -> None:
        self.law.reset()
        self._distance: Tensor | None = None
        self._last: Tensor | None = None
        self._warned = False

    def follow(self, reference: Reference) -> None:
        self.law.follow(reference)

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        u = self.law(t, q, v, reference)
        self._distance = self.region.distance(q, v)
        last = torch.zeros_like(u) if self._last is None else self._last
        u, outside = self.replaced(q, v, reference, u, last, self._distance)
        if outside.any() and not self._warned:
            self._warned = True
            log.warning(
                f"t = {t:.4g} s: {int(outside.sum())} of {outside.numel()} states are outside the "
                f"training data, at distances up to {float(self._distance.nan_to_num().max()):.3g} "
                f"(1: edge of the data, {self.threshold:g}: threshold of the guard)"
            )
        if self._observer:
            self._observer.replace_input(u)
        self._last = u
        return u

    def replaced(
        self, q: Tensor, v: Tensor, reference: Motion, u: Tensor, last: Tensor, distance: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the law's u ``(*batch, M)``, replaced outside the data, and where that is.

        Args:
            q, v, reference: state and desired motion, ``(*batch, N)`` each.
            u, last: input of the law, and the last input, ``(*batch, M)``.
            distance: distance from the data, ``(*batch,)``.
        """
        outside = distance > self.threshold
        if self.fallback is None:
            return u, outside
        if self.fallback == "regulation":
            with torch.no_grad():
                last = self._regulation.law(q, v, *reference, last)
        return torch.where(outside.unsqueeze(-1), last, u), outside

    def diagnostics(self) -> dict[str, Tensor]:
        """Return those of the law, ``distance``, and ``outside`` as 0 or 1."""
        if self._distance is None:
            return {}
        outside = (self._distance > self.threshold).to(self._distance)
        return self.law.diagnostics() | {"distance": self._distance, "outside": outside}

    def faults(self) -> dict[str, Tensor]:
        return self.law.faults()
