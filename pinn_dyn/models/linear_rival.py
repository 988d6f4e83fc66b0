"""Linear baselines ARX and EDMDc, fitted by ridge regression in a fraction of a second."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import PositiveInt
from torch import Tensor

from pinn_dyn.mechanics import Predictor, Signal, Trajectory, samples_of, stack_until

_ROWS = 10_000  # largest number of windows in a fit
_FEATURES = 300  # largest number of features
_STEPS = 500  # length of the rollouts that select the lags
_LAGS = {1: (1, 2, 4, 8), 2: (1, 2)}  # candidates by degree
_RIDGES = (1e-12, 1e-7, 1e-3)  # candidates, relative to the variance of the features


class LinearRival(Predictor):
    """ARX with the past of q and u (degree 1), or EDMDc of degree 2 with delays::

        x_{k+1} = x_k + W (phi(s_k), u_k, u_{k+1}) + b,      x = (q, v)
        s_k     = (x_k, x_{k-1}, ... x_{k-L+1}, u_{k-1}, ... u_{k-L+1})

    L is the number of lags. phi(s) is s for degree 1, and s with all products of two entries for
    degree 2. u_{k+1} is the input at the end of the step, before a jump.

    The state history before the start of a rollout is estimated from (x_0, u_0) by a linear map
    fitted on the training windows. The baseline thus uses the same measurements as a network.

    Sources: Ljung (1999), "System Identification", section 4.2 (ARX); Korda and Mezic (2018),
    "Linear predictors for nonlinear dynamical systems" (EDMDc), projected onto the state after
    every step as in van Goor et al. (2023), "Reprojection methods for Koopman-based modelling".

    Args:
        train: training trajectories, each q ``(T, N)`` at a constant sample time.
        step: step of the model, s, an integer multiple of the sample time.
        lags: L.
        degree: 1 or 2.
        ridge: weight of the squared coefficients, relative to the variance of the features.

    Raises:
        ValueError: if the trajectories are too short, the step does not fit, or L is too large.
    """

    mean: Tensor
    scale: Tensor
    weight: Tensor
    bias: Tensor
    past_weight: Tensor
    past_bias: Tensor

    def __init__(
        self,
        train: Sequence[Trajectory],
        *,
        step: float,
        lags: PositiveInt,
        degree: Literal[1, 2],
        ridge: float,
    ):
        super().__init__(train[0].q.shape[-1], train[0].u.shape[-1])
        self.fixed_step = step
        self.lags, self.degree = lags, degree
        state, ends, target = _windows(train, step, lags)
        if degree == 2 and state.shape[1] ** 2 > 2 * _FEATURES:
            raise ValueError(f"more than {_FEATURES} products of past states: use fewer lags")
        self.register_buffer("mean", state.mean(0))
        self.register_buffer("scale", _spread(state))
        features = torch.cat([self._lift(state), ends], dim=1)
        # Map from (x_0, u_0) to the unobserved history, which is the last part of s.
        x0, history = state.tensor_split([2 * self.num_coordinates], dim=1)
        start = torch.cat([x0, ends[:, : self.num_inputs]], 1)
        for prefix, fit in (
            ("", _ridge(features, target, ridge)),
            ("past_", _ridge(start, history, 1e-12)),
        ):
            self.register_buffer(f"{prefix}weight", fit[0])
            self.register_buffer(f"{prefix}bias", fit[1])

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Apply the linear map step by step. The spacing of ``t`` must be the step."""
        self._require_step(t)
        # A held input has the same value at both ends of a step.
        ends = input.stages(t, (0.0, 1.0)).to(x0)
        size, inputs = x0.shape[-1], self.num_inputs
        start = torch.cat([x0, ends[0, 0]], dim=-1)
        past_x, past_u = (start @ self.past_weight + self.past_bias).split(
            [(self.lags - 1) * size, (self.lags - 1) * inputs], dim=-1
        )
        x = x0
        path = [torch.zeros_like(x0)]
        for now, after in ends:
            lifted = self._lift(torch.cat([x, past_x, past_u], dim=-1))
            change = torch.cat([lifted, now, after], dim=-1) @ self.weight + self.bias
            if self.lags > 1:
                past_x = torch.cat([x, past_x[..., :-size]], dim=-1)
                past_u = torch.cat([now, past_u[..., :-inputs]], dim=-1)
            path.append(path[-1] + change)
            x = x0 + path[-1]
        return torch.stack(path, dim=-2)

    def _lift(self, state: Tensor) -> Tensor:
        z = (state - self.mean) / self.scale
        if self.degree == 2:
            first, second = torch.triu_indices(z.shape[-1], z.shape[-1], device=z.device)
            z = torch.cat([z, z[..., first] * z[..., second]], dim=-1)
        return z


def fit_linear_rival(
    train: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    *,
    step: float,
    degree: Literal[1, 2],
) -> LinearRival:
    """Fit baselines and return that with the smallest mean |q_hat - q| on validation.

    Raises:
        ValueError: if no baseline can be fitted.
    """
    truth = stack_until(validation)
    stride = samples_of("step", step, truth.t)
    truth = truth.until(min(truth.duration, step * _STEPS))
    rivals: list[tuple[float, LinearRival]] = []
    reason = "the training data are empty"
    for lags, ridge in itertools.product(_LAGS[degree], _RIDGES):
        try:
            rival = LinearRival(train, step=step, lags=lags, degree=degree, ridge=ridge)
        except ValueError as problem:
            reason = str(problem)
            continue
        x = rival.predict(
            truth.states("qv", slice(1))[:, 0].double(),
            truth.t[::stride].double(),
            truth.input.to(truth.q.device, torch.float64),
        )
        error = (x[..., : rival.num_coordinates] - truth.q[:, ::stride]).norm(dim=-1).mean()
        rivals.append((float(error.nan_to_num(torch.inf, torch.inf)), rival))
    if not rivals:
        raise ValueError(f"no linear model can be fitted: {reason}")
    return min(rivals, key=lambda item: item[0])[1]


def _windows(train: Sequence[Trajectory], step: float, lags: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return states s, inputs (u_k, u_{k+1}) and increments x_{k+1} - x_k, one row per window."""
    strides = [samples_of("step", step, item.t) for item in train]
    counts = [len(item.t) - lags * k for item, k in zip(train, strides, strict=True)]
    total = sum(max(count, 0) for count in counts)
    if total < 2:
        raise ValueError(f"all training trajectories are shorter than {lags} steps of {step:g} s")
    thin = -(-total // _ROWS)
    parts = []
    for item, stride, count in zip(train, strides, counts, strict=True):
        x, u = item.states("qv").double(), item.u.double()
        now = torch.arange((lags - 1) * stride, (lags - 1) * stride + max(count, 0), thin)
        after = now + stride
        before = [now - j * stride for j in range(1, lags)]
        past = [x[now], *(x[k] for k in before), *(u[k] for k in before)]
        end = u[after - 1 if item.input.interpolation == "hold" else after]
        parts.append((torch.cat(past, 1), torch.cat([u[now], end], 1), x[after] - x[now]))
    state, ends, target = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
    return state, ends, target


def _ridge(features: Tensor, target: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """Return W and b that minimize mean |y - z W - b|^2 + ridge |W s|^2, s the spread of z."""
    centre, scale = features.mean(0), _spread(features)
    z, mean = (features - centre) / scale, target.mean(0)
    # Use QR, since a Gram matrix would lose precision.
    rows = torch.linalg.qr(torch.cat([z, target - mean], dim=1), mode="r").R[: z.shape[1]]
    left, size, right = torch.linalg.svd(rows[:, : z.shape[1]], full_matrices=False)
    shrunk = size / (size.square() + ridge * len(z))
    weight = (right.T * shrunk) @ (left.T @ rows[:, z.shape[1] :]) / scale[:, None]
    return weight, mean - centre @ weight


def _spread(values: Tensor) -> Tensor:
    spread = values.std(0, correction=0)
    return torch.where(spread > 1e-12 * values.abs().amax(0), spread, 1.0)
