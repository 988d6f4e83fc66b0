"""The record of a closed loop."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from pinn_dyn.control.contracts import Motion


@dataclass(frozen=True)
class ClosedLoopRecord:
    """K runs of a closed loop, sampled at its control instants; NaN after a run was stopped.

    Attributes:
        t: control instants, ``(T,)``, s.
        q, v: true state of the plant, ``(K, T, N)``.
        u: input applied to the plant, ``(K, T, M)``.
        u_wanted: input of the law before limits and delay, ``(K, T, M)``.
        reference: desired motion, ``(K, T, N)`` each.
        stopped: for each run None, or when and why it was stopped.
        diagnostics: diagnostics of the controller, ``(K, T)`` each.
    """

    t: Tensor
    q: Tensor
    v: Tensor
    u: Tensor
    u_wanted: Tensor
    reference: Motion
    stopped: list[str | None]
    diagnostics: dict[str, Tensor] = field(default_factory=dict)
