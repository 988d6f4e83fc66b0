"""Models with a latent state that an encoder computes from the measured state history."""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from pydantic import Field, PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics import Predictor, Signal
from pinn_dyn.models.initial_velocity import InitialVelocityHead, start_of
from pinn_dyn.models.mlp import Activation
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics

_TIMES = 4  # number of time constants of the initial offset
_SHARE_RATE = 10.0  # learning rate of their shares, relative to that of the weights


class LinearAndMLP(nn.Module):
    """y = W x + b + MLP(x). W and the first layer of the MLP share a matrix product.

    Args:
        inputs, outputs: sizes of x and y.
        hidden, activation: widths and activation of the hidden layers.
    """

    def __init__(
        self, inputs: int, outputs: int, hidden: Sequence[PositiveInt], activation: Activation
    ):
        super().__init__()
        self._activation = getattr(F, activation)
        self._sizes = [outputs, hidden[0]]
        self.first = nn.Linear(inputs, outputs + hidden[0])
        self.layers = nn.ModuleList(
            nn.Linear(a, b) for a, b in itertools.pairwise([*hidden, outputs])
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return y, ``(*batch, outputs)``."""
        return self.after_first(self.first(x))

    def after_first(self, first: Tensor) -> Tensor:
        """Return y from the output of the first layer."""
        y, h = first.split(self._sizes, dim=-1)
        for layer in self.layers:
            h = layer(self._activation(h))
        return y + h


def _add_shares(model: nn.Module, state: dict[str, Tensor], *_: Any) -> None:
    """Complete the weights of an earlier version with a single time constant of the offset."""
    if "share" not in state and "fade" in state:
        state["fade"] = state["fade"].unsqueeze(-1).repeat(1, _TIMES)
        state["share"] = torch.zeros_like(state["fade"])


class EncodedPredictor(Predictor):
    """State-space model with a latent state z that an encoder computes from the past::

        z_0 = encoder(q_0, v_0, q_-1, ... q_-n, u_0, ... u_-n)
        y_k = output(z_k) + kept_k (y_0 - output(z_0)),      y = (q, v)
        kept_k = sum over j of share_j exp(-k h / tau_j)

    Symbols: latent state z ``(*batch, latent)``, state y of the robot ``(*batch, 2N)``, step h.
    y, q and u are normalized by their means and standard deviations. The encoder and the output are
    sums of a linear map and an MLP. The last term makes the prediction start at the measured y_0.
    Each component of y has four time constants tau_j, initially from a step to the length of the
    training windows, with shares whose sum is 1. Both are learned. The offset that the model does
    not explain then fades slowly for slow robots, and fast for fast robots. A learned v_0 replaces
    the measured v_0. Subclasses define the motion of z (:meth:`latent_path`).

    Unknown q and u before the start repeat the first sample, as for a robot at rest. The memory of
    a rollout is z and the fading terms, see :meth:`start` and :meth:`next_state`.

    Source: Beintema, Schoukens and Toth (2023), "Deep subspace encoders for nonlinear system
    identification". The fading term is not part of it.

    Args:
        statistics: scales of the data.
        history: length of the past that the encoder uses, s; n steps of the training windows.
            Pieces of a log keep 2 s of their past.
        latent: size of z.
        hidden, activation: widths and activation of the hidden layers of all networks.
        fade: initial exp(-h / tau_j) of all j; None spreads tau_j as above.
        initial_velocity: builder of the head for v_0.
    """

    mean: Tensor
    std: Tensor
    step: Tensor

    def __init__(
        self,
        statistics: Statistics,
        history: float,
        latent: int,
        hidden: Sequence[PositiveInt],
        activation: Activation,
        fade: float | None = None,
        initial_velocity: InitialVelocityHead | None = None,
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs)
        self.input_history = history
        self.history_steps = n = int(history / statistics.step + 1e-6)
        for name, values in zip(("mean", "std"), statistics.network_input(1), strict=True):
            q, v, u = values.float().split([size, size, inputs])
            self.register_buffer(name, torch.cat([q, v, *[q] * n, *[u] * (n + 1)]))
        self.register_buffer("step", torch.tensor(statistics.step, dtype=torch.float64))
        self.encoder: nn.Module = LinearAndMLP(len(self.mean), latent, hidden, activation)
        self._add_transition(inputs, latent, hidden, activation)
        self.output: nn.Module = LinearAndMLP(latent, 2 * size, hidden, activation)
        longest = len(statistics.qv_increment_std)  # steps of a window
        start = (-1 / torch.logspace(0, math.log10(longest), _TIMES)).exp()
        if fade is not None:
            start = torch.full_like(start, fade)
        self.fade = nn.Parameter(torch.logit(start).repeat(2 * size, 1))
        self.share = nn.Parameter(torch.zeros(2 * size, _TIMES))
        scales = Scales(statistics, statistics.v_std)
        self.initial_velocity = initial_velocity and initial_velocity(scales)
        self.memory_size = latent + self.fade.numel()
        self.register_load_state_dict_pre_hook(_add_shares)

    @abc.abstractmethod
    def _add_transition(
        self, inputs: int, latent: int, hidden: Sequence[int], activation: Activation
    ) -> None:
        """Add the parameters of :meth:`latent_path`."""

    @abc.abstractmethod
    def latent_path(self, z: Tensor, ends: Tensor) -> list[Tensor]:
        """Return the latent states z_0, ... z_T, ``(*batch, latent)`` each.

        Args:
            z: z_0, ``(*batch, latent)``.
            ends: normalized inputs at the start and the end of each step, ``(T, *batch, 2M)``.
        """

    @property
    def fixed_step(self) -> float:  # type: ignore[override]
        """Step of the training windows, s."""
        return float(self.step)

    def start(self, q: Tensor, v: Tensor, u: Tensor, q_past: Tensor, u_past: Tensor) -> Tensor:
        """Return the memory of a rollout, ``(*batch, latent + 8N)``: z and parts of y - output(z).

        Args:
            q, v, u: current state and input, ``(*batch, N or M)``.
            q_past, u_past: q and u of the previous n steps, the latest first, ``(*batch, n N)`` and
                ``(*batch, n M)``.
        """
        start = start_of(self.initial_velocity, torch.cat([q, v], dim=-1), u)
        x = (torch.cat([start, q_past, u, u_past], dim=-1) - self.mean) / self.std
        z = self.encoder(x)
        offset = x[..., : 2 * self.num_coordinates] - self.output(z)
        parts = offset.unsqueeze(-1) * self._shares
        return torch.cat([z, parts.flatten(-2)], dim=-1)

    def next_state(
        self, memory: Tensor, u: Tensor, u_next: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return memory, q and v after a step with u at its start and u_next at its end."""
        size = 2 * self.num_coordinates
        z, parts = memory.tensor_split([memory.shape[-1] - self.fade.numel()], dim=-1)
        ends = (torch.cat([u, u_next], dim=-1) - self._input_mean) / self._input_std
        z = self.latent_path(z, ends[None])[1]
        parts = torch.sigmoid(self.fade).flatten() * parts
        offset = parts.unflatten(-1, (size, _TIMES)).sum(-1)
        y = self.mean[:size] + self.std[:size] * (self.output(z) + offset)
        return torch.cat([z, parts], dim=-1), *y.chunk(2, dim=-1)

    @property
    def _shares(self) -> Tensor:
        return torch.softmax(_SHARE_RATE * self.share, dim=-1)

    @property
    def _input_mean(self) -> Tensor:
        return self.mean[len(self.mean) - self.num_inputs :].repeat(2)

    @property
    def _input_std(self) -> Tensor:
        return self.std[len(self.std) - self.num_inputs :].repeat(2)

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Apply the model step by step.

        Raises:
            ValueError: if the spacing of ``t`` is not the step of the training windows.
        """
        self._require_step(t)
        size, n = self.num_coordinates, self.history_steps
        before = t[0] - self.step.to(t) * torch.arange(n + 1, device=t.device)
        at_rest = [x0[..., :size]] * n  # replaces a missing past, and is cut off otherwise
        u_past = input.at(before).to(x0)
        measured, q_past = torch.cat([x0, *at_rest], dim=-1).tensor_split([2 * size], dim=-1)
        start = start_of(self.initial_velocity, measured, u_past[0])
        past = torch.cat([start, q_past[..., : n * size], *u_past], dim=-1)
        z = self.encoder((past - self.mean) / self.std)
        ends = torch.cat(input.stages(t, (0.0, 1.0)).to(x0).unbind(1), dim=-1)
        ends = (ends - self._input_mean) / self._input_std
        y = self.output(torch.stack(self.latent_path(z, ends), dim=-2))
        mean, std = self.mean[: 2 * size], self.std[: 2 * size]
        offset = (start.unsqueeze(-2) - mean) / std - y[..., :1, :]
        steps = torch.arange(len(t), device=t.device)[:, None]
        lost = self._shares * (1 - torch.sigmoid(self.fade) ** steps.unsqueeze(-1))
        moved = y - y[..., :1, :] - offset * lost.sum(-1)
        return std * moved + (steps > 0) * (start - measured).unsqueeze(-2)


class SubspaceEncoder(EncodedPredictor):
    """Black box with a memory (SUBNET)::

        z_{k+1} = z_k + transition(z_k, u_k, u_{k+1})

    The transition is the sum of a linear map and an MLP. z may represent states that are not
    measured, such as those of actuators. Training on windows of many steps minimizes the truncated
    simulation loss. Encoder, output and arguments: :class:`EncodedPredictor`.
    """

    def __init__(
        self,
        statistics: Statistics,
        history: Annotated[float, Field(ge=0, le=2)] = 0.5,
        latent: PositiveInt = 12,
        hidden: Sequence[PositiveInt] = (64,),
        activation: Activation = "tanh",
        fade: Annotated[float, Field(gt=0, lt=1)] | None = None,
    ):
        super().__init__(statistics, history, latent, hidden, activation, fade)

    def _add_transition(
        self, inputs: int, latent: int, hidden: Sequence[int], activation: Activation
    ) -> None:
        self.transition = LinearAndMLP(latent + 2 * inputs, latent, hidden, activation)
        with torch.no_grad():  # z decays, which keeps the first long rollouts from diverging
            self.transition.first.weight[:latent, :latent] -= 0.5 * torch.eye(latent)

    def latent_path(self, z: Tensor, ends: Tensor) -> list[Tensor]:
        path = [z]
        first = self.transition.first
        of_z, of_u = first.weight.tensor_split([z.shape[-1]], dim=1)
        for drive in F.linear(ends, of_u, first.bias):  # all steps in one product
            z = z + self.transition.after_first(drive + z @ of_z.T)
            path.append(z)
        return path
