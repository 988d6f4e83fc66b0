"""What a closed loop leaves behind."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from pinn_dyn.control.contracts import Motion


@dataclass(frozen=True)
class ClosedLoopRecord:
    """K runs of a closed loop, sampled at its control instants.

    What belongs to the plant or the law is NaN after a run has stopped.

    Attributes:
        t: control instants, ``(T,)``, s.
        q, v: true state of the plant, ``(K, T, N)``.
        u: input applied to the plant, ``(K, T, M)``.
        u_wanted: input that the law asked for, before limits and delay, ``(K, T, M)``.
        reference: desired motion, ``(K, T, N)`` each.
        stopped: for each run None, or when and why it was stopped.
        diagnostics: what the controller reports of itself, ``(K, T)`` each.
    """

    t: Tensor
    q: Tensor
    v: Tensor
    u: Tensor
    u_wanted: Tensor
    reference: Motion
    stopped: list[str | None]
    diagnostics: dict[str, Tensor] = field(default_factory=dict)
